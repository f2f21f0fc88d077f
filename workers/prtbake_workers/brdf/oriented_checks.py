"""Checks of an anisotropic BRDF's factorisation, by quadrature off its own grid."""

from collections.abc import Iterator

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.brdf.checks import SeparableReport
from prtbake_workers.brdf.oriented_factorisation import OrientedFactorisation
from prtbake_workers.brdf.parity import interpolation, ring_directions, terms_of_parity

LIGHT_RINGS, LIGHT_AZIMUTHS = 16, 8
"""Light directions: what they are averaged over varies slowly, being summed over all views."""

VIEW_RINGS, VIEW_AZIMUTHS = 96, 384
"""Views: a hundred thousandth of a hemisphere each, so that the narrowest lobes are resolved."""


LIGHTS_AT_ONCE = 8
"""Their sums are one matrix product: 2 MB a channel."""


def measure_loss(brdf: Brdf, found: OrientedFactorisation) -> tuple[float, float]:
    """Measure the share of the energy that the terms lose, tables included, off the grid.

    Gauss-Legendre rings in cos theta; the light in one quadrant, the view all around.

    Returns
    -------
    lost, squared_norm
        Squared error over the squared norm of the BRDF, weight cos_i^2 cos_o^2; and that norm.
    """
    wi, light = _nodes(LIGHT_RINGS, LIGHT_AZIMUTHS, 0.5 * np.pi)
    wo, view = _nodes(VIEW_RINGS, VIEW_AZIMUTHS, 2.0 * np.pi)
    psi, phi = found.eval_psi(wi), found.eval_phi(wo)
    lost = total = 0.0
    for row, (weight, terms) in enumerate(zip(light, _sums(psi, phi), strict=True)):
        value = brdf.eval_brdf(wi[row : row + 1], wo)
        error = value - terms
        total += float(weight) * float(view @ (value * value).sum(axis=1))
        lost += float(weight) * float(view @ (error * error).sum(axis=1))
    return lost / total, 4.0 * total


def check_oriented_factorisation(brdf: Brdf, found: OrientedFactorisation) -> SeparableReport:
    """Measure how far the exact sum of products is from the BRDF, and what the tables add.

    On the nodes of `measure_loss`, which gives the two together.
    """
    wi, light = _nodes(LIGHT_RINGS, LIGHT_AZIMUTHS, 0.5 * np.pi)
    wo, view = _nodes(VIEW_RINGS, VIEW_AZIMUTHS, 2.0 * np.pi)
    psi, _ = _exact(found, LIGHT_RINGS, LIGHT_AZIMUTHS, 0.5 * np.pi)
    _, phi = _exact(found, VIEW_RINGS, VIEW_AZIMUTHS, 2.0 * np.pi)
    tabled_psi, tabled_phi = found.eval_psi(wi), found.eval_phi(wo)
    lost = added = total = 0.0
    sums = zip(light, _sums(psi, phi), _sums(tabled_psi, tabled_phi), strict=True)
    for row, (weight, exact, tabled) in enumerate(sums):
        value = brdf.eval_brdf(wi[row : row + 1], wo)
        off = tabled - exact
        total += float(weight) * float(view @ (value * value).sum(axis=1))
        lost += float(weight) * float(view @ ((value - exact) ** 2).sum(axis=1))
        added += float(weight) * float(view @ (off * off).sum(axis=1))
    return SeparableReport(relative_error=lost / total, tabulation=added / total)


def _sums(
    psi: Float64[F64, "lights terms"], phi: Float64[F64, "views terms channels"]
) -> Iterator[Float64[F64, "views channels"]]:
    """Sum the products of the terms, one light after the other."""
    by_term = np.ascontiguousarray(phi.transpose(1, 0, 2)).reshape(phi.shape[1], -1)
    for start in range(0, len(psi), LIGHTS_AT_ONCE):
        block = psi[start : start + LIGHTS_AT_ONCE] @ by_term
        yield from block.reshape(-1, len(phi), phi.shape[2])


def _nodes(
    n_rings: int, n_azimuths: int, circle: float
) -> tuple[Float64[F64, "n 3"], Float64[F64, " n"]]:
    cosines, azimuths, weight = _rings(n_rings, n_azimuths, circle)
    return ring_directions(cosines, azimuths).reshape(-1, 3), np.repeat(weight, n_azimuths)


def _rings(
    n_rings: int, n_azimuths: int, circle: float
) -> tuple[Float64[F64, " rings"], Float64[F64, " azimuths"], Float64[F64, " rings"]]:
    node, weight = np.polynomial.legendre.leggauss(n_rings)
    cosines, step = (node + 1.0) / 2.0, circle / n_azimuths
    azimuths = np.asarray((np.arange(n_azimuths) + 0.5) * step)
    return cosines, azimuths, weight / 2.0 * cosines**2 * step


def _exact(
    found: OrientedFactorisation, n_rings: int, n_azimuths: int, circle: float
) -> tuple[Float64[F64, "n terms"], Float64[F64, "n terms channels"]]:
    """Extend the terms to the nodes: rings by their defining sums, azimuths by waves."""
    cosines, azimuths, _ = _rings(n_rings, n_azimuths, circle)
    psi_rings, phi_rings = found.rings_exact(cosines)
    psi = np.empty((n_rings, n_azimuths, found.n_terms))
    phi = np.empty((*psi.shape, found.n_channels))
    for _, parity, terms in terms_of_parity(found.parities):
        along = interpolation(parity, azimuths, found.grid.n_phi)
        psi[..., terms] = np.einsum("aq,rqk->rak", along, psi_rings[:, :, terms])
        phi[:, :, terms] = np.einsum("aq,rqkc->rakc", along, phi_rings[:, :, terms])
    n = n_rings * n_azimuths
    return psi.reshape(n, -1), phi.reshape(n, found.n_terms, -1)
