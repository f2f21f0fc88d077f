import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.bilinear_warp import BilinearWarp, look_up, slices_at
from support.tensor_file import bilinear, sample

ONE = np.zeros(1)


@pytest.fixture
def density():
    return np.random.default_rng(2).random((2, 5, 7)).astype(np.float32)


def test_lookup_is_multilinear(rng):
    table = rng.random((4, 5, 6, 2)).astype(np.float32)
    nodes = np.array([0.0, 0.3, 0.4, 1.1])
    axes = (nodes, np.linspace(0, 1, 5), np.linspace(0, 1, 6))
    at, y, x = 1.1 * rng.random(50), rng.random(50), rng.random(50)
    got = look_up(table, slices_at(nodes, at), x, y)
    plain = RegularGridInterpolator(axes, table.astype(np.float64))(np.stack([at, y, x], -1))
    np.testing.assert_allclose(got, plain, rtol=1e-6)  # float32
    # twin: the axes of the square exchanged
    assert np.abs(look_up(table, slices_at(nodes, at), y, x) - plain).max() > 0.1
    # beyond the nodes and the square the ends are held
    far = look_up(table, slices_at(nodes, np.array([9.0])), np.array([2.0]), np.array([-1.0]))
    np.testing.assert_allclose(far[0], table[3, 0, 5])


def test_probabilities_are_integrals_of_the_density(density):
    """Marginal over y, then x given y: against midpoints of the bilinear density."""
    table, n = density[0].astype(np.float64), 2000
    x, y = 0.37, 0.81
    middle = (np.arange(n) + 0.5) / n
    value = bilinear(table, *np.meshgrid(middle, middle))
    below, whole = value[middle < y].sum(), value.sum()
    row = bilinear(table, middle, np.full(n, y))
    left = row[middle < x].sum() / row.sum()
    along, up = BilinearWarp(density).invert(slices_at(ONE, ONE), np.array([x]), np.array([y]))
    # midpoints of 1 / 2000, whose edges meet x and y
    assert up[0] == pytest.approx(below / whole, abs=1e-6)
    assert along[0] == pytest.approx(left, abs=1e-6)
    assert abs(along[0] - x) > 0.005


def test_it_undoes_sampling(density):
    """The other way round is done by fine trapezoids."""
    x, y = sample(density[0].astype(np.float64), 12)
    along, up = BilinearWarp(density).invert(
        slices_at(np.zeros(1), np.zeros(144)), x.ravel(), y.ravel()
    )
    grid = np.linspace(0, 1, 12)
    # trapezoids of 1 / 2000
    np.testing.assert_allclose(along.reshape(12, 12), np.tile(grid, (12, 1)), atol=1e-5)
    np.testing.assert_allclose(up.reshape(12, 12), np.tile(grid, (12, 1)).T, atol=1e-5)


def test_a_constant_density_leaves_places_alone(rng):
    x, y = rng.random(20), rng.random(20)
    warp = BilinearWarp(np.full((1, 4, 9), 7.0, np.float32))
    along, up = warp.invert(slices_at(np.zeros(1), x), x, y)
    np.testing.assert_allclose((along, up), (x, y), atol=1e-12)


def test_slices_are_mixed_after_each_is_normalised(density):
    """A slice counts by its share, not by how large its numbers are."""
    loud = density.copy()
    loud[1] *= 1000.0
    nodes, at = np.array([0.0, 1.0]), np.full(5, 0.4)
    x, y = np.linspace(0, 1, 5), np.linspace(0.1, 0.9, 5)
    for plain, scaled in zip(
        BilinearWarp(density).invert(slices_at(nodes, at), x, y),
        BilinearWarp(loud).invert(slices_at(nodes, at), x, y),
        strict=True,
    ):
        np.testing.assert_allclose(plain, scaled, rtol=1e-6)
    ends = [
        BilinearWarp(density).invert(slices_at(nodes, np.full(5, e)), x, y)[1] for e in (0.0, 1.0)
    ]
    mixed = BilinearWarp(density).invert(slices_at(nodes, at), x, y)[1]
    np.testing.assert_allclose(mixed, 0.6 * ends[0] + 0.4 * ends[1], rtol=1e-12)


def test_a_density_of_nothing_is_refused(density):
    density[1] = 0.0
    with pytest.raises(BrdfError, match="slice 1"):
        BilinearWarp(density)


def test_rows_without_density_give_numbers():
    density = np.zeros((1, 3, 3), np.float32)
    density[0, 2] = 1.0
    along, up = BilinearWarp(density).invert(
        slices_at(np.zeros(1), np.zeros(2)), np.array([0.5, 0.5]), np.array([0.2, 1.0])
    )
    assert np.isfinite(along).all()
    np.testing.assert_allclose(up, [0.0, 1.0], atol=1e-12)
