"""Every kind of light on every kind of basis, against quadrature; turned, summed, refused."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.decode.cube_map import cube_texels
from prtbake_storage.decode.haar import haar
from prtbake_storage.decode.light import HarmonicLight, Light, LightFit, LightSum, WaveletLight
from prtbake_storage.decode.relight import project_light, rotation_matrix
from prtbake_storage.decode.sh import eval_sh
from prtbake_storage.decode.sh_turn import turn_sh
from prtbake_storage.decode.srbf import gaussian
from prtbake_storage.decode.transfer_basis import SphericalHarmonics, WhitenedSrbfs
from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.sh import rotate_sh
from prtbake_workers.geometry.icosphere import icosphere
from support.quadrature import random_directions, sphere_quadrature

TURN = rotation_matrix((33.0, -70.0, 121.0))
BASES = {
    "srbf": WhitenedSrbfs(icosphere(1), 5.0),
    "sh": SphericalHarmonics(4),
}
RULE = sphere_quadrature(90)


def functions(basis, directions):
    if isinstance(basis, SphericalHarmonics):
        return eval_sh(basis.order, directions)
    values = gaussian(directions @ basis.centres.T, basis.bandwidth)
    return values @ basis.whitening.inv_sqrt_gram


@pytest.fixture(scope="module")
def lights():
    rng = np.random.default_rng(5)
    cube = haar(rng.random((6 * 16, 3)), 4)
    kept = np.array([0, 3, 16, 17, 40, 70, 95])
    return {
        "srbf": LightFit(
            centres=random_directions(rng, 5),
            bandwidths=np.array([0.5, 3.0, 20.0, 8.0, 1.0]),
            coefficients=rng.normal(size=(5, 3)),
        ),
        "sh": HarmonicLight(coefficients=rng.normal(size=(49, 3))),
        "sh few": HarmonicLight(coefficients=rng.normal(size=(4, 3))),
        "wavelet": WaveletLight(
            resolution=4, indices=kept.astype(np.int32), coefficients=cube[kept]
        ),
    }


def by_quadrature(basis, light, rotation):
    directions, weights = RULE
    turned = light.radiance(directions if rotation is None else directions @ rotation)
    return functions(basis, directions).T @ (turned * weights[:, None])


@pytest.mark.parametrize("rotation", [None, TURN], ids=["straight", "turned"])
@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("kind", ["srbf", "sh", "sh few", "wavelet"])
def test_projected_lights_are_integrals_with_every_function(lights, kind, basis, rotation):
    light, on = lights[kind], BASES[basis]
    assert isinstance(light, Light)
    expected = by_quadrature(on, light, rotation)
    found = project_light(on, light, rotation)
    # the oracle's own samples step across the texels of a cube map: 1.4e-2 was measured
    tolerance = 3e-2 if kind == "wavelet" else 1e-10
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * scale)
    # negative twin: turned the other way
    back = project_light(on, light, TURN.T if rotation is None else rotation.T)
    assert np.abs(back - expected).max() > 5 * tolerance * scale


def test_wavelets_are_integrated_to_the_basis_own_resolution(lights):
    """Against texels cut ten times as fine, where the oracle above is coarse."""
    light = lights["wavelet"]
    directions, solid_angles, owners = cube_texels(4, 24)
    for basis in BASES.values():
        expected = functions(basis, directions).T @ (light.texels[owners] * solid_angles[:, None])
        found = project_light(basis, light)
        # parts of a quarter of the functions' width: second order in it, 4e-4 was measured
        assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


def test_a_basis_narrower_than_any_that_is_baked_is_refused():
    """A crafted asset must not make its reader cut a cube map into any number of texels."""
    light = WaveletLight(
        resolution=8, indices=np.array([0], np.int32), coefficients=np.ones((1, 3))
    )
    for bandwidth in (1e6, 1e300):
        with pytest.raises(SettingsError, match="1024 along a face") as refused:
            light.on_basis(WhitenedSrbfs(icosphere(0), bandwidth))
        assert refused.value.pointer == "/basis/bandwidth"
    # negative twin: ten times the default of as many is taken
    widest = WhitenedSrbfs(icosphere(0), 600.0 * 12 / 642)
    assert np.isfinite(light.on_basis(widest)).all()


@pytest.mark.parametrize("order", [1, 2, 7, 20])
def test_turning_harmonics_is_rotating_them(rng, order):
    coefficients = rng.normal(size=(order**2, 3))
    expected = rotate_sh(np.ascontiguousarray(coefficients.T), TURN).T
    np.testing.assert_allclose(turn_sh(coefficients, TURN), expected, atol=1e-12)
    if order > 1:
        assert np.abs(turn_sh(coefficients, TURN.T) - expected).max() > 0.1


@pytest.mark.parametrize("kind", ["srbf", "sh", "sh few", "wavelet"])
def test_power_is_the_integral(lights, kind):
    directions, weights = RULE
    expected = weights @ lights[kind].radiance(directions)
    tolerance = 3e-3 if kind == "wavelet" else 1e-10
    np.testing.assert_allclose(
        lights[kind].power, expected, rtol=0, atol=tolerance * np.abs(expected).max()
    )


def test_lights_of_several_kinds_shine_together(lights):
    own = rotation_matrix((0.0, 90.0, 0.0))
    both = LightSum(
        (lights["srbf"], lights["sh"], lights["wavelet"]), (1.0, 0.25, 2.0), (None, own, None)
    )
    assert isinstance(both, Light)
    directions = random_directions(np.random.default_rng(0), 50)
    expected = (
        lights["srbf"].radiance(directions)
        + 0.25 * lights["sh"].radiance(directions @ own)
        + 2.0 * lights["wavelet"].radiance(directions)
    )
    np.testing.assert_allclose(both.radiance(directions), expected, rtol=1e-12)
    for basis in BASES.values():
        parts = [
            project_light(basis, lights["srbf"], TURN),
            0.25 * project_light(basis, lights["sh"], TURN @ own),
            2.0 * project_light(basis, lights["wavelet"], TURN),
        ]
        together = project_light(basis, both, TURN)
        np.testing.assert_allclose(together, sum(parts), rtol=0, atol=1e-12)
        # negative twin: the light's own turn comes first
        swapped = 0.25 * project_light(basis, lights["sh"], own @ TURN)
        assert np.abs(parts[0] + swapped + parts[2] - together).max() > 1e-3
    assert not LightSum(()).radiance(directions).any()
    with pytest.raises(ValueError, match="1 factors for 2 lights"):
        LightSum((lights["sh"], lights["srbf"]), (1.0,))


def test_what_breaks_a_rule_is_refused(lights):
    wavelet = lights["wavelet"]
    broken = {
        "bandwidths are not all positive": replace(lights["srbf"], bandwidths=-np.ones(5)),
        "coefficients": HarmonicLight(coefficients=np.zeros((5, 3))),
        "resolution is 3": replace(wavelet, resolution=3),
        "rise from 0 or more to 95 or less": replace(wavelet, indices=wavelet.indices[::-1]),
        "to 95 or": replace(wavelet, indices=wavelet.indices + 1),
    }
    for message, light in broken.items():
        with pytest.raises(ValueError, match=message):
            light.check()
    for light in lights.values():
        light.check()
