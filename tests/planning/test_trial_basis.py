"""Trial fits against the whitened projection that a bake makes."""

import numpy as np
import pytest

from prtbake_workers.basis.srbf import SrbfBasis, default_bandwidth
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.planning.sampled_transfer import ProbeDirections
from prtbake_workers.planning.trial_basis import DIRECTIONS_PER_BLOCK, TrialBasis
from prtbake_workers.transport.directions import cube_directions


@pytest.fixture
def lobes(rng):
    """Clamped cosines of some sharpness: smooth, and with an edge."""
    axes = rng.standard_normal((6, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]

    def evaluate(at):
        cosines = np.maximum(at.directions @ axes.T, 0.0)
        return ((cosines ** [1, 1, 2, 4, 8, 1]) * at.root_weights[:, None]).T.astype(np.float32)

    return evaluate


# with 5 the fit of 162 functions swings between its 150 directions; 20 are two blocks of them
@pytest.mark.parametrize("resolution", [5, 12, 20])
def test_a_fit_is_that_of_the_whitened_basis(rng, lobes, resolution):
    centres, bandwidth = icosphere(2), default_bandwidth(162)
    at = ProbeDirections.of_cube(resolution, 1)
    held_out = ProbeDirections.held_out(9, rng)
    trial = TrialBasis.of(centres, bandwidth)
    found = trial.missed(held_out, lobes(held_out), trial.fit(at, lobes(at)))

    basis, cube = SrbfBasis(centres, bandwidth), cube_directions(resolution)
    assert (cube.n > DIRECTIONS_PER_BLOCK) == (resolution == 20)
    samples = lobes(at).astype(np.float64) / np.sqrt(cube.weights)
    whitened = samples @ basis.projection(cube.directions, cube.weights).matrix
    fitted = whitened @ basis.reconstruction_matrix(held_out.directions).T
    expected = ((lobes(held_out) - fitted * held_out.root_weights) ** 2).sum(axis=1)
    # both solve systems of condition 1e5 to 1e7 in float64, for functions given in float32
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    # negative twin: of other functions, and at the directions of the fit, something else is missed
    other = TrialBasis.of(centres, 1.2 * bandwidth)
    apart = other.missed(held_out, lobes(held_out), other.fit(at, lobes(at)))
    assert np.abs(apart / expected - 1.0).max() > 0.01
    own = trial.missed(at, lobes(at), trial.fit(at, lobes(at)))
    assert np.abs(own / expected - 1.0).max() > 0.01
