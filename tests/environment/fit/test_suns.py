"""A disc of one texel among a sky: the lobes that stand for it, at any brightness."""

import numpy as np
import pytest

from prtbake_storage.decode.light import LightFit
from prtbake_storage.decode.transfer_basis import SphericalHarmonics
from prtbake_workers.environment.environment import Environment, texel_of
from prtbake_workers.environment.fit import fit_environment
from prtbake_workers.environment.sh_projection import project_sh, sh_samples
from prtbake_workers.environment.sky import sun_direction, sun_sky

HEIGHT = 64
TOWARDS = sun_direction(35.0, 120.0)


def sky_with_disc(radiance: float) -> tuple[Environment, int]:
    """A procedural sky whose own sun lies elsewhere, and the texel of a tiny disc."""
    sky = sun_sky(2 * HEIGHT, 25.0, -60.0).radiance.copy()
    sky /= np.median(sky)
    sky = np.minimum(sky, 20.0)
    texel = int(texel_of(TOWARDS[None], HEIGHT, 2 * HEIGHT)[0])
    sky.reshape(-1, 3)[texel] = radiance
    return Environment(sky.astype(np.float32)), texel


@pytest.mark.parametrize("radiance", [1e4, 1e5])
def test_a_narrow_lobe_stands_on_a_disc_of_one_texel(radiance: float) -> None:
    environment, texel = sky_with_disc(radiance)
    fit = fit_environment(environment, 48, seed=0, max_iterations=2)
    width = np.pi / HEIGHT
    centre = environment.directions()[texel]
    near = fit.centres @ centre > np.cos(1.5 * width)
    assert near.any()
    # the standard deviation 1 / sqrt(lam) of the narrowest is below half of the texel's width
    assert fit.bandwidths[near].max() > (2.0 / width) ** 2
    assert fit.power_ratio == pytest.approx(1.0, abs=0.01)
    # what diffuse surfaces see of it: nine harmonics, of the lobes and of the map itself
    light = LightFit(centres=fit.centres, bandwidths=fit.bandwidths, coefficients=fit.coefficients)
    seen = light.on_basis(SphericalHarmonics(3))
    expected = project_sh(sh_samples(environment, 3), 3).coefficients
    assert np.linalg.norm(seen - expected) < 0.02 * np.linalg.norm(expected)
    # negative twin: without the lobes of the disc it is dark there
    away = LightFit(
        centres=fit.centres[~near],
        bandwidths=fit.bandwidths[~near],
        coefficients=fit.coefficients[~near],
    ).on_basis(SphericalHarmonics(3))
    assert np.linalg.norm(away - expected) > 0.05 * np.linalg.norm(expected)
