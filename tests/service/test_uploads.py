import hashlib
import socket
import time
from collections.abc import Callable

import httpx
import pytest

from prtbake_service.testing import LiveService
from support.folders import files_in


def digest_of(data: bytes) -> str:
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def test_upload_once(service: LiveService, http: httpx.Client) -> None:
    data = b"some mesh" * 1000
    digest = digest_of(data)
    assert http.post("/v1/uploads/missing", json={"digests": [digest, digest]}).json() == {
        "missing": [digest]
    }
    first = http.put(f"/v1/uploads/{digest}", content=data)
    assert (first.status_code, first.json()) == (201, {"digest": digest, "size": len(data)})
    again = http.put(f"/v1/uploads/{digest}", content=data)
    assert (again.status_code, again.json()) == (200, {"digest": digest, "size": len(data)})
    assert http.post("/v1/uploads/missing", json={"digests": [digest]}).json() == {"missing": []}
    assert http.get(f"/v1/uploads/{digest}").json()["size"] == len(data)
    assert service.backend.blobs.read_bytes(digest) == data


def test_wrong_bytes_leave_nothing(service: LiveService, http: httpx.Client) -> None:
    digest = digest_of(b"right")
    answer = http.put(f"/v1/uploads/{digest}", content=b"wrong")
    assert (answer.status_code, answer.json()["code"]) == (409, "digest-mismatch")
    assert not service.backend.blobs.exists(digest)
    assert not service.backend.blobs.exists(digest_of(b"wrong"))
    assert _scratch_is_empty(service)


@pytest.mark.parametrize("declared", [True, False])
def test_the_limit_holds_while_streaming(
    service: LiveService, http: httpx.Client, declared: bool
) -> None:
    data = b"x" * (service.backend.settings.max_upload_bytes + 1)
    digest = digest_of(data)
    content = data if declared else iter([data[: 1 << 20], data[1 << 20 :]])
    answer = http.put(f"/v1/uploads/{digest}", content=content)
    assert (answer.status_code, answer.json()["code"]) == (413, "too-large")
    assert not service.backend.blobs.exists(digest)
    assert _scratch_is_empty(service)


def test_the_limit_itself_is_allowed(service: LiveService, http: httpx.Client) -> None:
    data = b"y" * service.backend.settings.max_upload_bytes
    assert http.put(f"/v1/uploads/{digest_of(data)}", content=data).status_code == 201


def test_an_empty_file(http: httpx.Client) -> None:
    assert http.put(f"/v1/uploads/{digest_of(b'')}", content=b"").status_code == 201


def test_a_broken_upload_leaves_nothing(service: LiveService, http: httpx.Client) -> None:
    host, port = service.url.removeprefix("http://").split(":")
    digest = digest_of(b"never whole")
    head = (
        f"PUT /v1/uploads/{digest} HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n"
        f"Authorization: Bearer {service.key}\r\n\r\n"
    )
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(head.encode() + b"never")
        _until(lambda: not _scratch_is_empty(service))  # it has begun
    _until(lambda: _scratch_is_empty(service))
    assert not service.backend.blobs.exists(digest)


def test_knowing_a_digest_gives_no_right_to_it(service: LiveService, http: httpx.Client) -> None:
    data = b"somebody else's"
    digest = digest_of(data)
    service.backend.blobs.put_bytes(data)
    service.backend.uploads.add(digest, len(data), project="other")
    assert http.post("/v1/uploads/missing", json={"digests": [digest]}).json()["missing"]
    assert http.get(f"/v1/uploads/{digest}").status_code == 404
    assert http.post("/v1/meshes", json={"blob": digest}).status_code == 404
    assert http.put(f"/v1/uploads/{digest}", content=b"guess").status_code == 409
    assert http.put(f"/v1/uploads/{digest}", content=data).status_code == 201


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def _scratch_is_empty(service: LiveService) -> bool:
    return not files_in(service.data_dir / "blobs" / "scratch")
