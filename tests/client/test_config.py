import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from prtbake import AsyncClient, ServiceUnreachable
from prtbake.config import DEFAULT_URL, Endpoint, discover, home, write_server


def local(folder: Path, url: str = "http://127.0.0.1:1234", key: str = "local-key") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_server(folder, url, ready=True)
    (folder / "api-key").write_text(f"{key}\n")
    return folder


def test_nothing_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ServiceUnreachable, match="prtbake serve"):
        discover(grace_s=0.0)
    monkeypatch.setenv("PRTBAKE_API_KEY", "of a service in a container, say")
    assert discover().url == DEFAULT_URL


def test_a_service_that_is_starting_is_waited_for(tmp_path: Path) -> None:
    """The line after `prtbake serve &`: at first nothing, then a port without a key, then both."""

    def start() -> None:
        time.sleep(0.1)
        write_server(tmp_path, "http://127.0.0.1:5", ready=False)
        time.sleep(0.2)
        (tmp_path / "api-key").write_text("new\n")
        write_server(tmp_path, "http://127.0.0.1:5", ready=True)

    starting = threading.Thread(target=start)
    starting.start()
    assert discover(data_dir=tmp_path) == Endpoint("http://127.0.0.1:5", "new")
    starting.join()


def test_waiting_for_a_start_has_an_end(tmp_path: Path) -> None:
    write_server(tmp_path, "http://127.0.0.1:5", ready=False)
    with pytest.raises(ServiceUnreachable, match=r"after 0\.1 s"):
        discover(data_dir=tmp_path, start_s=0.1)
    # an event loop is not held up at all
    with pytest.raises(ServiceUnreachable, match="starting"):
        AsyncClient(data_dir=tmp_path)


def test_what_a_killed_launcher_left_is_no_service(tmp_path: Path) -> None:
    code = "import sys, pathlib, prtbake.config as c; c.write_server(pathlib.Path(sys.argv[1]), 'http://x', ready=True)"
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    assert (tmp_path / "server.json").exists()
    with pytest.raises(ServiceUnreachable):
        discover(data_dir=tmp_path, grace_s=0.0)


def test_a_local_service_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PRTBAKE_HOME", str(local(tmp_path / "data")))
    assert discover() == Endpoint("http://127.0.0.1:1234", "local-key")


def test_the_local_key_goes_nowhere_else(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PRTBAKE_HOME", str(local(tmp_path / "data")))
    monkeypatch.setenv("PRTBAKE_URL", "https://bake.example")
    assert discover() == Endpoint("https://bake.example", None)
    assert discover("http://elsewhere").key is None
    monkeypatch.setenv("PRTBAKE_API_KEY", "given")
    assert discover() == Endpoint("https://bake.example", "given")
    assert discover(key="argument").key == "argument"


def test_a_data_directory_named_by_hand_wins(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PRTBAKE_URL", "https://bake.example")
    other = local(tmp_path / "other", url="http://127.0.0.1:99", key="other")
    assert discover(data_dir=other) == Endpoint("http://127.0.0.1:99", "other")


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"url": 3}', "not json"])
def test_a_broken_record_is_no_service(tmp_path: Path, text: str) -> None:
    (tmp_path / "server.json").write_text(text)
    with pytest.raises(ServiceUnreachable):
        discover(data_dir=tmp_path, grace_s=0.0)


def test_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("PRTBAKE_HOME")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert home() == tmp_path / "prtbake"
    monkeypatch.delenv("XDG_DATA_HOME")
    assert home() == Path.home() / ".local" / "share" / "prtbake"
