import numpy as np
import pytest

from prtbake_storage.contract.brdf import GgxSpec
from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.checks import check_energy, check_reciprocity
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.half_difference import directions_of, half_difference
from prtbake_workers.brdf.half_difference_table import (
    HalfDifferenceTable,
    bin_angles,
    bins_above_horizon,
)
from prtbake_workers.brdf.registry import brdf_from_spec

SHAPE = (45, 30, 24)


def tabulate(brdf, shape=SHAPE):
    """Sample a model at the bin centres; below the horizon the nearest angles above it serve."""
    angles = bin_angles(*shape)
    wi, wo = directions_of(*angles)
    for w in (wi, wo):
        w[..., 2] = np.maximum(w[..., 2], 0.05)
        w /= np.linalg.norm(w, axis=-1, keepdims=True)
    value = np.broadcast_to(brdf.eval_brdf(wi, wo), (*shape, 3))
    return HalfDifferenceTable(np.ascontiguousarray(value, np.float32))


@pytest.fixture
def ggx():
    return brdf_from_spec(GgxSpec(kd=(0.3, 0.2, 0.1), ks=0.6, alpha=0.4, f0=0.2))


def test_bin_centres_give_their_values(ggx):
    table = tabulate(ggx)
    # away from the horizon, where the table holds the model itself
    h, d, p = (a.ravel() for a in np.meshgrid([3, 17, 25], [0, 4, 9], [0, 11, 23], indexing="ij"))
    angles = bin_angles(*SHAPE)
    wi, wo = directions_of(
        angles.theta_h.ravel()[h], angles.theta_d.ravel()[d], angles.phi_d.ravel()[p]
    )
    got = table.eval_brdf(wi, wo)
    np.testing.assert_allclose(got, table.values[h, d, p], rtol=1e-9)
    np.testing.assert_allclose(got, ggx.eval_brdf(wi, wo), rtol=1e-6)  # float32


def test_what_is_linear_in_the_steps_is_interpolated_exactly(directions):
    """Trilinear: exact for steps of sqrt(theta_h), theta_d and phi_d, but where a half bin ends."""
    angles = bin_angles(*SHAPE)
    quarter = np.pi / 2
    plane = (
        1.0
        + 2.0 * np.sqrt(angles.theta_h / quarter)
        + 0.5 * angles.theta_d / quarter
        + 0.25 * angles.phi_d / quarter
    )
    table = HalfDifferenceTable(np.repeat(plane[..., None], 3, axis=-1).astype(np.float32))
    wi, wo = directions(2000), directions(2000, seed=2)
    share = [a / quarter for a in half_difference(wi, wo)]
    share[0] = np.sqrt(share[0])
    inside = np.all(
        [(s > 0.5 / n) & (s < 1 - 0.5 / n) for s, n in zip(share, SHAPE, strict=True)], axis=0
    )
    assert inside.sum() > 1000
    plain = 1.0 + 2.0 * share[0] + 0.5 * share[1] + 0.25 * share[2]
    got = table.eval_brdf(wi, wo)[:, 1]
    np.testing.assert_allclose(got[inside], plain[inside], rtol=1e-6)  # float32
    # twin: theta_h in equal steps of the angle
    wrong = plain + 2.0 * (share[0] ** 2 - share[0])
    assert np.abs(wrong / got - 1)[inside].max() > 0.1


def test_error_falls_with_the_square_of_the_step(ggx, directions):
    wi, wo = directions(3000), directions(3000, seed=2)
    inside = (wi[:, 2] > 0.3) & (wo[:, 2] > 0.3)
    wi, wo = wi[inside], wo[inside]
    exact = ggx.eval_brdf(wi, wo)
    errors = [
        np.sqrt(np.mean((tabulate(ggx, shape).eval_brdf(wi, wo) - exact) ** 2))
        for shape in ((20, 20, 12), (40, 40, 24))
    ]
    assert errors[1] < 0.35 * errors[0]
    assert errors[1] < 0.01 * exact.mean()


def test_it_is_isotropic_reciprocal_and_mirror_symmetric_to_the_last_bits(ggx):
    table = tabulate(ggx)
    assert check_reciprocity(table).max_relative == 0.0
    # the factorisation tests isotropy and mirror symmetry to 1e-9
    found, model = factorise(table, n_terms=16), factorise(ggx, n_terms=16)
    np.testing.assert_allclose(found.singular_values[:8], model.singular_values[:8], rtol=0.02)


def test_where_phi_d_means_nothing_it_does_not_matter():
    """At the mirror direction and at the light itself the frame must not decide the value."""
    rng = np.random.default_rng(1)
    table = HalfDifferenceTable(rng.random((*SHAPE, 3)).astype(np.float32))
    z = np.linspace(0.1, 0.95, 30)
    s = np.sqrt(1 - z * z)
    for phi in (0.0, 1.0, 2.0):
        wi = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)
        mirror = wi * [-1, -1, 1]
        if phi == 0.0:
            there, back = table.eval_brdf(wi, mirror), table.eval_brdf(wi, wi)
        # the half vector's sine is rounding, whose root the table sees
        np.testing.assert_allclose(table.eval_brdf(wi, mirror), there, rtol=1e-5)
        np.testing.assert_allclose(table.eval_brdf(wi, wi), back, rtol=1e-5)


def test_a_constant_table_is_a_diffuse_surface():
    values = np.broadcast_to(np.float32([0.5, 0.4, 0.3]) / np.float32(np.pi), (*SHAPE, 3))
    energy = check_energy(HalfDifferenceTable(np.ascontiguousarray(values)), n_angles=3)
    np.testing.assert_allclose(energy.normal_albedo, [0.5, 0.4, 0.3], rtol=1e-6)  # float32
    assert energy.max_albedo == pytest.approx(0.5, rel=1e-6)


@pytest.mark.parametrize("bad", [-1e-3, np.nan, np.inf])
def test_negative_light_is_refused(bad):
    values = np.ones((*SHAPE, 3), np.float32)
    values[3, 2, 1, 0] = bad
    with pytest.raises(BrdfError, match="negative values or NaN"):
        HalfDifferenceTable(values)


def test_bins_above_the_horizon_are_counted():
    """Where theta_h + theta_d stays below a right angle both directions are above; phi_d decides
    between that and the same for their difference."""
    above = bins_above_horizon(*SHAPE)
    angles = bin_angles(*SHAPE)
    sure = np.broadcast_to(angles.theta_h + angles.theta_d < np.pi / 2, SHAPE)
    assert above[sure].all()
    assert 0.5 < above.mean() < 1.0
