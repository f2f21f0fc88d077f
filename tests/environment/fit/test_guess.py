"""The first guess: coverage, marks, and what happens when they run out."""

import numpy as np
import pytest

from prtbake_workers.environment.environment import lat_long_directions, lat_long_solid_angles
from prtbake_workers.environment.fit.cells import Cells, even_cells
from prtbake_workers.environment.fit.guess import estimate_coverage, guess_lobes


def light(radiance) -> Cells:
    """Merged cells of a 64 x 32 light given by a function of direction."""
    directions = lat_long_directions(32, 64)
    values = np.repeat(radiance(directions)[:, None], 3, axis=1)
    return even_cells(Cells(directions, values, lat_long_solid_angles(32, 64)), 8)


def disc(directions):
    return np.where(directions[:, 0] > np.cos(0.5), 10.0, 1.0)


def test_coverage_ends_where_the_light_changes() -> None:
    cells = light(disc)
    coverage = estimate_coverage(cells)
    middle = np.argmax(cells.directions[:, 0])
    # a tenth of a cone of 0.5 may differ: sqrt(1.1) wider; cells are 0.2 wide
    assert 0.35 < coverage[middle] < 0.75
    opposite = np.argmin(cells.directions[:, 0])
    assert coverage[opposite] > 1.5


def test_an_even_light_is_covered_widely() -> None:
    assert estimate_coverage(light(lambda d: np.ones(len(d)))).min() == pytest.approx(np.pi / 2)


def test_centres_keep_out_of_each_others_coverage(rng) -> None:
    cells = light(lambda d: 1 + d[:, 1] ** 2)
    lobes = guess_lobes(cells, 12, rng)
    cosines = lobes.centres @ lobes.centres.T
    np.fill_diagonal(cosines, -1)
    coverage = 1 / np.sqrt(lobes.bandwidths)
    nearest = np.arccos(np.clip(cosines.max(axis=1), -1, 1))
    # coverages may have shrunk after a centre was chosen, never grown
    assert (nearest > 0.99 * coverage.min()).all()
    assert len(np.unique(lobes.centres.round(12), axis=0)) == 12


@pytest.mark.parametrize("n_lobes", [1, 50, 384, 1000])
def test_as_many_lobes_as_asked_but_one_a_cell(rng, n_lobes) -> None:
    cells = light(disc)
    lobes = guess_lobes(cells, n_lobes, rng)
    assert lobes.centres.shape == (min(n_lobes, len(cells.solid_angles)), 3)
    assert len(np.unique(lobes.centres, axis=0)) == len(lobes.centres)
    assert np.isfinite(lobes.bandwidths).all()
    assert (lobes.bandwidths > 0).all()


def test_the_brightest_wide_direction_comes_first(rng) -> None:
    lobes = guess_lobes(light(lambda d: np.exp(3 * d[:, 2])), 3, rng)
    assert lobes.centres[0, 2] > 0.8
