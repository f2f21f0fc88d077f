"""What `docker-compose.yml` and the Dockerfiles say, held against what runs; Docker is not needed.

The services run in environments that hold what their images hold: the packages of the requirement
file, the sources that are copied, the variables that are set.
"""

import os
import re
import signal
import subprocess
import sys
import venv
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from prtbake import Client, Unauthorised
from prtbake_service.settings import DEFAULT_PORT
from prtbake_service.testing import live_service, quick_settings
from prtbake_storage.contract.resources import EnvironmentRegistration
from prtbake_storage.testing.postgres import find_postgres, fresh_database
from support.deployment import free_port, stop, until

pytestmark = pytest.mark.acceptance

ROOT = Path(__file__).parents[2]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
GIVEN = {
    "POSTGRES_PASSWORD": "of the test",
    "PRTBAKE_API_KEY": "a key that is long enough to be one",
}
APP = "/app"


@dataclass(frozen=True)
class Dockerfile:
    """The lines of a Dockerfile that decide what runs."""

    path: Path
    sources: list[str]
    requirements: list[str]
    installs_itself: bool
    variables: dict[str, str]
    command: list[str]


def read_dockerfile(service: str) -> Dockerfile:
    """Read the Dockerfile that a service is built from."""
    path = ROOT / COMPOSE["services"][service]["build"]["dockerfile"]
    text = path.read_text().replace("\\\n", " ")
    assert re.search(rf"^WORKDIR {APP}$", text, re.MULTILINE)
    runs = re.findall(r"^RUN (.+)$", text, re.MULTILINE)
    variables = dict(
        pair.split("=", 1) for line in re.findall(r"^ENV (.+)$", text, re.MULTILINE)
        for pair in line.split()
    )  # fmt: skip
    (command,) = re.findall(r"^CMD (\[.+\])$", text, re.MULTILINE)
    return Dockerfile(
        path=path,
        sources=[
            source
            for line in re.findall(r"^COPY (.+)$", text, re.MULTILINE)
            for source in line.split()[:-1]
        ],
        requirements=[name for run in runs for name in re.findall(r"-r (\S+)", run)],
        installs_itself=any(run.split()[-2:] == ["--no-deps", "."] for run in runs),
        variables=variables,
        command=yaml.safe_load(command),
    )


