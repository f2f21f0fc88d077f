"""Sampled transfer for the baselines' tests."""

import numpy as np
import pytest
from numpy.typing import NDArray

N_TEXELS = 96


@pytest.fixture(scope="session")
def sampled() -> NDArray[np.float32]:
    """(80, 4, 96): made-up transfer over a cube map of 4 x 4 texels a face."""
    rng = np.random.default_rng(11)
    smooth = rng.standard_normal((80, 5)) @ rng.standard_normal((5, 4 * N_TEXELS))
    transfer = smooth + 0.1 * rng.standard_normal(smooth.shape)
    # what an object on a plane never sees
    transfer = transfer.reshape(80, 4, N_TEXELS) * (np.arange(N_TEXELS) < 64)
    transfer = transfer.astype(np.float32)
    transfer.flags.writeable = False
    return transfer
