"""Fixtures that every test may use.

``PRTBAKE_DATA`` names the folder with the ``meshes``, ``environments`` and ``brdfs`` of the
real-data suite.  Where it is unset, the tests marked ``real_data`` are deselected (never skipped).
"""

import os
from pathlib import Path

import numpy as np
import pytest

DATA_VARIABLE = "PRTBAKE_DATA"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect what reads the real data when nothing says where it lies."""
    if os.environ.get(DATA_VARIABLE):
        return
    without_data = [item for item in items if item.get_closest_marker("real_data")]
    if without_data:
        config.hook.pytest_deselected(items=without_data)
        items[:] = [item for item in items if not item.get_closest_marker("real_data")]


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
