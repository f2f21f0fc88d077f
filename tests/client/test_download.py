"""Downloads resume, check their digest and never leave a wrong file under a right name."""

import asyncio
import hashlib
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest

from prtbake import AsyncClient, Client, DownloadError, ServiceUnreachable
from prtbake.download import PartialFile
from prtbake_service.testing import LiveService
from prtbake_storage.contract.jobs import Artefact, Job

DATA = bytes(range(251)) * 9001  # 2.2 MB, no power of two anywhere


@pytest.fixture(scope="module")
def job(service: LiveService, environment: str) -> Job:
    with Client(service.url, key=service.key) as client:
        job = client.submit({"kind": "fit_light", "environment": environment})
        service.succeed(job.id, {}, light_h5=DATA, empty_txt=b"")
        return client.job(job.id)


class CuttingProxy:
    """A TCP proxy that cuts the first connections after so many bytes of the answer."""

    def __init__(self, target: str, cut_after: int, cuts: int) -> None:
        host, port = target.removeprefix("http://").split(":")
        self._target = (host, int(port))
        self._cut_after = cut_after
        self._cuts = cuts
        self.ranges: list[str] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=[connection], daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with suppress(OSError), connection, socket.create_connection(self._target) as upstream:
            head = connection.recv(65536).replace(
                b"\r\nAccept:", b"\r\nConnection: close\r\nAccept:", 1
            )
            is_file = b"/light.h5 " in head.split(b"\r\n")[0]
            for line in head.decode("latin-1").splitlines():
                if line.lower().startswith("range:"):
                    self.ranges.append(line.split(": ")[1])
            upstream.sendall(head)
            left = None
            if is_file and self._cuts > 0:
                self._cuts -= 1
                left = self._cut_after
            while chunk := upstream.recv(65536):
                if left is not None and len(chunk) >= left:
                    connection.sendall(chunk[:left])
                    return
                left = None if left is None else left - len(chunk)
                connection.sendall(chunk)

    def close(self) -> None:
        self._listener.close()


@pytest.fixture
def cutting(service: LiveService, request: pytest.FixtureRequest) -> Iterator[CuttingProxy]:
    proxy = CuttingProxy(service.url, 700_000, request.param)
    yield proxy
    proxy.close()


def test_everything_arrives(client: Client, job: Job, tmp_path: Path) -> None:
    moved: list[int] = []
    paths = client.download_all(job.id, tmp_path / "out", on_bytes=moved.append)
    assert [path.name for path in paths] == ["light.h5", "empty.txt"]
    assert paths[0].read_bytes() == DATA
    assert paths[1].read_bytes() == b""
    assert sum(moved) == len(DATA)
    moved.clear()
    client.download_all(job.id, tmp_path / "out", on_bytes=moved.append)
    assert moved == []  # it is there and right


@pytest.mark.parametrize("cutting", [2], indirect=True)
def test_a_cut_connection_is_taken_up_again(
    service: LiveService, cutting: CuttingProxy, job: Job, tmp_path: Path
) -> None:
    moved: list[int] = []
    with Client(cutting.url, key=service.key) as client:
        path = client.download(job.id, "light.h5", tmp_path, on_bytes=moved.append)
    assert path.read_bytes() == DATA
    assert sum(moved) == len(DATA)  # no byte came twice
    assert len(cutting.ranges) == 2
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize("cutting", [99], indirect=True)
def test_a_later_run_goes_on_where_this_one_stopped(
    service: LiveService, client: Client, cutting: CuttingProxy, job: Job, tmp_path: Path
) -> None:
    with (
        Client(cutting.url, key=service.key, retries=0) as unlucky,
        pytest.raises(ServiceUnreachable),
    ):
        unlucky.download(job.id, "light.h5", tmp_path)
    had = (tmp_path / "light.h5.part").stat().st_size
    assert 0 < had < len(DATA)
    assert not (tmp_path / "light.h5").exists()
    moved: list[int] = []
    assert client.download(job.id, "light.h5", tmp_path, on_bytes=moved.append).read_bytes() == DATA
    assert sum(moved) == len(DATA) - had


