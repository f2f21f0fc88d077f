"""Transfer tensors for the compressors' tests."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray


def _synthetic_transfer(n_verts: int, n_terms: int, n_coeffs: int) -> NDArray[np.float32]:
    path = Path(__file__).resolve().parents[1] / "synthetic_transfer.py"
    spec = importlib.util.spec_from_file_location("synthetic_transfer", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.synthetic_transfer(n_verts, n_terms, n_coeffs)


@pytest.fixture(scope="session")
def glossy() -> NDArray[np.float32]:
    """(600, 9, 81) transfer of a bumpy sphere with a shadow edge; not to be written to."""
    transfer = _synthetic_transfer(600, 9, 81)
    transfer.flags.writeable = False
    return transfer


def _in_three_channels(transfer: NDArray[np.float32]) -> NDArray[np.float32]:
    """(verts, 3 * terms, coeffs): by falling factors, each with noise of 5 % of the root mean square."""
    rng = np.random.default_rng(7)
    size = 0.05 * np.sqrt(np.mean(transfer.astype(float) ** 2))
    channels = [
        factor * transfer + size * rng.standard_normal(transfer.shape)
        for factor in (1.0, 0.5, 0.25)
    ]
    rows = np.concatenate(channels, axis=1).astype(np.float32)
    rows.flags.writeable = False
    return rows


@pytest.fixture(scope="session")
def coloured(glossy: NDArray[np.float32]) -> NDArray[np.float32]:
    """(600, 27, 81): ``glossy`` in red, green and blue, row c * 9 + k."""
    return _in_three_channels(glossy)


@pytest.fixture(scope="session")
def diffuse(glossy: NDArray[np.float32]) -> NDArray[np.float32]:
    """(600, 81): the first term of ``glossy``."""
    signal = np.ascontiguousarray(glossy[:, 0])
    signal.flags.writeable = False
    return signal
