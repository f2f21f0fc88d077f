import numpy as np
import pytest

from prtbake_storage.contract.brdf import CookTorranceSpec, GgxSpec, LambertSpec, PhongSpec
from prtbake_storage.errors import BrdfError, SettingsError
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.spectrum import energy_lost_by_terms
from prtbake_workers.percent import percent

# enough azimuths that the grid's last order, which no basis may use, stands behind 20 others
N_THETA, N_PHI = 4, 24

COUNTS = (1, 4, 8, 16, 32, 64, 128)
# percent of the energy lost by the first K terms, with the digits of the published table; its 38.9
# for n = 200, K = 32 is 38.85 rounded a second time (the value is 38.849)
TABLE = {
    ("m", 0.5): "5.1 2.8 1.5 0.61 0.19 0.07 0.02",
    ("m", 0.3): "17.3 12.6 9.0 5.2 2.2 0.80 0.15",
    ("m", 0.2): "37.1 31.9 26.7 19.7 11.8 5.6 1.4",
    ("m", 0.1): "79.5 76.8 74.0 68.8 59.4 44.2 20.0",
    ("n", 10.0): "47.1 17.2 5.6 0.75 0.02 0.00 0.00",
    ("n", 50.0): "82.2 59.2 41.3 22.5 8.2 1.5 0.07",
    ("n", 200.0): "93.9 81.7 71.0 56.8 38.85 20.7 7.2",
}


def spec_of(kind, value):
    if kind == "m":
        return CookTorranceSpec(kd=0.3, ks=0.7, f0=0.1, m=value)
    return PhongSpec(kd=0.3, ks=0.7, exponent=value)


@pytest.mark.parametrize(("row", "percents"), TABLE.items())
def test_the_reference_spectra_come_out(row, percents):
    """Every figure of the table, to the digits that it gives."""
    found = factorise(brdf_from_spec(spec_of(*row)), n_terms=1, n_nodes=3).singular_values
    assert len(found) == 28 * 112
    for count, share in zip(COUNTS, percents.split(), strict=True):
        places = len(share.partition(".")[2])
        lost = 100 * energy_lost_by_terms(found, count)
        assert abs(lost - float(share)) <= 0.5 * 10**-places, (count, lost)


@pytest.mark.parametrize("change", [{"kd": 0.29}, {"f0": 0.11}, {"m": 0.505}, {"ks": 0.72}])
def test_the_table_tells_a_wrong_brdf(change):
    """Twin: parameters a few percent off give other digits."""
    wrong = CookTorranceSpec(m=0.5).model_copy(update=change)
    found = factorise(brdf_from_spec(wrong), n_terms=1, n_nodes=3).singular_values
    lost = [100 * energy_lost_by_terms(found, count) for count in COUNTS[:3]]
    wanted = [float(share) for share in TABLE["m", 0.5].split()[:3]]
    assert np.abs(np.subtract(lost, wanted)).max() > 0.05


def dense(brdf, n_theta, n_phi):
    """The whole weighted matrix (light, view x channels) and the grid's directions."""
    z = np.repeat((np.arange(n_theta) + 0.5) / n_theta, n_phi)
    phi = np.tile(2 * np.pi * np.arange(n_phi) / n_phi, n_theta)
    s = np.sqrt(1 - z * z)
    w = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)
    weight = z * np.sqrt(2 * np.pi / (n_theta * n_phi))
    rho = brdf.eval_brdf(w[:, None], w[None])
    matrix = rho * weight[:, None, None] * weight[:, None]
    return w, weight, rho, matrix.reshape(len(w), -1)


def test_orders_give_the_dense_decomposition(brdf):
    found = factorise(brdf, n_terms=20, n_theta=N_THETA, n_phi=N_PHI, n_nodes=3)
    w, weight, rho, matrix = dense(brdf, N_THETA, N_PHI)
    left, values, right = np.linalg.svd(matrix, full_matrices=False)
    if not found.is_constant_phi:
        np.testing.assert_allclose(found.singular_values, values, atol=1e-12 * values[0])
    np.testing.assert_allclose(found.singular_values[0], values[0], rtol=1e-12)

    k = found.n_terms
    best = ((left[:, :k] * values[:k]) @ right[:k]).reshape(rho.shape)
    best /= weight[:, None, None] * weight[:, None]
    psi, phi = found.eval_psi_exact(w), found.eval_phi_exact(w)
    got = np.einsum("ik,okc->ioc", psi, phi)
    # truncated at a whole number of pairs both sums are the one best approximation
    np.testing.assert_allclose(got, best, atol=1e-9 * rho.max())
    assert np.abs(got * 1.001 - best).max() > 1e-9 * rho.max()


