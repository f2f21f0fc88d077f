"""The local blob store: the contract, and what a directory can suffer."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from prtbake_storage.blobs import LocalBlobStore, collect_garbage, open_store
from prtbake_storage.blobs.base import RENEW_AFTER_S, referenced_digests
from prtbake_storage.errors import InputError, SettingsError
from prtbake_storage.testing.blob_contract import BlobStoreContract, digest_of


class TestLocalBlobStore(BlobStoreContract):
    @pytest.fixture
    def store(self, tmp_path: Path) -> LocalBlobStore:
        return LocalBlobStore(tmp_path / "store")


@pytest.fixture
def store(tmp_path: Path) -> LocalBlobStore:
    return LocalBlobStore(tmp_path / "store")


def files_under(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_blobs_are_sharded_and_read_only(store: LocalBlobStore) -> None:
    digest = store.put_bytes(b"data")
    name = digest.removeprefix("sha256:")
    assert files_under(store.root) == [store.root / "blobs" / name[:2] / name]
    assert store.local_path(digest).stat().st_mode & 0o777 == 0o444


def test_a_file_from_another_file_system_is_copied(
    store: LocalBlobStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "elsewhere"
    path.write_bytes(b"far away")
    publish = store.publish

    def refuse(source: Path, digest: str) -> None:
        if source == path:
            raise OSError(18, "Invalid cross-device link")
        publish(source, digest)

    monkeypatch.setattr(store, "publish", refuse)
    assert store.read_bytes(store.put_file(path, move=True)) == b"far away"
    assert not path.exists()


def test_a_blob_that_was_cut_short_is_mended_by_putting_it_again(store: LocalBlobStore) -> None:
    digest = store.put_bytes(b"whole")
    path = store.local_path(digest)
    path.chmod(0o644)
    path.write_bytes(b"who")
    store.put_bytes(b"whole")
    assert store.read_bytes(digest) == b"whole"


def test_an_unreadable_result_counts_as_none_and_is_replaced(store: LocalBlobStore) -> None:
    key = "c" * 64
    store.put_result(key, {"value": 1})
    path = store.root / "results" / "cc" / f"{key}.json"
    for broken in ("", '{"value": ', "[1]"):
        path.write_text(broken)
        assert store.get_result(key) is None
    assert store.put_result(key, {"value": 2}) == {"value": 2}
    assert store.get_result(key) == {"value": 2}


def test_many_threads_agree_on_one_result(store: LocalBlobStore) -> None:
    key, n_threads = "d" * 64, 8
    start = threading.Barrier(n_threads)
    seen: list[dict[str, int]] = []

    def put(value: int) -> None:
        start.wait()
        seen.append(store.put_result(key, {"value": value}))

    threads = [threading.Thread(target=put, args=(value,)) for value in range(n_threads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == n_threads
    assert all(value == store.get_result(key) for value in seen)


def test_a_writer_killed_midway_leaves_only_scratch_that_its_owner_is_swept_of(
    store: LocalBlobStore,
) -> None:
    code = (
        "import os, sys; from pathlib import Path; from prtbake_storage.blobs import LocalBlobStore\n"
        "store = LocalBlobStore(Path(sys.argv[1]), owner='victim')\n"
        "with store.scratch() as folder, store.writer() as writer:\n"
        "    (folder / 'half').write_bytes(b'x' * 100); writer.write(b'y' * 100)\n"
        "    writer._file.flush(); os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(store.root)], check=False)
    assert done.returncode == -9
    assert list(store.blobs()) == []
    assert len(files_under(store.root)) == 2  # the negative twin: it did leave something
    with store.scratch() as mine:
        (mine / "at work").write_bytes(b"")
        assert store.sweep_scratch(owner="somebody-else") == 0
        assert store.sweep_scratch(owner="victim") == 2
        assert files_under(store.root) == [mine / "at work"]
    assert list((store.root / "scratch").iterdir()) == []


def test_only_old_scratch_is_swept_without_an_owner(store: LocalBlobStore) -> None:
    old = store.root / "scratch" / "gone" / "job"
    old.mkdir(parents=True)
    os.utime(old, (time.time() - 1000.0,) * 2)
    # what a collector had set aside when it was killed
    aside = store.root / "scratch" / "0123.4567"
    aside.write_bytes(b"garbage")
    os.utime(aside, (time.time() - 1000.0,) * 2)
    new = store.root / "scratch" / "busy" / "job"
    new.mkdir(parents=True)
    assert store.sweep_scratch(older_than_s=500.0, keep=["gone"]) == 1
    assert not aside.exists()
    assert store.sweep_scratch(older_than_s=500.0, keep=["busy"]) == 1
    assert not old.exists()
    assert new.exists()


@pytest.mark.parametrize("owner", ["", "..", "a/b", "../up", ".hidden", "x" * 200])
def test_an_owner_is_one_plain_name(store: LocalBlobStore, owner: str) -> None:
    with pytest.raises(InputError):
        LocalBlobStore(store.root, owner=owner)
    with pytest.raises(InputError):
        store.sweep_scratch(owner=owner)


def test_a_url_or_a_path_opens_the_same_store(tmp_path: Path) -> None:
    folder = tmp_path / "a folder"
    digest = open_store(str(folder)).put_bytes(b"here")
    store = open_store(open_store(str(folder)).url)
    assert store.read_bytes(digest) == b"here"
    for url in ("s3://bucket/prefix", "file://other.host/path", "", "https://x"):
        with pytest.raises(SettingsError) as caught:
            open_store(url)
        assert caught.value.pointer == "/blob_url"


OLD_S = 10.0 * RENEW_AFTER_S
GRACE_S = 5.0 * RENEW_AFTER_S


def age(store: LocalBlobStore) -> None:
    """Make everything in the store old."""
    for path in files_under(store.root):
        os.utime(path, (time.time() - OLD_S,) * 2)


def test_garbage_is_old_and_unreferenced(store: LocalBlobStore) -> None:
    kept, lost, mine = (store.put_bytes(data) for data in (b"kept", b"lost!", b"mine"))
    store.put_result("e" * 64, {"digest": lost})
    store.put_result("f" * 64, {"digest": mine})
    assert collect_garbage(store, {kept}, older_than_s=GRACE_S).n_blobs == 0
    age(store)
    fresh = store.put_bytes(b"fresh")
    keep = {"keep": {kept}, "keep_results": {"f" * 64}, "older_than_s": GRACE_S}
    plan = collect_garbage(store, **keep, dry_run=True)
    assert (plan.n_blobs, plan.n_bytes, plan.n_results) == (1, 5, 1)
    assert store.exists(lost)
    assert collect_garbage(store, **keep).n_bytes == 5
    assert [blob.digest for blob in store.blobs()] == sorted([kept, fresh, mine])
    assert store.get_result("e" * 64) is None
    assert store.get_result("f" * 64) == {"digest": mine}


def test_an_old_blob_that_a_young_result_names_is_no_garbage(store: LocalBlobStore) -> None:
    digest = store.put_bytes(b"passed on by a later task")
    age(store)
    store.put_result("e" * 64, {"parts": [{"digest": digest}]})
    assert collect_garbage(store, set(), older_than_s=GRACE_S).n_blobs == 0
    age(store)
    assert collect_garbage(store, set(), older_than_s=GRACE_S).n_blobs == 1


@pytest.mark.parametrize("how", ["put", "renew"])
def test_using_a_blob_again_keeps_the_collector_away(store: LocalBlobStore, how: str) -> None:
    digest = store.put_bytes(b"needed again")
    age(store)
    if how == "put":
        store.put_bytes(b"needed again")
    else:
        assert store.renew(digest)
    assert collect_garbage(store, set(), older_than_s=GRACE_S).n_blobs == 0


def test_what_is_gone_cannot_be_renewed_and_what_is_fresh_need_not(store: LocalBlobStore) -> None:
    digest = store.put_bytes(b"data")
    store.put_result("a" * 64, {})
    before = [path.stat().st_mtime_ns for path in files_under(store.root)]
    assert store.renew(digest)
    assert store.renew_result("a" * 64)
    assert [path.stat().st_mtime_ns for path in files_under(store.root)] == before
    store.delete(digest)
    store.delete_result("a" * 64)
    assert not store.renew(digest)
    assert not store.renew_result("a" * 64)


def test_what_is_used_while_garbage_is_collected_stays(
    store: LocalBlobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    used, lost = store.put_bytes(b"used"), store.put_bytes(b"lost")
    store.put_result("a" * 64, {"digest": used})
    age(store)
    delete_result = store.delete_result

    def use_first(key: str, **limit: float) -> bool:
        # the collector has looked already: both are old, and nothing refers to them
        assert store.renew_result(key)
        assert store.renew(used)
        return delete_result(key, **limit)

    monkeypatch.setattr(store, "delete_result", use_first)
    report = collect_garbage(store, set(), older_than_s=GRACE_S)
    assert (report.n_results, report.n_blobs) == (0, 1)
    assert store.get_result("a" * 64) == {"digest": used}
    assert store.read_bytes(used) == b"used"
    assert not store.exists(lost)
    assert store.local_path(used).stat().st_mode & 0o777 == 0o444
    assert list((store.root / "scratch").iterdir()) == []


def test_digests_are_found_inside_json() -> None:
    one, two = digest_of(b"1"), digest_of(b"2")
    value = {"a": one, "b": [{"c": two}, 3, None, "sha256:short"], one: "a key is no reference"}
    assert list(referenced_digests(value)) == [one, two]
