"""Factorise a BRDF by projecting its views on hemispherical harmonics."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import BrdfError, SettingsError
from prtbake_workers.arrays import F64, I32, Float64, Int32
from prtbake_workers.brdf.base import Brdf, is_isotropic
from prtbake_workers.brdf.checks import check_factorisation
from prtbake_workers.brdf.choose_terms import signs
from prtbake_workers.brdf.constant_factorisation import constant_factorisation, is_constant
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.harmonic_factorisation import (
    VIEW_RINGS,
    HarmonicFactorisation,
    degrees_of,
    fitted_views,
    radial_harmonics,
)
from prtbake_workers.brdf.hemisphere_grid import HemisphereGrid, azimuthal_blocks, norm_of_order
from prtbake_workers.brdf.isotropy import check_isotropy
from prtbake_workers.brdf.measured_loss import CHECK_GRID, GRID_TOLERANCE, norm_ratio
from prtbake_workers.brdf.radial_table import cosines_of_nodes
from prtbake_workers.percent import percent

RANK_TOLERANCE = 1e-10
"""Share of the energy that a term must hold: colours share lobes, and BRDFs of low degree need
fewer terms than there are harmonics; below are roundings."""

FINER_GRID = (61, 240)
"""Rings and azimuths on which the loss is measured where the factorisation's own resolve the lobe.
"""


def factorise_harmonic(
    brdf: Brdf,
    order: int,
    functions: NDArray[np.integer],
    *,
    n_theta: int = 28,
    n_phi: int = 112,
    n_nodes: int = 513,
) -> Factorisation:
    """Approximate ``rho(wi, .)`` by hemispherical harmonics of the view, for every wi.

    The squared error over the hemisphere of views is the least that the harmonics allow,
    [Sloan2003]_ 9.1; `factorise` has the least under the squares of both cosines.

    Parameters
    ----------
    brdf
        Isotropic.
    order
        n >= 1 bands.
    functions
        Indices l (l + 1) + m of the harmonics, both of a pair +-m; those of
        `HemisphereBasis` leave out what the others nearly give.
    n_theta, n_phi, n_nodes
        As in `factorise`; the grid weighs the light side.

    Returns
    -------
    Factorisation
        A `HarmonicFactorisation` of as many terms as there are functions, or fewer where the BRDF
        has no more; up to three times as many where colours have lobes of their own.  Of a constant
        its one term, exactly.  ``energy_lost`` is measured on a finer grid.

    Raises
    ------
    SettingsError
        The BRDF is anisotropic.
    BrdfError
        It gives a negative or non-finite value, lacks the symmetry it claims, or the harmonics miss
        more than its energy.
    """
    if not is_isotropic(brdf):
        raise SettingsError(
            "an anisotropic BRDF has no factorisation in spherical harmonics: take svd",
            pointer="/settings/bake/factorisation",
        )
    check_isotropy(brdf)
    grid = HemisphereGrid(n_theta, n_phi)
    # the matrices are small, and the number of threads would change the last bits
    with threadpool_limits(limits=1, user_api="blas"):
        blocks = azimuthal_blocks(brdf, grid.cosines, grid.cosines, grid.n_phi)
        if is_constant(blocks):
            level = blocks[0][0, 0] / (2.0 * np.pi)
            return constant_factorisation(level, grid, brdf, None, n_nodes)
        draft = _decomposed(brdf, order, _of_cosines(order, functions), grid)
        at = cosines_of_nodes(n_nodes)
        found = replace(
            draft,
            psi_table=draft.radial_exact(at, light_side=True)[..., 0].astype(np.float32),
            phi_table=draft.radial_exact(at, light_side=False).astype(np.float32),
        )
        is_resolved = abs(norm_ratio(brdf, grid) - 1.0) <= GRID_TOLERANCE
        rings, azimuths = FINER_GRID if is_resolved else CHECK_GRID
        lost = check_factorisation(brdf, found, n_theta=rings, n_phi=azimuths).relative_error
    if lost > 1.0:
        raise BrdfError(
            f"{found.n_terms} terms of hemispherical harmonics miss {lost:.0%} of the BRDF's "
            "energy, more than none at all would: its lobe is too narrow for them, take more bands "
            "or svd",
            pointer="/settings/bake/view_order",
        )
    note = (
        f"{len(functions)} of {order**2} hemispherical harmonics ({found.n_terms} terms) leave "
        f"{percent(lost)} of the BRDF's energy"
    )
    return replace(found, energy_lost=lost, note=note)


def _of_cosines(order: int, functions: NDArray[np.integer]) -> Int32[I32, " functions"]:
    """Keep the indices of m >= 0, and hold that pairs are whole and that none is out of range."""
    given = {int(index) for index in functions}
    degree = {index: int(np.sqrt(index)) for index in given}
    mirrored = {2 * degree[index] * (degree[index] + 1) - index for index in given}
    if mirrored != given or not given <= set(range(order**2)):
        raise ValueError("functions must be indices below order^2, both of every pair +-m")
    kept = sorted(index for index in given if index >= degree[index] * (degree[index] + 1))
    return np.array(kept, np.int32)


def _decomposed(
    brdf: Brdf, order: int, functions: Int32[I32, " functions"], grid: HemisphereGrid
) -> HarmonicFactorisation:
    """Write the fitted sum in orthonormal phi and orthogonal psi: an SVD of every order."""
    node, weight = np.polynomial.legendre.leggauss(VIEW_RINGS)
    rings, roots = 0.5 * (node + 1.0), np.sqrt(0.5 * weight)
    harmonics = radial_harmonics(order, rings) * (rings * roots)[:, None]
    fitted = fitted_views(brdf, grid.cosines, order, functions, n_phi=grid.n_phi)
    light = grid.cosines * np.sqrt(grid.ring_weight)
    norms = norm_of_order(np.arange(order, dtype=np.int32))
    values: list[float] = []
    units: list[tuple[int, Float64[F64, "degrees channels"], Float64[F64, "degrees channels"]]] = []
    for m in range(order):
        degrees = degrees_of(m, order, functions)
        if not degrees:
            continue
        # y_l = sum_j q_j U_jl, q orthonormal under the view's cosine
        root: F64 = np.linalg.qr(harmonics[m][:, degrees])[1]
        own = np.einsum("jl,nlc->njc", root, fitted[m][:, degrees]) * light[:, None, None]
        _, singular, right = np.linalg.svd(own.reshape(len(own), -1), full_matrices=False)
        rows = right.reshape(len(right), len(degrees), -1)
        for value, row in zip(singular * norms[m], rows, strict=True):
            view, back = np.zeros((2, order, row.shape[1]))
            view[degrees] = np.linalg.solve(root, row) / np.sqrt(norms[m])
            back[degrees] = root.T @ row * np.sqrt(norms[m])
            values.append(float(value))
            units.append((m, view, back))
    # pairs stand twice
    energy = np.square(values) * [1 if m == 0 else 2 for m, _, _ in units]
    rank = np.argsort(-np.array(values), kind="stable")
    rank = rank[energy[rank] > RANK_TOLERANCE * energy.sum()]
    orders = np.array([units[place][0] for place in rank], np.int32)
    unit = np.repeat(np.arange(len(rank)), np.where(orders == 0, 1, 2))
    draft = HarmonicFactorisation(
        grid=grid,
        orders=orders[unit],
        parity=np.append(0, np.diff(unit) == 0).astype(np.int32),
        psi_radial=np.zeros((0, len(unit))),
        phi_radial=np.zeros((0, len(unit), brdf.n_channels)),
        singular_values=np.array(values)[rank][unit],
        psi_table=np.zeros((0, len(rank)), np.float32),
        phi_table=np.zeros((0, len(rank), brdf.n_channels), np.float32),
        energy_lost=0.0,
        requested_terms=None,
        note=None,
        is_constant_phi=False,
        brdf=brdf,
        functions=functions,
        view_coefficients=np.stack([units[place][1] for place in rank], axis=1),
        light_coefficients=np.stack([units[place][2] for place in rank], axis=1),
    )
    # the sign of a singular vector is arbitrary; fix it, so that equal inputs give equal bytes
    phi = draft.radial_exact(grid.cosines, light_side=False)
    flip = signs(phi)
    draft = replace(
        draft,
        view_coefficients=draft.view_coefficients * flip[:, None],
        light_coefficients=draft.light_coefficients * flip[:, None],
    )
    psi = draft.radial_exact(grid.cosines, light_side=True)[..., 0]
    return replace(draft, phi_radial=(phi * flip[:, None])[:, unit], psi_radial=psi[:, unit])
