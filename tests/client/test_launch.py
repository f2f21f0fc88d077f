"""The local launcher with the real service and a real worker."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from prtbake import Client, LaunchError
from prtbake.config import discover
from prtbake.launch import LocalService
from prtbake_storage.contract.brdf import GgxSpec
from prtbake_storage.contract.resources import BrdfRegistration
from support.deployment import free_port


def test_the_port_may_be_taken(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LaunchError, match=str(port)), LocalService(tmp_path, port=port):
            pass
    # nothing stays behind, so the next start finds the directory free
    assert not (tmp_path / "server.json").exists()


@pytest.mark.acceptance
def test_a_process_that_dies_at_its_start_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PRTBAKE_DATABASE_URL", "sqlite://")
    with pytest.raises(LaunchError, match="database_url"), LocalService(tmp_path):
        pass


@pytest.mark.acceptance
def test_a_directory_of_its_own_takes_no_storage_from_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ``prtbake demo`` runs: its blobs are removed, and no other database may refer to them."""
    monkeypatch.setenv("PRTBAKE_DATABASE_URL", f"sqlite:///{tmp_path / 'production.sqlite'}")
    monkeypatch.setenv("PRTBAKE_BLOB_URL", (tmp_path / "production").as_uri())
    own = tmp_path / "own"
    with LocalService(own, n_workers=1, embedded=True):
        assert (own / "prtbake.sqlite").exists()
        assert (own / "blobs").is_dir()
    assert not list(tmp_path.glob("production*"))


@pytest.mark.acceptance
def test_serve_from_start_to_stop(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "prtbake.cli.main", "serve", "--data-dir", str(tmp_path)]
    port = free_port()
    process = subprocess.Popen(
        [*command, "--workers", "1"],
        env=os.environ | {"PRTBAKE_PORT": str(port)}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        # at once, as the next line of a script would
        endpoint = discover(data_dir=tmp_path, grace_s=30.0)
        with pytest.raises(LaunchError, match="already"), LocalService(tmp_path):
            pass
        assert endpoint.url == f"http://127.0.0.1:{port}"
        assert endpoint.url == json.loads((tmp_path / "server.json").read_text())["url"]
        with Client(data_dir=tmp_path) as client:
            brdf = client.register(BrdfRegistration(spec=GgxSpec(alpha=0.4)))
            assert brdf.state == "ready"
            assert brdf.canonical
        children = _children(process.pid)
        assert len(children) == 2
    finally:
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "stopped" in told
    assert not (tmp_path / "server.json").exists()
    assert not [pid for pid in children if _alive(pid)]


@pytest.mark.acceptance
def test_nothing_survives_a_killed_launcher(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "prtbake.cli.main", "serve", "--data-dir", str(tmp_path)]
    process = subprocess.Popen([*command, "--workers", "1", "--port", "0"])
    try:
        discover(data_dir=tmp_path, grace_s=30.0)
        children = _children(process.pid)
        assert len(children) == 2
    finally:
        process.kill()
        process.wait()
    deadline = time.monotonic() + 30
    while any(_alive(pid) for pid in children):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def _children(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(task) for task in tasks]


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (OSError, ValueError):
        return False
