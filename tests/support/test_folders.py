import shutil
import threading

from support.folders import files_in


def test_all_files_are_listed_and_none_of_a_folder_that_is_gone(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    for name in ("one", "a/two", "a/b/three"):
        (tmp_path / name).write_text("")
    expected = {tmp_path / name for name in ("one", "a/two", "a/b/three")}
    assert set(files_in(tmp_path)) == expected
    assert files_in(tmp_path / "nowhere") == []


def test_folders_may_come_and_go_meanwhile(tmp_path):
    done = threading.Event()

    def churn():
        while not done.is_set():
            for index in range(20):
                (tmp_path / str(index) / "deep").mkdir(parents=True, exist_ok=True)
            for index in range(20):
                shutil.rmtree(tmp_path / str(index))

    thread = threading.Thread(target=churn)
    thread.start()
    try:
        assert all(files_in(tmp_path) == [] for _ in range(200))
    finally:
        done.set()
        thread.join()