@dataclass(frozen=True)
class Image:
    """An environment that holds what an image holds, and nothing else of this machine's Python."""

    folder: Path
    dockerfile: Dockerfile

    @property
    def app(self) -> Path:
        """The working directory, with the sources that are copied."""
        return self.folder / "app"

    def environment(self) -> dict[str, str]:
        """The variables of the image."""
        inside = {
            name: value.replace(APP, str(self.app))
            for name, value in self.dockerfile.variables.items()
        }
        path = f"{self.folder / 'venv' / 'bin'}:/usr/bin:/bin"
        return inside | {"PATH": path, "HOME": str(self.folder)}

    def python(self, code: str) -> str:
        """Run a line of Python and give what it prints."""
        done = subprocess.run(
            ["python", "-W", "error", "-c", code],
            env=self.environment(), cwd=self.app, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout


def build(service: str, folder: Path) -> Image:
    """Do what the Dockerfile does, with links in place of downloads and copies."""
    image = Image(folder, read_dockerfile(service))
    (image.app / "requirements").mkdir(parents=True)
    for source in image.dockerfile.sources:
        (image.app / source).symlink_to(ROOT / source)
    venv.EnvBuilder(with_pip=False, symlinks=True).create(folder / "venv")
    (site,) = (folder / "venv" / "lib").glob("python*/site-packages")
    names = [name for file in image.dockerfile.requirements for name in pins(ROOT / file)]
    if image.dockerfile.installs_itself:
        names.append("prtbake")
    for name in names:
        installed = distribution(name)
        for top in {path.parts[0] for path in installed.files or ()} - {"..", "__pycache__"}:
            if not (site / top).exists():
                (site / top).symlink_to(Path(str(installed.locate_file(top))).resolve())
    return image


def pins(path: Path) -> dict[str, str]:
    """Names and versions of a requirement file that hold on this machine; all must be hashed."""
    found = {}
    for entry in re.split(r"\n(?=\S)", path.read_text().strip()):
        line, *hashes = entry.replace("\\\n", "\n").splitlines()
        requirement = Requirement(line.strip())
        assert str(requirement.specifier).startswith("=="), line
        assert hashes, f"{line} has no hash"
        assert all(re.fullmatch(r"\s+--hash=sha256:[0-9a-f]{64}\s*", one) for one in hashes), line
        if requirement.marker is None or requirement.marker.evaluate():
            found[canonicalize_name(requirement.name)] = str(requirement.specifier)
    return found


def variables_of(service: str) -> dict[str, str]:
    """A service's variables, with those of the caller's shell put in."""

    def given(match: re.Match[str]) -> str:
        return GIVEN[match["name"]]

    return {
        name: re.sub(r"\$\{(?P<name>\w+)(:\?[^}]*)?\}", given, str(value))
        for name, value in COMPOSE["services"][service]["environment"].items()
    }


@pytest.fixture(scope="module")
def service_image(tmp_path_factory: pytest.TempPathFactory) -> Image:
    return build("service", tmp_path_factory.mktemp("service"))


@pytest.fixture(scope="module")
def worker_image(tmp_path_factory: pytest.TempPathFactory) -> Image:
    return build("worker", tmp_path_factory.mktemp("worker"))


@pytest.mark.parametrize("service", ["service", "worker"])
def test_a_dockerfile_names_what_is_there(service: str) -> None:
    dockerfile = read_dockerfile(service)
    ignored = (ROOT / ".dockerignore").read_text().split()
    for source in dockerfile.sources:
        assert (ROOT / source).exists(), source
        assert not {source, source.split("/")[0]} & set(ignored), source
    assert dockerfile.requirements
    assert set(dockerfile.requirements) <= set(dockerfile.sources)
    assert "--require-hashes" in dockerfile.path.read_text()
    assert COMPOSE["services"][service]["command"] == dockerfile.command


@pytest.mark.parametrize("name", ["server", "workers", "dev"])
def test_every_requirement_is_pinned_and_hashed_as_in_development(name: str) -> None:
    development = pins(ROOT / "requirements" / "dev.txt")
    own = pins(ROOT / "requirements" / f"{name}.txt")
    assert own.items() <= development.items()
    assert "dbos" in own


def test_an_unhashed_requirement_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "requirements.txt"
    path.write_text("numpy==2.0\n")
    with pytest.raises(AssertionError, match="no hash"):
        pins(path)


EVERY_MODULE = (
    "import importlib, pkgutil, sys\n"
    "import {package} as package\n"
    "for found in pkgutil.walk_packages(package.__path__, '{package}.'):\n"
    "    importlib.import_module(found.name)\n"
    "print(*sorted({{name.partition('.')[0] for name in sys.modules}}))\n"
)


def test_the_service_needs_its_requirements_only(service_image: Image) -> None:
    loaded = set(service_image.python(EVERY_MODULE.format(package="prtbake_service")).split())
    assert "prtbake_storage" in loaded
    core = {"prtbake_workers", "trimesh", "embreex", "scipy", "moderngl", "cv2", "OpenEXR"}
    assert not loaded & core
    names = sorted(core)
    code = f"import importlib.util as u; print([n for n in {names} if u.find_spec(n)])"
    assert service_image.python(code).strip() == "[]"


def test_the_workers_need_their_requirements_only(worker_image: Image) -> None:
    loaded = set(worker_image.python(EVERY_MODULE.format(package="prtbake_workers")).split())
    assert {"prtbake_workers", "trimesh", "embreex", "scipy", "moderngl"} <= loaded
    assert not loaded & {"pytest", "beartype", "psutil", "tensorly"}


def test_the_parts_fit_together() -> None:
    services = COMPOSE["services"]
    assert set(services) == {"database", "service", "worker"}
    for name in ("service", "worker"):
        variables = variables_of(name)
        url = sa.make_url(variables["PRTBAKE_DATABASE_URL"])
        database = variables_of("database")
        assert url.host in services
        assert (url.username, url.password, url.database) == (
            database["POSTGRES_USER"], database["POSTGRES_PASSWORD"], database["POSTGRES_DB"],
        )  # fmt: skip
        # blobs lie on a volume that both mount in the same place
        mounts = [mount.split(":")[1] for mount in services[name]["volumes"]]
        blobs = variables["PRTBAKE_BLOB_URL"].removeprefix("file://")
        assert any(blobs.startswith(f"{mount}/") for mount in mounts)
        assert services[name]["volumes"] == services["service"]["volumes"]
        assert {mount.split(":")[0] for mount in services[name]["volumes"]} <= set(
            COMPOSE["volumes"]
        )
    assert services["worker"]["deploy"]["replicas"] == 2
    assert services["service"]["ports"] == [f"127.0.0.1:8420:{DEFAULT_PORT}"]


def test_what_ends_is_started_again() -> None:
    for service in COMPOSE["services"].values():
        assert service["restart"] == "unless-stopped"
    # a task's processes may outlive it, and the first process of a container must reap them
    assert COMPOSE["services"]["service"]["init"]
    assert COMPOSE["services"]["worker"]["init"]


def test_the_services_health_command(tmp_path: Path) -> None:
    kind, program, *arguments = COMPOSE["services"]["service"]["healthcheck"]["test"]
    assert (kind, program) == ("CMD", "python")

    def healthy(url: str) -> bool:
        asked = [text.replace(f"http://127.0.0.1:{DEFAULT_PORT}", url) for text in arguments]
        assert asked != arguments
        done = subprocess.run([sys.executable, *asked], capture_output=True, check=False)
        return done.returncode == 0

    with live_service(quick_settings(tmp_path)) as live:
        assert healthy(live.url)
        (tmp_path / "blobs").rename(tmp_path / "gone")
        (tmp_path / "blobs").write_text("in the way")
        assert not healthy(live.url)
    assert not healthy(live.url)


@pytest.mark.postgres
def test_the_databases_health_command(postgres_url: str) -> None:
    kind, command = COMPOSE["services"]["database"]["healthcheck"]["test"]
    assert kind == "CMD-SHELL"
    url = sa.make_url(postgres_url)
    where = {"PGHOST": str(url.query.get("host") or url.host), "PGPORT": str(url.port or 5432)}
    programs = find_postgres()
    path = f"{programs}:{os.environ['PATH']}" if programs else os.environ["PATH"]
    healthy = subprocess.run(command, shell=True, env=where | {"PATH": path}, check=False)
    assert healthy.returncode == 0
    nowhere = {"PGHOST": "/nonexistent", "PATH": path}
    assert subprocess.run(command, shell=True, env=nowhere, check=False).returncode != 0


@pytest.mark.postgres
def test_each_command_runs(
    service_image: Image, worker_image: Image, postgres_url: str, tmp_path: Path
) -> None:
    """A service and two workers as the file starts them, and a job over REST."""
    port = free_port()
    data = tmp_path / "data"
    data.mkdir()
    with ExitStack() as stack:
        database = stack.enter_context(fresh_database(postgres_url))
        moved = {"PRTBAKE_DATABASE_URL": database}
        images = [("service", service_image)] + [("worker", worker_image)] * 2
        processes = []
        for number, (name, image) in enumerate(images):
            variables = variables_of(name) | moved
            if name == "service":
                variables |= {"PRTBAKE_HOST": "127.0.0.1", "PRTBAKE_PORT": str(port)}
            outside = {key: value.replace("/data", str(data)) for key, value in variables.items()}
            log = stack.enter_context((tmp_path / f"{name}-{number}.log").open("wb"))
            process = subprocess.Popen(
                COMPOSE["services"][name]["command"],
                env=image.environment() | outside, cwd=image.app, stdout=log, stderr=log,
            )  # fmt: skip
            stack.callback(end, process)
            processes.append(process)
        url = f"http://127.0.0.1:{port}"
        until(lambda: workers_of(url) == 2 or ended(processes), "service and workers", 120.0)
        assert not ended(processes), logs(tmp_path)
        with Client(url, key=GIVEN["PRTBAKE_API_KEY"]) as client:
            sky = EnvironmentRegistration.model_validate(
                {"builtin": {"name": "sun_sky", "width": 32}}
            )
            environment = client.register(sky).id
            settings = {"n_lobes": 12, "max_iterations": 1}
            request = {"kind": "fit_light", "environment": environment, "settings": settings}
            job = client.wait(client.submit(request).id, timeout_s=120.0, check=False)
            assert job.state == "succeeded", logs(tmp_path)
            client.download(job.id, "light.h5", tmp_path)
        assert (data / "blobs").is_dir()
        with Client(url, key="another key") as stranger, pytest.raises(Unauthorised):
            stranger.job(job.id)
        # uvicorn ends as the signal asked, after its graceful shutdown
        assert stop(processes[0]) in (0, -signal.SIGTERM)
        assert [stop(process) for process in processes[1:]] == [0, 0]


def workers_of(url: str) -> int:
    """How many workers a service that is ready knows of; -1 before it is."""
    try:
        answer = httpx.get(f"{url}/readyz", timeout=5.0, trust_env=False)
    except httpx.TransportError:
        return -1
    return int(answer.json()["workers"]) if answer.status_code == 200 else -1


def ended(processes: list[subprocess.Popen[bytes]]) -> bool:
    """Whether one of them has ended by itself."""
    return any(process.poll() is not None for process in processes)


def end(process: subprocess.Popen[bytes]) -> None:
    """Kill a process that a failed test left."""
    if process.poll() is None:
        process.kill()
    process.wait()


def logs(folder: Path) -> str:
    """The last lines that the processes wrote."""
    return "\n".join(path.read_text()[-2000:] for path in sorted(folder.glob("*.log")))
