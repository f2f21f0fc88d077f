"""The product by mirrored halves against the plain one."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_workers.basis.sh_basis import ShBasis
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.left_side import Workspace, fold_pairs, unfold_pairs
from prtbake_workers.transport.mirrored import MirroredProduct, mirrored_product

CUBE = cube_directions(12)
BASES = {"srbf": SrbfBasis(icosphere(2)), "few srbf": SrbfBasis(icosphere(0)), "sh": ShBasis(5)}


def projection_of(name):
    return BASES[name].projection(CUBE.directions, CUBE.weights)


def seen_samples(rng, axis, n_terms=3, n_verts=20):
    """Samples that are zero under a horizon, of float32, and the directions above it."""
    above = np.flatnonzero(CUBE.directions @ (axis / np.linalg.norm(axis)) > -0.1)
    samples = np.zeros((n_terms, n_verts, CUBE.n), np.float32)
    samples[..., above] = rng.normal(size=(n_terms, n_verts, len(above)))
    return samples, above


def projected(product, samples, above):
    """Coefficients by halves of all vertices, and what they explain."""
    paired, work = product.pair(above), Workspace()
    folded = samples[..., paired.directions].copy()
    fold_pairs(folded, paired.n_pairs, work)
    out = np.zeros((samples.shape[1], len(samples), len(product.places)), np.float32)
    rows = np.arange(samples.shape[1])
    return out, product.unfold(product.multiply(folded, paired, work), out, rows, work)


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.3, 0.5, -0.7]])
def test_halves_give_the_plain_product(name, axis, rng):
    projection = projection_of(name)
    product = MirroredProduct.of(projection, CUBE.directions)
    assert product is not None
    samples, above = seen_samples(rng, np.array(axis))
    out, explained = projected(product, samples, above)
    weighted = samples.astype(np.float64) / np.sqrt(projection.weights)
    expected = (weighted @ projection.matrix).transpose(1, 0, 2)
    # float32 sums over some 500 directions: 1e-6 measured
    atol = 5e-6 * np.abs(expected).max()
    np.testing.assert_allclose(out, expected, rtol=0, atol=atol)
    assert np.abs(np.roll(out, 1, axis=2) - expected).max() > 100 * atol
    energy = np.full(len(out), 1e3 * explained.max())
    plain = energy - projection.residual_energy(energy, out)
    np.testing.assert_allclose(explained, plain, rtol=2e-6)
    without = np.square(out, dtype=np.float64).sum(axis=(1, 2))
    if name != "sh":  # whose functions the directions resolve: nothing but the ridge is left
        assert np.abs(without / plain - 1.0).max() > 1e-5


def test_pairs_cover_what_is_seen_and_little_more():
    product = MirroredProduct.of(projection_of("srbf"), CUBE.directions)
    d = CUBE.directions
    for axis in np.eye(3):
        above = np.flatnonzero(d @ axis > 0.0)
        paired = product.pair(above)
        n, m = paired.n_pairs
        np.testing.assert_array_equal(np.sort(paired.directions), above)
        mirror, turn = d[paired.directions[: 2 * n]], d[paired.directions[2 * n :]]
        np.testing.assert_allclose(mirror[n:], mirror[:n] * [1, 1, -1], rtol=0, atol=1e-12)
        np.testing.assert_allclose(turn[m:], turn[:m] * [-1, -1, 1], rtol=0, atol=1e-12)
        assert (m == 0) == (axis[2] == 0.0)
    band = np.flatnonzero(np.abs(d @ [0.6, 0.0, 0.8]) < 0.2)
    assert np.isin(band, product.pair(band).directions).all()


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
    other_matrix = sound.matrix.copy()
    other_matrix[7, 11] *= 1.001
    other_gram = sound.gram.copy()
    other_gram[3, 3] *= 1.001
    other_weights = sound.weights.copy()
    other_weights[5] *= 1.001
    for damaged in (
        replace(sound, matrix=other_matrix),
        replace(sound, gram=other_gram),
        replace(sound, weights=other_weights),
    ):
        assert MirroredProduct.of(damaged, CUBE.directions) is None


def test_it_is_made_once_for_a_projection():
    projection = projection_of("srbf")
    first = mirrored_product(projection, CUBE.directions)
    assert mirrored_product(projection, CUBE.directions.copy()) is first
    assert mirrored_product(projection_of("srbf"), CUBE.directions) is not first
