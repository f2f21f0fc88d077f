import numpy as np
import pytest

from prtbake_workers.brdf.radial_table import CHUNK, RadialTable, cosines_of_nodes

# unit 0: order 0; unit 1: order 3; unit 2: order 1
ORDERS = np.array([0, 3, 3, 1, 1], np.int32)
PARITY = np.array([0, 0, 1, 0, 1], np.int32)
UNIT = np.array([0, 1, 1, 2, 2], np.int32)


def radial(z):
    sine = np.sqrt(1 - z * z)
    return np.stack([np.exp(z), sine**3 * (1 + z), sine / (1 + z)], axis=-1)


def exact(w):
    phi = np.arctan2(w[:, 1], w[:, 0])
    waves = np.stack(
        [np.ones_like(phi), np.cos(3 * phi), np.sin(3 * phi), np.cos(phi), np.sin(phi)]
    )
    return (radial(w[:, 2])[:, UNIT].T * waves).T


def table(n_nodes):
    values = radial(cosines_of_nodes(n_nodes)).astype(np.float32)[..., None]
    return RadialTable(values, UNIT, ORDERS, PARITY)


@pytest.mark.parametrize("n_nodes", [65, 257])
def test_interpolation_error_falls_with_the_square_of_the_step(directions, n_nodes):
    w = directions(2000)
    got = table(n_nodes).evaluate(w)[..., 0]
    error = np.abs(got - exact(w)).max()
    # second derivative in r at most 16, over 8; float32 nodes add 1e-7
    bound = 2.0 / (n_nodes - 1) ** 2 + 4e-7
    assert error < bound
    # twin: the nearest node instead of the line between two
    assert (
        np.abs(radial(cosines_of_nodes(n_nodes))[1:] - radial(cosines_of_nodes(n_nodes))[:-1]).max()
        > bound
    )


def test_float32_lookup_agrees(directions):
    w = directions(CHUNK + 1000).astype(np.float32)
    lookup = table(257)
    x, y, z = w.T.copy()
    got = lookup.look_up(x, y, z)
    assert got.dtype == np.float32
    assert got.shape == (5, len(w))
    # a few roundings of values up to e
    np.testing.assert_allclose(got.T, lookup.evaluate(w.astype(np.float64))[..., 0], atol=3e-6)
    wrong = lookup.look_up(y, x, z)
    assert np.abs(wrong - got).max() > 0.1


def test_lookup_writes_where_it_is_told(directions):
    x, y, z = directions(50).astype(np.float32).T.copy()
    out = np.full((5, 50), np.nan, np.float32)
    got = table(65).look_up(x, y, z, out)
    assert got is out
    np.testing.assert_array_equal(out, table(65).look_up(x, y, z))


def test_pole_horizon_and_below():
    w = np.array([[0, 0, 1.0], [1, 0, 0], [0.6, 0, -0.8], [0, 0, -1]])
    wide = table(65).evaluate(w)[..., 0]
    fast = table(65).look_up(*w.astype(np.float32).T.copy()).T
    np.testing.assert_allclose(wide[0], [np.e, 0, 0, 0, 0], rtol=1e-6)
    for values in (wide, fast):
        assert np.isfinite(values).all()
        assert not values[1:].any()
    # just above the horizon the last node counts, not the zeros behind it
    z = 1e-4
    above = table(65).evaluate(np.array([[np.sqrt(1 - z * z), 0, z]]))[0, :, 0]
    np.testing.assert_allclose(above, exact(np.array([[np.sqrt(1 - z * z), 0, z]]))[0], atol=1e-3)


def test_columns_are_evaluated_together(directions):
    w = directions(100)
    one = table(65)
    two = RadialTable(np.concatenate([one.values, 2 * one.values], axis=2), UNIT, ORDERS, PARITY)
    got = two.evaluate(w)
    np.testing.assert_array_equal(got[..., 0], one.evaluate(w)[..., 0])
    np.testing.assert_allclose(got[..., 1], 2 * got[..., 0], rtol=1e-15)
    x, y, z = w.astype(np.float32).T.copy()
    np.testing.assert_array_equal(two.look_up(x, y, z), one.look_up(x, y, z))
