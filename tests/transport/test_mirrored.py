"""The product by mirrored halves against the plain one."""

import json
from dataclasses import replace

import numpy as np
import pytest

from prtbake_workers.basis.projection import explained_energy
from prtbake_workers.basis.sh_basis import ShBasis
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.left_side import Workspace, fold_pairs, unfold_pairs
from prtbake_workers.transport.mirrored import (
    MirroredProduct,
    product_from_tables,
    product_of,
)
from prtbake_workers.transport.plain_product import PlainProduct

CUBE = cube_directions(12)
BASES = {
    "srbf": SrbfBasis(icosphere(2)),
    "few srbf": SrbfBasis(icosphere(0)),
    "sh": ShBasis(5),
    "one": ShBasis(1),
    "four": ShBasis(2),
}


def projection_of(name):
    return BASES[name].projection(CUBE.directions, CUBE.weights)


def seen_samples(rng, axis, n_terms=3, n_verts=20):
    """Samples that are zero under a horizon, of float32, and the directions above it."""
    above = np.flatnonzero(CUBE.directions @ (axis / np.linalg.norm(axis)) > -0.1)
    samples = np.zeros((n_terms, n_verts, CUBE.n), np.float32)
    samples[..., above] = rng.normal(size=(n_terms, n_verts, len(above)))
    return samples, above


def projected(product, samples, above, n_coeffs):
    """Coefficients of all vertices, and what they explain."""
    picked, work = product.pick(above), Workspace()
    folded = samples[..., picked.directions].copy()
    fold_pairs(folded, picked.n_pairs, work)
    out = np.zeros((samples.shape[1], len(samples), n_coeffs), np.float32)
    rows = np.arange(samples.shape[1])
    return out, product.unfold(product.multiply(folded, picked, work), out, rows, work)


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.3, 0.5, -0.7]])
def test_halves_give_the_plain_product(name, axis, rng):
    projection = projection_of(name)
    product = MirroredProduct.of(projection, CUBE.directions)
    assert product is not None
    samples, above = seen_samples(rng, np.array(axis))
    out, explained = projected(product, samples, above, projection.n_coeffs)
    weighted = samples.astype(np.float64) / np.sqrt(projection.weights)
    expected = (weighted @ projection.matrix).transpose(1, 0, 2)
    # float32 sums over some 500 directions: 1e-6 measured
    atol = 5e-6 * np.abs(expected).max()
    np.testing.assert_allclose(out, expected, rtol=0, atol=atol)
    other = np.roll(out, 1, axis=0 if name == "one" else 2)
    assert np.abs(other - expected).max() > 100 * atol
    plain = explained_energy(out, projection.rest.astype(np.float32))
    np.testing.assert_allclose(explained, plain, rtol=2e-6)
    without = np.square(out, dtype=np.float64).sum(axis=(1, 2))
    if name in (
        "srbf",
        "few srbf",
    ):  # whose functions the directions resolve: nothing but the ridge is left
        assert np.abs(without / plain - 1.0).max() > 1e-5


def test_pairs_cover_what_is_seen_and_little_more():
    product = MirroredProduct.of(projection_of("srbf"), CUBE.directions)
    d = CUBE.directions
    for axis in np.eye(3):
        above = np.flatnonzero(d @ axis > 0.0)
        picked = product.pick(above)
        n, m = picked.n_pairs
        np.testing.assert_array_equal(np.sort(picked.directions), above)
        mirror, turn = d[picked.directions[: 2 * n]], d[picked.directions[2 * n :]]
        np.testing.assert_allclose(mirror[n:], mirror[:n] * [1, 1, -1], rtol=0, atol=1e-12)
        np.testing.assert_allclose(turn[m:], turn[:m] * [-1, -1, 1], rtol=0, atol=1e-12)
        assert (m == 0) == (axis[2] == 0.0)
    band = np.flatnonzero(np.abs(d @ [0.6, 0.0, 0.8]) < 0.2)
    assert np.isin(band, product.pick(band).directions).all()


def test_folding_is_undone(rng):
    samples = rng.normal(size=(2, 3, 15)).astype(np.float32)
    folded = samples.copy()
    fold_pairs(folded, (4, 3), Workspace())
    np.testing.assert_array_equal(folded[..., :4], samples[..., :4] + samples[..., 4:8])
    np.testing.assert_array_equal(folded[..., 11:14], samples[..., 8:11] - samples[..., 11:14])
    np.testing.assert_array_equal(folded[..., 14], samples[..., 14])
    for vertex in range(3):
        again = folded[:, vertex].copy()
        unfold_pairs(again, (4, 3))
        np.testing.assert_allclose(again, samples[:, vertex], rtol=0, atol=1e-6)


def test_a_projection_without_symmetry_is_told(rng):
    """Each of these lacks something: a product by halves would be wrong."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turned = SrbfBasis(icosphere(1) @ turn).projection(CUBE.directions, CUBE.weights)
    assert MirroredProduct.of(turned, CUBE.directions) is None
    odd = cube_directions(5)
    lying_in_the_mirror = BASES["few srbf"].projection(odd.directions, odd.weights)
    assert MirroredProduct.of(lying_in_the_mirror, odd.directions) is None
    sound = projection_of("srbf")
    other_samples = sound.samples.copy()
    other_samples[7, 11] *= 1.001
    other_gram = sound.gram.copy()
    other_gram[3, 3] *= 1.001
    other_weights = sound.weights.copy()
    other_weights[5] *= 1.001
    for damaged in (
        replace(sound, samples=other_samples),
        replace(sound, gram=other_gram),
        replace(sound, weights=other_weights),
    ):
        assert MirroredProduct.of(damaged, CUBE.directions) is None


@pytest.mark.parametrize(("centres", "resolution"), [(642, 32), (2562, 8)])
def test_the_bases_of_jobs_have_it(centres, resolution):
    """Else every bake would multiply as much as before, and nothing would tell."""
    cube, level = cube_directions(resolution), {642: 3, 2562: 4}[centres]
    projection = SrbfBasis(icosphere(level)).projection(cube.directions, cube.weights)
    assert isinstance(product_of(projection, cube.directions), MirroredProduct)


@pytest.mark.parametrize(
    ("name", "resolution"), [("srbf", 12), ("sh", 12), ("one", 12), ("four", 12), ("sh", 5)]
)
def test_a_product_is_read_as_it_was_written(name, resolution, rng):
    cube = cube_directions(resolution)
    projection = BASES[name].projection(cube.directions, cube.weights)
    product = product_of(projection, cube.directions)
    assert isinstance(product, MirroredProduct if resolution == 12 else PlainProduct)
    arrays, numbers = product.tables()
    again = product_from_tables(arrays, json.loads(json.dumps(numbers)))
    samples = rng.normal(size=(2, 3, cube.n)).astype(np.float32)
    everywhere = np.arange(cube.n)
    for one, other in zip(
        projected(product, samples, everywhere, projection.n_coeffs),
        projected(again, samples, everywhere, projection.n_coeffs),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
        assert one.any()
