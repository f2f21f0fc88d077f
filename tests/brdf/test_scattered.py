import numpy as np
import pytest

from prtbake_storage.contract.brdf import CookTorranceSpec, LafortuneLobe, LafortuneSpec
from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.checks import check_energy, check_reciprocity
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.scattered import interpolate_scattered
from prtbake_workers.brdf.scattered_text import read_scattered_text
from support.scattered_file import alta_text, goniometer, grey_samples, spectral_text

ROUGH = brdf_from_spec(CookTorranceSpec(kd=0.2, ks=0.8, m=0.5, f0=0.3))


def measured(brdf, n_lights=8, n_rings=12):
    angles = goniometer(n_lights, n_rings)
    return read_scattered_text(spectral_text(*angles, grey_samples(brdf, *angles)))


@pytest.fixture(scope="module")
def rough():
    return interpolate_scattered(measured(ROUGH))


def off(table, directions, n=4000):
    """Relative L2, cosine-weighted, where the goniometer measures."""
    wi, wo = directions(n), directions(n, seed=2)
    kept = (np.minimum(wi[:, 2], wo[:, 2]) > np.cos(np.deg2rad(75))) & (
        np.maximum(wi[:, 2], wo[:, 2]) < np.cos(np.deg2rad(10))
    )
    wi, wo = wi[kept], wo[kept]
    weight = (wi[:, 2] * wo[:, 2])[:, None]
    exact = ROUGH.eval_brdf(wi, wo)
    return np.linalg.norm((table.eval_brdf(wi, wo) - exact) * weight) / np.linalg.norm(
        np.repeat(exact, 3, axis=1) * weight
    )


def test_a_measured_model_is_the_model(rough, directions):
    table, report = rough
    # highlights 30 degrees wide, sampled every 7 to 10: 1.6 % measured
    assert off(table, directions) < 0.03
    assert report["at_samples"]["relative_l2"] < 0.02
    assert report["warnings"] == []


def test_what_was_held_out_tells_the_error(rough, directions):
    """A fifth fewer samples cost a little more than the table itself is off."""
    table, report = rough
    assert off(table, directions) < report["held_out"]["relative_l2"] < 0.08
    sharp = brdf_from_spec(CookTorranceSpec(kd=0.2, ks=0.8, m=0.1))
    _, of_sharp = interpolate_scattered(measured(sharp))
    assert of_sharp["held_out"]["relative_l2"] > 2 * report["held_out"]["relative_l2"]


def test_fewer_samples_are_further_off(rough, directions):
    table, _ = interpolate_scattered(measured(ROUGH, n_lights=4, n_rings=5))
    assert off(table, directions) > 2 * off(rough[0], directions)


def test_it_serves_transfer(rough):
    table, _ = rough
    assert check_reciprocity(table).max_relative == 0.0
    energy = check_energy(table, n_angles=3)
    assert energy.conserves
    model = check_energy(ROUGH, n_angles=3)
    np.testing.assert_allclose(energy.normal_albedo, model.normal_albedo * 3, rtol=0.05)
    # beyond 80 degrees nothing was measured, where the model has its steepest rise
    assert factorise(table, n_terms=16, n_nodes=33).energy_lost < 0.01


def test_nothing_exceeds_what_was_measured(rough):
    table, _ = rough
    values = measured(ROUGH).values
    assert values.min() * 0.999 <= table.values.min()
    assert table.values.max() <= values.max() * 1.001


def test_a_retro_reflectors_peak_stays_at_the_light():
    lobe = LafortuneLobe(weight=3.0, cx=1.0, cy=1.0, exponent=40.0)
    retro = brdf_from_spec(LafortuneSpec(kd=0.2, lobes=(lobe,)))
    angles = goniometer(3, 20)
    values = grey_samples(retro, *angles) * np.cos(angles[1])
    table, report = interpolate_scattered(read_scattered_text(alta_text(*angles, values)))
    assert any("3 angles of light" in text for text in report["warnings"])
    wi = np.array([[np.sin(0.35), 0.0, np.cos(0.35)]])
    back, mirror = table.eval_brdf(wi, wi)[0, 0], table.eval_brdf(wi, wi * [-1, 1, 1])[0, 0]
    assert back > 5 * mirror
    assert back == pytest.approx(retro.eval_brdf(wi, wi)[0, 0], rel=0.1)


def test_many_samples_are_interpolated_from_the_nearest(monkeypatch, directions):
    monkeypatch.setattr("prtbake_workers.brdf.scattered.MAX_GLOBAL", 100)
    # a system of equations for every bin takes its time
    monkeypatch.setattr("prtbake_workers.brdf.scattered.SHAPE", (24, 24, 12))
    table, _ = interpolate_scattered(measured(ROUGH, n_lights=8, n_rings=9))
    assert off(table, directions) < 0.05


def test_the_same_samples_give_the_same_bits():
    samples = measured(ROUGH, n_lights=4, n_rings=5)
    one, other = interpolate_scattered(samples), interpolate_scattered(samples)
    np.testing.assert_array_equal(one[0].values, other[0].values)
    assert one[1] == other[1]


def test_symmetric_samples_are_merged():
    _, report = interpolate_scattered(measured(ROUGH, n_lights=4, n_rings=5))
    # mirror images in dphi, and pairs of light and view that the rings repeat
    assert report["n_merged"] > 0.3 * report["n_samples"]
    assert report["asymmetry"] < 1e-6  # nine digits in the text


def test_what_symmetry_takes_away_is_told():
    """A sheet that is brighter to one side: the mean is off by half of the difference."""
    theta_i, theta_o, dphi = goniometer(4, 5)
    side = np.where(np.sin(dphi) > 1e-9, 1.2, np.where(np.sin(dphi) < -1e-9, 0.8, 1.0))
    values = grey_samples(ROUGH, theta_i, theta_o, dphi) * side
    _, report = interpolate_scattered(
        read_scattered_text(spectral_text(theta_i, theta_o, dphi, values))
    )
    assert 0.1 < report["asymmetry"] < 0.2
    assert report["at_samples"]["relative_l2"] == pytest.approx(report["asymmetry"], rel=0.2)
    assert report["held_out"]["relative_l2"] > 0.0


def test_a_handful_of_samples_is_refused():
    with pytest.raises(BrdfError, match="too few"):
        interpolate_scattered(measured(ROUGH, n_lights=1, n_rings=3))
