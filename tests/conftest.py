"""Fixtures that every test may use.

``PRTBAKE_DATA`` names the folder with the ``meshes``, ``environments`` and ``brdfs`` of the
real-data suite.  Where it is unset, the tests marked ``real_data`` are deselected (never skipped).
Likewise those marked ``postgres`` where neither ``PRTBAKE_TEST_POSTGRES_URL`` nor an installed
server gives them one, and those marked ``own_postgres`` where none is installed;
``PRTBAKE_REQUIRE_POSTGRES=1`` (set in CI) keeps them, so that they fail instead.
Those marked ``mitsuba`` are deselected where Mitsuba 3 is not installed, those marked ``long``
unless the command asks for them by that name.
"""

import gc
import importlib.util
import os
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np
import pytest

from prtbake_storage.testing.postgres import (
    available,
    find_postgres,
    fresh_database,
    postgres_server,
)
from support.shape_checks import begin_test, check_rarely

# before any module of the workers is imported
check_rarely()

DATA_VARIABLE = "PRTBAKE_DATA"
POSTGRES_VARIABLE = "PRTBAKE_REQUIRE_POSTGRES"


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep what is imported and collected out of garbage collection: it lives to the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect what this machine lacks the data or the server for, and say so."""
    lacking = []
    if not os.environ.get(DATA_VARIABLE):
        lacking.append("real_data")
    if not os.environ.get(POSTGRES_VARIABLE):
        if not available():
            lacking.append("postgres")
        if find_postgres() is None:
            lacking.append("own_postgres")
    if not has_mitsuba():
        lacking.append("mitsuba")
    if "long" not in config.option.markexpr:
        lacking.append("long")
    out = [item for item in items if any(item.get_closest_marker(name) for name in lacking)]
    if out:
        config.hook.pytest_deselected(items=out)
        gone = set(out)
        items[:] = [item for item in items if item not in gone]


def pytest_runtest_setup() -> None:
    """Every test checks shapes anew."""
    begin_test()


def pytest_report_header() -> list[str]:
    """Tell in the first lines what will be deselected."""
    header = []
    if not os.environ.get(DATA_VARIABLE):
        header.append(f"real data: none ({DATA_VARIABLE} is unset): its tests are deselected")
    if not available():
        fate = "fail" if os.environ.get(POSTGRES_VARIABLE) else "are deselected"
        header.append(f"postgresql: not installed: its tests {fate}")
    if not has_mitsuba():
        header.append("mitsuba: not installed: its tests are deselected")
    return header


def has_mitsuba() -> bool:
    """Whether Mitsuba 3 can be compared with."""
    return importlib.util.find_spec("mitsuba") is not None


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of the real data; asking for it without the marker ``real_data`` is an error."""
    folder = os.environ.get(DATA_VARIABLE)
    if not folder:
        raise RuntimeError(f"{DATA_VARIABLE} is unset: mark the test with real_data")
    path = Path(folder)
    if not (path / "meshes").is_dir():
        raise RuntimeError(f"{DATA_VARIABLE} holds no folder 'meshes': {path}")
    return path


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with the same start for every test."""
    return np.random.default_rng(20061101)


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[str]:
    """A PostgreSQL server, started once a session; asking for it needs the marker ``postgres``."""
    with postgres_server() as url:
        yield url


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """An empty database, once on SQLite and once on PostgreSQL."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path / 'prtbake.sqlite'}"
        return
    with fresh_database(request.getfixturevalue("postgres_url")) as url:
        yield url