def test_terms_are_orthonormal_and_psi_holds_the_singular_values(brdf):
    found = factorise(brdf, n_terms=20, n_theta=N_THETA, n_phi=N_PHI, n_nodes=3)
    if found.is_constant_phi:
        return
    w, weight, _, _ = dense(brdf, N_THETA, N_PHI)
    phi, psi = found.eval_phi_exact(w), found.eval_psi_exact(w)
    gram = np.einsum("okc,olc,o->kl", phi, phi, weight**2)
    np.testing.assert_allclose(gram, np.eye(found.n_terms), atol=1e-9)
    energy = np.diag(found.singular_values[: found.n_terms] ** 2)
    np.testing.assert_allclose(
        np.einsum("ok,ol,o->kl", psi, psi, weight**2), energy, atol=1e-11 * energy[0, 0]
    )
    # twin: with a single cosine as weight they are not orthonormal
    flat = np.einsum("okc,olc,o->kl", phi, phi, weight**2 / w[:, 2])
    assert np.abs(flat - np.eye(found.n_terms)).max() > 1e-2


@pytest.mark.parametrize(
    ("row", "asked", "kept"),
    [(("n", 10.0), 16, 15), (("n", 50.0), 16, 15), (("m", 0.3), 4, 3), (("m", 0.5), 4, 3)],
)
def test_a_pair_is_never_split(row, asked, kept):
    found = factorise(brdf_from_spec(spec_of(*row)), n_terms=asked, n_nodes=3)
    assert (found.requested_terms, found.n_terms) == (asked, kept)
    assert found.note == f"{asked} terms would split a pair: {kept} are kept"
    pairs = found.orders > 0
    assert (found.parity[pairs].reshape(-1, 2) == [0, 1]).all()
    orders = found.orders[pairs].reshape(-1, 2)
    np.testing.assert_array_equal(orders[:, 0], orders[:, 1])
    split = energy_lost_by_terms(found.singular_values, kept)
    assert found.energy_lost == pytest.approx(split, rel=1e-9)


def test_sixteen_terms_of_cook_torrance_stand_as_asked():
    found = factorise(brdf_from_spec(spec_of("m", 0.5)), n_terms=16, n_nodes=3)
    assert (found.n_terms, found.note) == (16, None)
    assert found.energy_lost == pytest.approx(0.0061, abs=5e-5)


@pytest.mark.parametrize("lost", [0.05, 0.01, 0.002])
def test_energy_chooses_the_fewest_whole_terms(lost):
    brdf = brdf_from_spec(spec_of("m", 0.5))
    found = factorise(brdf, energy_lost=lost, n_nodes=3)
    assert found.energy_lost <= lost
    fewer = factorise(brdf, n_terms=found.n_terms - 1, n_nodes=3)
    assert fewer.energy_lost > lost


def test_the_message_says_what_affordable_terms_leave():
    brdf = brdf_from_spec(spec_of("m", 0.3))
    with pytest.raises(
        SettingsError, match=r"16 terms \(of at most 16\) leave 5\.22% .* takes 3\d"
    ):
        factorise(brdf, energy_lost=0.02, max_terms=16)
    with pytest.raises(SettingsError, match=r"3 terms \(of at most 4\)"):
        factorise(brdf, energy_lost=0.02, n_terms=4)
    with pytest.raises(SettingsError, match="takes no number of terms"):
        factorise(brdf_from_spec(spec_of("m", 0.05)), energy_lost=1e-9, n_theta=4, n_phi=8)


def test_without_a_wish_the_best_affordable_is_taken_and_said():
    found = factorise(brdf_from_spec(spec_of("m", 0.3)), max_terms=16, n_nodes=3)
    assert found.n_terms == 16
    assert "leave 5.22%" in found.note
    easy = factorise(brdf_from_spec(spec_of("m", 0.5)), n_nodes=3)
    assert easy.note is None
    assert easy.energy_lost <= 0.01


def test_more_terms_than_there_are():
    found = factorise(brdf_from_spec(spec_of("m", 0.5)), n_terms=256, n_theta=2, n_phi=8, n_nodes=3)
    assert found.n_terms < 256
    assert "256 were asked for" in found.note
    assert found.orders.max() == 3


def test_a_grid_too_coarse_for_the_lobe_is_said():
    sharp = factorise(brdf_from_spec(spec_of("m", 0.05)), n_terms=9, n_nodes=3)
    assert "28 x 112 does not resolve the lobe" in sharp.note
    fine = factorise(brdf_from_spec(spec_of("m", 0.2)), n_terms=3, n_nodes=3)
    assert fine.note is None


