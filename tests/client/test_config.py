import json
from pathlib import Path

import pytest

from prtbake.config import DEFAULT_URL, Endpoint, discover, home


def local(folder: Path, url: str = "http://127.0.0.1:1234", key: str = "local-key") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "server.json").write_text(json.dumps({"url": url, "pid": 1}))
    (folder / "api-key").write_text(f"{key}\n")
    return folder


def test_nothing_is_known() -> None:
    assert discover() == Endpoint(DEFAULT_URL, None)


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
    assert discover(data_dir=tmp_path).url == DEFAULT_URL


def test_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("PRTBAKE_HOME")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert home() == tmp_path / "prtbake"
    monkeypatch.delenv("XDG_DATA_HOME")
    assert home() == Path.home() / ".local" / "share" / "prtbake"
