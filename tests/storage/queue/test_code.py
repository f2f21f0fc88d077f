"""The digest of the code: what changes it, and what must not."""

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

import prtbake_workers
from prtbake_storage.queue import code
from prtbake_storage.queue.code import PACKAGES, SOURCES, code_version, source_digests


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / "package"
    (folder / "templates").mkdir(parents=True)
    (folder / "__init__.py").write_text("A = 1\n")
    (folder / "templates" / "page.html").write_text("<p>{{ a }}</p>")
    return folder


def test_every_file_of_a_package_counts_by_name_and_content(package: Path) -> None:
    first = source_digests(package)
    assert set(first) == {"__init__.py", "templates/page.html"}
    (package / "templates" / "page.html").write_text("<b>{{ a }}</b>")
    second = source_digests(package)
    assert second["__init__.py"] == first["__init__.py"]
    assert second["templates/page.html"] != first["templates/page.html"]
    (package / "__init__.py").rename(package / "other.py")
    assert source_digests(package)["other.py"] == first["__init__.py"]


def test_where_a_package_lies_and_what_python_caches_do_not_count(package: Path) -> None:
    first = source_digests(package)
    (package / "__pycache__").mkdir()
    (package / "__pycache__" / "__init__.cpython-311.pyc").write_bytes(b"bytecode")
    (package / ".page.html.swp").write_bytes(b"an editor's")
    moved = package.rename(package.with_name("elsewhere"))
    assert source_digests(moved) == first
    assert source_digests(None) == {}


def test_all_processes_of_an_installation_agree(tmp_path: Path) -> None:
    program = "from prtbake_storage.queue.code import code_version; print(code_version())"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONHASHSEED": "77"}
    other = subprocess.check_output(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, text=True
    )
    assert other.strip() == code_version()


def test_the_workers_shaders_and_templates_are_seen_without_importing_them() -> None:
    seen = source_digests(Path(prtbake_workers.__file__).parent)
    assert {"render/programs/shade.frag", "report/templates/report.html"} <= set(seen)
    assert len(seen) > 100
    program = (
        "import sys; from prtbake_storage.queue.code import code_version; code_version();"
        "assert not {'prtbake_workers', 'numpy'} & set(sys.modules)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)


@pytest.mark.parametrize("changed", PACKAGES)
def test_each_package_counts(monkeypatch: pytest.MonkeyPatch, changed: str) -> None:
    first, version = code_version(), metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: "0" if name == changed else version(name))
    assert code_version.__wrapped__() != first


@pytest.mark.parametrize("gone", SOURCES)
def test_each_source_counts(monkeypatch: pytest.MonkeyPatch, gone: str) -> None:
    assert code_version.__wrapped__() == code_version()
    monkeypatch.setattr(code, "SOURCES", [name for name in SOURCES if name != gone])
    assert code_version.__wrapped__() != code_version()


def test_every_package_is_one_that_is_installed() -> None:
    # a name misspelt would silently never count
    assert all(metadata.version(name) for name in PACKAGES)


def test_a_package_that_is_not_there_counts_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    first = code_version()
    monkeypatch.setattr(code, "SOURCES", [*SOURCES[1:], "no_such_package"])
    monkeypatch.setattr(code, "PACKAGES", [*PACKAGES[1:], "no-such-package"])
    assert code_version.__wrapped__() not in ("", first)