def error_at_random(brdf, found, n=60_000):
    """Squared error with weight cos_i^2 cos_o^2 over that of the BRDF, by Monte Carlo.

    Half of the pairs are drawn near the mirror direction, where a narrow lobe is.
    """
    rng = np.random.default_rng(2)
    z, phi = rng.random((2, n)), 2 * np.pi * rng.random((2, n))
    spread = 0.15
    near = rng.random(n) < 0.5
    height = z[0] + spread * (2 * rng.random(n) - 1)
    turn = phi[0] + np.pi + spread * np.pi * (2 * rng.random(n) - 1)
    z[1], phi[1] = np.where(near, height, z[1]), np.where(near, turn, phi[1])
    inside = (z[1] > 0) & (z[1] < 1)
    away = np.abs((phi[1] - phi[0] - np.pi + np.pi) % (2 * np.pi) - np.pi)
    in_patch = (np.abs(z[1] - z[0]) < spread) & (away < spread * np.pi)
    pdf = 0.5 + 0.5 * in_patch / (2 * spread * spread)
    s = np.sqrt(np.clip(1 - z * z, 0, 1))
    wi, wo = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)[:, inside]
    weight = (z[0] * z[1])[inside] ** 2 / pdf[inside]
    rho = brdf.eval_brdf(wi, wo)[:, 0]
    sums = np.concatenate(
        [
            np.einsum("nk,nk->n", found.eval_psi(a), found.eval_phi(b)[..., 0])
            for a, b in zip(np.array_split(wi, 40), np.array_split(wo, 40), strict=True)
        ]
    )
    return float((weight * (rho - sums) ** 2).sum() / (weight * rho**2).sum())


@pytest.mark.parametrize(
    "spec", [spec_of("m", 0.1), GgxSpec(kd=0.0, ks=1.0, alpha=0.1)], ids=["m 0.1", "alpha 0.1"]
)
def test_the_energy_lost_off_the_grid_is_stated(spec):
    """128 terms on 28 x 112: what the grid says of itself is half the truth."""
    brdf = brdf_from_spec(spec)
    found = factorise(brdf, n_terms=128)
    expected = error_at_random(brdf, found)
    # 4 % is the standard error of the Monte Carlo estimate over six seeds
    assert found.energy_lost == pytest.approx(expected, rel=0.12)
    assert f"{percent(found.energy_lost)} in truth" in found.note
    # negative twin: the spectrum on the grid
    assert energy_lost_by_terms(found.singular_values, 128) < 0.7 * expected


def test_a_lobe_that_the_terms_make_worse_than_nothing_is_refused():
    with pytest.raises(BrdfError, match=r"127 terms .* miss 139% .* too narrow") as caught:
        factorise(brdf_from_spec(spec_of("m", 0.05)), n_terms=128)
    assert caught.value.pointer == "/brdf"


@pytest.mark.parametrize("albedo", [0.6, (0.7, 0.2, 0.1), 0.0])
def test_a_diffuse_brdf_is_one_constant_term(albedo, directions):
    found = factorise(brdf_from_spec(LambertSpec(albedo=albedo)), n_terms=16)
    assert (found.n_terms, found.is_constant_phi, found.energy_lost) == (1, True, 0.0)
    assert found.note == "a constant BRDF needs 1 term, not 16"
    w = directions(20)
    # one rounding to float32
    np.testing.assert_allclose(found.eval_psi(w), 1 / np.pi, rtol=1e-7)
    np.testing.assert_allclose(
        found.eval_phi(w)[:, 0], np.tile(np.atleast_1d(albedo), (20, 1)), rtol=1e-7
    )
    np.testing.assert_array_equal(found.eval_psi_exact(w), 1 / np.pi)


def test_any_model_without_a_lobe_is_diffuse():
    assert factorise(brdf_from_spec(CookTorranceSpec(kd=0.5, ks=0.0))).is_constant_phi
    assert not factorise(
        brdf_from_spec(CookTorranceSpec(kd=0.5, ks=1e-6)), n_terms=1
    ).is_constant_phi


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"n_terms": 0}, "n_terms"),
        ({"energy_lost": 0.0}, "energy_lost"),
        ({"energy_lost": 1.0}, "energy_lost"),
        ({"n_theta": 1}, "n_theta"),
        ({"n_phi": 7}, "n_phi"),
    ],
)
def test_impossible_settings_name_the_field(settings, field):
    with pytest.raises(SettingsError, match=field):
        factorise(brdf_from_spec(CookTorranceSpec()), **settings)


def test_an_anisotropic_brdf_that_does_not_say_so_is_refused():
    class Brushed:
        n_channels = 1

        def eval_brdf(self, wi, wo):
            h = wi + wo
            return np.exp(-((h[..., 0] / h[..., 2]) ** 2))[..., None]

    with pytest.raises(BrdfError, match="isotropic"):
        factorise(Brushed(), n_terms=1)


def test_equal_inputs_give_equal_bytes():
    first, second = (
        factorise(brdf_from_spec(spec_of("n", 10.0)), n_terms=9, n_nodes=9).tables()
        for _ in range(2)
    )
    for name, value in first.items():
        assert np.asarray(value).tobytes() == np.asarray(second[name]).tobytes()
