import base64
import hashlib

import httpx
import pytest

from prtbake_service.artefacts.ranges import ByteRange, RangeNotSatisfiable, parse_range
from prtbake_service.testing import LiveService

DATA = bytes(range(256)) * 2000


@pytest.fixture(scope="module")
def path(service: LiveService, http: httpx.Client, environment: str) -> str:
    job = http.post("/v1/jobs", json={"kind": "fit_light", "environment": environment}).json()
    service.succeed(job["id"], {}, light_h5=DATA, empty_txt=b"")
    return f"/v1/jobs/{job['id']}/artefacts"


def test_manifest(http: httpx.Client, path: str) -> None:
    items = http.get(path).json()["items"]
    digest = f"sha256:{hashlib.sha256(DATA).hexdigest()}"
    assert items[0] == {
        "name": "light.h5",
        "size": len(DATA),
        "media_type": "application/octet-stream",
        "sha256": digest,
    }


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_whole_download(http: httpx.Client, path: str, method: str) -> None:
    answer = http.request(method, f"{path}/light.h5")
    assert answer.status_code == 200
    assert answer.content == (DATA if method == "GET" else b"")
    headers = answer.headers
    digest = hashlib.sha256(DATA)
    encoded = f"sha-256=:{base64.b64encode(digest.digest()).decode()}:"
    assert headers["etag"] == f'"sha256:{digest.hexdigest()}"'
    assert headers["repr-digest"] == headers["content-digest"] == encoded
    assert headers["content-length"] == str(len(DATA))
    assert headers["content-disposition"] == 'attachment; filename="light.h5"'
    assert "immutable" in headers["cache-control"]
    assert headers["accept-ranges"] == "bytes"
    assert headers["content-security-policy"] == "sandbox"
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    ("asked", "start", "stop"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=10-99", 10, 100),
        ("bytes=500000-", 500_000, len(DATA)),
        ("bytes=-5", len(DATA) - 5, len(DATA)),
        ("bytes=-99999999", 0, len(DATA)),
        ("bytes=511999-9999999", 511_999, len(DATA)),
    ],
)
def test_ranges(http: httpx.Client, path: str, asked: str, start: int, stop: int) -> None:
    answer = http.get(f"{path}/light.h5", headers={"Range": asked})
    assert answer.status_code == 206
    assert answer.content == DATA[start:stop]
    assert answer.headers["content-range"] == f"bytes {start}-{stop - 1}/{len(DATA)}"
    assert "content-digest" not in answer.headers
    assert "repr-digest" in answer.headers


@pytest.mark.parametrize("asked", [f"bytes={len(DATA)}-", "bytes=-0", "bytes=9999999-99999999"])
def test_a_range_beyond_the_end(http: httpx.Client, path: str, asked: str) -> None:
    answer = http.get(f"{path}/light.h5", headers={"Range": asked})
    assert answer.status_code == 416
    assert answer.headers["content-range"] == f"bytes */{len(DATA)}"
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    "asked", ["bytes=5-2", "bytes=-", "lines=1-2", "bytes=0-1,5-6", "bytes=" + "9" * 30 + "-", "x"]
)
def test_what_is_no_range_is_ignored(http: httpx.Client, path: str, asked: str) -> None:
    answer = http.get(f"{path}/light.h5", headers={"Range": asked})
    assert answer.status_code == 200
    assert answer.content == DATA


def test_if_range(http: httpx.Client, path: str) -> None:
    etag = http.head(f"{path}/light.h5").headers["etag"]
    headers = {"Range": "bytes=0-9", "If-Range": etag}
    assert http.get(f"{path}/light.h5", headers=headers).status_code == 206
    headers["If-Range"] = '"another"'
    assert http.get(f"{path}/light.h5", headers=headers).status_code == 200


def test_if_none_match(http: httpx.Client, path: str) -> None:
    etag = http.head(f"{path}/light.h5").headers["etag"]
    answer = http.get(f"{path}/light.h5", headers={"If-None-Match": etag})
    assert (answer.status_code, answer.content) == (304, b"")
    assert answer.headers["etag"] == etag


def test_an_empty_file(http: httpx.Client, path: str) -> None:
    assert http.get(f"{path}/empty.txt").content == b""
    assert http.get(f"{path}/empty.txt", headers={"Range": "bytes=0-"}).status_code == 416


def test_a_name_that_is_not_there(http: httpx.Client, path: str) -> None:
    assert http.get(f"{path}/nothing.h5").status_code == 404
    assert http.get(f"{path}/..%2f..%2fetc").status_code in {404, 422}


def test_parse_range_alone() -> None:
    assert parse_range(None, 10) is None
    assert parse_range(" bytes=2-4 ", 10) == ByteRange(2, 5, 10)
    with pytest.raises(RangeNotSatisfiable):
        parse_range("bytes=10-", 10)
    assert parse_range("bytes=²-", 10) is None
