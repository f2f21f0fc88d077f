"""Environments in spherical harmonics."""

from dataclasses import replace

from prtbake_storage.decode.light import HarmonicLight
from prtbake_storage.decode.transfer_basis import SphericalHarmonics
from prtbake_workers.basis.sh_light import sh_light
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit.cells import Cells
from prtbake_workers.environment.light_error import squared_error_ratio
from prtbake_workers.environment.subdivision import fine_texels


def project_sh(texels: Cells, order: int) -> HarmonicLight:
    """Project samples of light on the n^2 harmonics below an order.

    The functions are orthonormal, so the integrals with them are the coefficients of least squared
    error over the sphere.

    Parameters
    ----------
    texels
        Samples that resolve the harmonics (`SphericalHarmonics.spacing_rad`); their solid angles
        sum to 4 pi.
    order
        n, 1 to 100.

    Returns
    -------
    HarmonicLight
        With its squared-error ratio on the samples.
    """
    SphericalHarmonics(order).check()
    coefficients = sh_light(order, texels.directions, texels.solid_angles, texels.radiance)
    light = HarmonicLight(coefficients=coefficients)
    return replace(light, error=squared_error_ratio(light, texels))


def sh_samples(environment: Environment, order: int) -> Cells:
    """Cut the texels of a map as fine as harmonics below an order ask for."""
    return fine_texels(environment, SphericalHarmonics(order).spacing_rad)
