"""Factorise a BRDF by a weighted singular value decomposition, one azimuthal order at a time."""

from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float64
from prtbake_workers.brdf.azimuthal_factorisation import AzimuthalFactorisation
from prtbake_workers.brdf.base import Brdf, is_isotropic
from prtbake_workers.brdf.checks import check_factorisation
from prtbake_workers.brdf.choose_terms import choose_units, signs
from prtbake_workers.brdf.constant_factorisation import constant_factorisation, is_constant
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.factorise_oriented import factorise_oriented
from prtbake_workers.brdf.hemisphere_grid import HemisphereGrid, azimuthal_blocks, norm_of_order
from prtbake_workers.brdf.isotropy import check_isotropy
from prtbake_workers.brdf.measured_loss import (
    CHECK_GRID,
    GRID_TOLERANCE,
    norm_ratio,
    with_measured_loss,
)
from prtbake_workers.brdf.radial_table import cosines_of_nodes
from prtbake_workers.brdf.spectrum import AzimuthalSpectrum


def factorise(
    brdf: Brdf,
    *,
    n_terms: int | None = None,
    energy_lost: float | None = None,
    n_theta: int = 28,
    n_phi: int = 112,
    max_terms: int = 128,
    n_nodes: int = 513,
) -> Factorisation:
    """Approximate ``rho(wi, wo)`` by the best sum of K products, [Tsai2006]_ eq. (9).

    The matrix ``cos_i cos_o rho`` on a hemisphere grid uniform in cos theta and phi is
    block-circulant where the BRDF is isotropic: a Fourier transform over the difference of
    azimuths and one small singular value decomposition an order give its full decomposition
    exactly.  For one that is not, see `factorise_oriented`.  The weight makes the error that of
    outgoing radiance with the view's cosine.  Colours share psi; their channels are stacked on the
    view side.

    Parameters
    ----------
    brdf
        Reciprocal; isotropic and mirror-symmetric, or an `OrientedBrdf`.
    n_terms
        K at most.  The two members of a pair (order m > 0) are kept or dropped together, since a
        split pair would let the picture depend on the tangent frame: K is rounded down, and the
        note says so.
    energy_lost
        The smallest K that leaves at most this share of the energy on the grid, in (0, 1).
        ``n_terms``, if given too, takes the place of ``max_terms``.
    n_theta, n_phi
        Rings and azimuths of the grid.
    max_terms
        Largest K that ``energy_lost`` may choose.
    n_nodes
        Nodes of the tables that `Factorisation.eval_psi` and `eval_phi` of an isotropic BRDF
        interpolate in.

    Raises
    ------
    SettingsError
        No affordable K loses as little energy as asked; the message says what K leaves behind.
    BrdfError
        The BRDF gives a negative or non-finite value, or lacks the symmetry that it claims, or its
        lobe is so narrow that the sum misses more than the whole energy.
    """
    if n_terms is not None and n_terms < 1:
        raise SettingsError(f"n_terms must be at least 1, got {n_terms}")
    if energy_lost is not None and not 0.0 < energy_lost < 1.0:
        raise SettingsError(f"energy_lost must lie between 0 and 1, got {energy_lost}")
    grid = HemisphereGrid(n_theta, n_phi)
    if not is_isotropic(brdf):
        return factorise_oriented(
            brdf, n_terms=n_terms, energy_lost=energy_lost, grid=grid, max_terms=max_terms
        )
    check_isotropy(brdf)
    # the blocks are small, and the number of threads would change the last bits
    with threadpool_limits(limits=1, user_api="blas"):
        return _factorise(brdf, grid, n_terms, energy_lost, max_terms, n_nodes)


def _factorise(
    brdf: Brdf,
    grid: HemisphereGrid,
    n_terms: int | None,
    energy_lost: float | None,
    max_terms: int,
    n_nodes: int,
) -> Factorisation:
    blocks = azimuthal_blocks(brdf, grid.cosines, grid.cosines, grid.n_phi)
    if is_constant(blocks):
        return constant_factorisation(blocks[0][0, 0] / (2.0 * np.pi), grid, brdf, n_terms, n_nodes)

    left, values, right = _decompose(blocks, grid)
    spectrum = AzimuthalSpectrum.from_blocks(values)
    n_units, note = choose_units(spectrum, n_terms, energy_lost, max_terms)
    orders, index = spectrum.orders[:n_units], spectrum.index[:n_units]
    weight = grid.cosines * np.sqrt(grid.ring_weight)
    norm = np.sqrt(norm_of_order(orders))
    phi = right[orders, index].transpose(1, 0, 2) / weight[:, None, None] / norm[:, None]
    psi = (left[orders, :, index] * spectrum.values[:n_units, None]).T / weight[:, None] / norm
    # the sign of a singular vector is arbitrary; fix it, so that equal inputs give equal bytes
    flip = signs(phi)
    phi, psi = phi * flip[:, None], psi * flip

    terms = np.repeat(np.arange(n_units), spectrum.multiplicity[:n_units])
    parity = np.append(0, np.diff(terms) == 0).astype(np.int32)
    draft = AzimuthalFactorisation(
        grid=grid,
        orders=orders[terms],
        parity=parity,
        psi_radial=psi[:, terms],
        phi_radial=phi[:, terms],
        singular_values=spectrum.all_values,
        psi_table=np.zeros((0, n_units), np.float32),
        phi_table=np.zeros((0, n_units, brdf.n_channels), np.float32),
        energy_lost=float(spectrum.energies_left[n_units - 1]),
        requested_terms=n_terms,
        note=note,
        is_constant_phi=False,
        brdf=brdf,
    )
    found = _with_tables(draft, n_nodes)
    ratio = norm_ratio(brdf, grid)
    if abs(ratio - 1.0) <= GRID_TOLERANCE:
        return found
    n_theta, n_phi = CHECK_GRID
    report = check_factorisation(brdf, found, n_theta=n_theta, n_phi=n_phi)
    return with_measured_loss(found, report.relative_error, ratio)


def _decompose(
    blocks: Float64[F64, "orders theta theta channels"], grid: HemisphereGrid
) -> tuple[
    Float64[F64, "orders theta theta"],
    Float64[F64, "orders theta"],
    Float64[F64, "orders theta theta channels"],
]:
    """Decompose each order's weighted block; right is (order, index, theta, channel)."""
    weight = grid.cosines * np.sqrt(grid.ring_weight)
    weighted = blocks * weight[:, None, None] * weight[:, None]
    flat = weighted.reshape(*weighted.shape[:2], -1)
    left, values, right = np.linalg.svd(flat, full_matrices=False)
    return left, values, right.reshape(weighted.shape)


def _with_tables(draft: AzimuthalFactorisation, n_nodes: int) -> AzimuthalFactorisation:
    """Tabulate the exact radial functions."""
    at = cosines_of_nodes(n_nodes)
    psi: F32 = draft.radial_exact(at, light_side=True)[..., 0].astype(np.float32)
    phi: F32 = draft.radial_exact(at, light_side=False).astype(np.float32)
    return replace(draft, psi_table=psi, phi_table=phi)