def test_a_damaged_part_is_found_out(client: Client, job: Job, tmp_path: Path) -> None:
    (tmp_path / "light.h5.part").write_bytes(b"#" * 1000)
    with pytest.raises(DownloadError, match="digest"):
        client.download(job.id, "light.h5", tmp_path)
    assert not list(tmp_path.iterdir())  # thrown away: the next try starts anew
    assert client.download(job.id, "light.h5", tmp_path).read_bytes() == DATA


def test_a_wrong_file_in_the_way_is_replaced(client: Client, job: Job, tmp_path: Path) -> None:
    (tmp_path / "light.h5").write_bytes(b"old")
    assert client.download(job.id, "light.h5", tmp_path).read_bytes() == DATA


def test_a_part_that_is_too_long_starts_anew(client: Client, job: Job, tmp_path: Path) -> None:
    (tmp_path / "light.h5.part").write_bytes(DATA + b"more")
    assert client.download(job.id, "light.h5", tmp_path).read_bytes() == DATA


def test_a_file_that_is_not_there(client: Client, job: Job, tmp_path: Path) -> None:
    with pytest.raises(LookupError, match=r"nothing\.h5"):
        client.download(job.id, "nothing.h5", tmp_path)


async def _download(url: str, key: str, job_id: str, folder: Path) -> list[Path]:
    async with AsyncClient(url, key=key) as client:
        return await client.download_all(job_id, folder)


@pytest.mark.parametrize("cutting", [2], indirect=True)
def test_the_asynchronous_client_resumes_too(
    service: LiveService, cutting: CuttingProxy, job: Job, tmp_path: Path
) -> None:
    paths = asyncio.run(_download(cutting.url, service.key, job.id, tmp_path))
    assert paths[0].read_bytes() == DATA
    assert len(cutting.ranges) == 2


@pytest.mark.parametrize("name", ["../up", "a/b", "..", ".", "", "/etc/passwd"])
def test_names_stay_in_the_folder(tmp_path: Path, name: str) -> None:
    artefact = _artefact(name=name)
    with pytest.raises(DownloadError, match="plain file name"):
        PartialFile(artefact, tmp_path)


@pytest.mark.parametrize("given", ["bytes 6-9/10", "bytes 0-9/10", "nonsense", ""])
def test_another_range_than_asked_for_is_refused(tmp_path: Path, given: str) -> None:
    (tmp_path / "f.part").write_bytes(b"01234")
    partial = PartialFile(_artefact(name="f"), tmp_path)
    assert partial.headers()["Range"] == "bytes=5-"
    with pytest.raises(DownloadError, match="another range"):
        partial.begin(httpx.Response(206, headers={"Content-Range": given}))


def test_a_service_that_ignores_ranges_sends_all(tmp_path: Path) -> None:
    (tmp_path / "f.part").write_bytes(b"01234")
    partial = PartialFile(_artefact(name="f"), tmp_path)
    partial.begin(httpx.Response(200))
    partial.write(b"0123456789")
    assert partial.finish().read_bytes() == b"0123456789"


def test_more_than_was_promised_is_refused(tmp_path: Path) -> None:
    partial = PartialFile(_artefact(name="f"), tmp_path)
    partial.begin(httpx.Response(200))
    with pytest.raises(DownloadError, match="more than 10"):
        partial.write(b"0123456789A")
    partial.pause()


def _artefact(**changes: Any) -> Artefact:
    data = b"0123456789"
    values = {
        "name": "f",
        "size": len(data),
        "media_type": "text/plain",
        "sha256": f"sha256:{hashlib.sha256(data).hexdigest()}",
    }
    return Artefact.model_validate(values | changes)
