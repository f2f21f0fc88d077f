import stat
from pathlib import Path

import httpx
import pytest

from prtbake_service.auth import KEY_FILE, ensure_key, write_private
from prtbake_service.testing import LiveService, live_service, quick_settings


@pytest.mark.parametrize(
    "header", [{}, {"Authorization": "Bearer wrong"}, {"Authorization": "Basic eDp5"}]
)
@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/v1/jobs"),
        ("POST", "/v1/jobs"),
        ("POST", "/v1/jobs:estimate"),
        ("GET", "/v1/jobs/a/events"),
        ("GET", "/v1/jobs/a/artefacts"),
        ("GET", "/v1/jobs/a/artefacts/b"),
        ("HEAD", "/v1/jobs/a/artefacts/b"),
        ("DELETE", "/v1/jobs/a"),
        ("POST", "/v1/uploads/missing"),
        ("PUT", "/v1/uploads/sha256:" + "0" * 64),
        ("GET", "/v1/meshes"),
        ("POST", "/v1/brdfs"),
        ("GET", "/v1/environments/environment-0000000000000000"),
    ],
)
def test_nothing_without_a_key(
    service: LiveService, method: str, path: str, header: dict[str, str]
) -> None:
    answer = httpx.request(method, service.url + path, headers=header, trust_env=False)
    assert answer.status_code == 401


def test_401_says_what_to_send(service: LiveService) -> None:
    answer = httpx.get(f"{service.url}/v1/jobs", trust_env=False)
    assert answer.headers["www-authenticate"].startswith("Bearer")
    assert answer.json()["code"] == "unauthorised"


def test_the_key_is_for_its_owner_only(service: LiveService) -> None:
    mode = (service.data_dir / KEY_FILE).stat().st_mode
    assert stat.S_IMODE(mode) == 0o600
    assert service.key not in (service.data_dir / "prtbake.sqlite").read_bytes().decode("latin-1")


def test_a_second_start_keeps_the_key(service: LiveService) -> None:
    ensure_key(service.backend)
    assert (service.data_dir / KEY_FILE).read_text().strip() == service.key


def opened_by(folder: Path, *keys: str, **settings: object) -> list[bool]:
    """Start a service on a folder and tell which keys open it."""
    with live_service(quick_settings(folder, **settings)) as live:
        return [live.backend.keys.verify(key) is not None for key in keys]


def test_a_given_key_takes_the_place_of_the_one_before(tmp_path: Path) -> None:
    (tmp_path / KEY_FILE).write_text("unused\n")
    keys = ("the-first-key-given", "the-second-key-given")
    assert opened_by(tmp_path, *keys, api_key=keys[0]) == [True, False]
    assert opened_by(tmp_path, *keys, api_key=keys[1]) == [False, True]
    assert opened_by(tmp_path, *keys, api_key=keys[0]) == [True, False]


def test_removing_the_key_file_closes_its_key(tmp_path: Path) -> None:
    opened_by(tmp_path)
    first = (tmp_path / KEY_FILE).read_text().strip()
    (tmp_path / KEY_FILE).unlink()
    assert opened_by(tmp_path, first) == [False]
    second = (tmp_path / KEY_FILE).read_text().strip()
    assert second != first
    # a revoked key is not opened again by the file that still holds it
    with live_service(quick_settings(tmp_path)) as live:
        live.backend.keys.revoke(live.backend.keys.verify(second).id)
    assert opened_by(tmp_path, second) == [False]
    third = (tmp_path / KEY_FILE).read_text().strip()
    assert opened_by(tmp_path, third) == [True]


@pytest.mark.parametrize("key", ["", "short", "fifteen-letters"])
def test_a_guessable_key_is_refused(tmp_path: Path, key: str) -> None:
    with pytest.raises(ValueError, match="api_key"):
        quick_settings(tmp_path, api_key=key)


def test_a_private_file_is_written_once(tmp_path: Path) -> None:
    path = tmp_path / "key"
    write_private(path, "first")
    write_private(path, "second")
    assert path.read_text() == "first\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_projects_do_not_see_each_other(service: LiveService, http: httpx.Client, submit) -> None:
    job = submit()
    _, other = service.backend.keys.create(project="other")
    headers = {"Authorization": f"Bearer {other}"}
    with httpx.Client(base_url=service.url, headers=headers, trust_env=False) as stranger:
        assert stranger.get(f"/v1/jobs/{job['id']}").status_code == 404
        assert stranger.post(f"/v1/jobs/{job['id']}/cancel").status_code == 404
        assert stranger.get(f"/v1/jobs/{job['id']}/events").status_code == 404
        assert stranger.get("/v1/jobs").json()["items"] == []
        answer = stranger.put(f"/v1/jobs/{job['id']}", json=job["request"])
        assert answer.status_code in {404, 409}
    assert http.get(f"/v1/jobs/{job['id']}").json()["state"] == "queued"


def test_the_operator_gives_a_key(tmp_path: Path) -> None:
    (tmp_path / KEY_FILE).write_text("unused\n")
    with live_service(quick_settings(tmp_path, api_key="operators-own-key")) as live:
        headers = {"Authorization": "Bearer operators-own-key"}
        assert httpx.get(f"{live.url}/v1/jobs", headers=headers, trust_env=False).status_code == 200
        headers = {"Authorization": "Bearer unused"}
        assert httpx.get(f"{live.url}/v1/jobs", headers=headers, trust_env=False).status_code == 401
