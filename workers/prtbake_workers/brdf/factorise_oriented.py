"""Factorise an anisotropic BRDF by weighted singular value decompositions, parity by parity."""

from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import BrdfError, SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.brdf.choose_terms import choose_units, signs
from prtbake_workers.brdf.constant_factorisation import CONSTANT_TOLERANCE, constant_factorisation
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.hemisphere_grid import HemisphereGrid
from prtbake_workers.brdf.measured_loss import GRID_TOLERANCE, with_measured_loss
from prtbake_workers.brdf.oriented_checks import measure_loss
from prtbake_workers.brdf.oriented_factorisation import OrientedFactorisation
from prtbake_workers.brdf.parity import PARITIES, parity_rows, quadrant_azimuths, ring_directions
from prtbake_workers.brdf.radial_table import cosines_of_nodes
from prtbake_workers.brdf.spectrum import Spectrum

STORED_NODES = 65
"""Rings of the stored tables, cubic between them: what they add to the error of Ward (0.1, 0.4) is
3e-7 of the energy, and 1e-7 with 129."""

MIRRORS = np.array([[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0]])


def factorise_oriented(
    brdf: Brdf,
    *,
    grid: HemisphereGrid,
    n_terms: int | None = None,
    energy_lost: float | None = None,
    max_terms: int = 128,
    n_nodes: int = STORED_NODES,
) -> Factorisation:
    """Approximate a BRDF that may depend on the tangent by the best sum of K products.

    The matrix of `factorise` on a grid whose azimuths mirror each other falls into four blocks of
    a quarter of its rows and columns, see `prtbake_workers.brdf.parity`; their singular value
    decompositions are together its own.

    Parameters
    ----------
    brdf
        Reciprocal, mirror-symmetric about x and about y; one that is isotropic will do.
    grid
        With a multiple of four azimuths.
    n_terms, energy_lost, max_terms
        As in `factorise`.  Equal singular values, as isotropy makes them, are kept or dropped
        together.
    n_nodes
        Rings of the stored tables.

    Returns
    -------
    Factorisation
        An `OrientedFactorisation`, or that of a constant.  On 28 x 112 it takes 5 to 12 s (one to
        three channels, on a busy core) and at most some 300 MB.

    Raises
    ------
    SettingsError
        A grid whose azimuths are no multiple of four, or no affordable K loses as little energy as
        asked; the message says what K leaves behind.
    BrdfError
        As in `factorise`.
    """
    if grid.n_phi % 4:
        raise SettingsError(f"n_phi must be a multiple of 4, got {grid.n_phi}")
    _check_symmetry(brdf)
    # the number of threads would change the last bits
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
    quadrant = ring_directions(grid.cosines, quadrant_azimuths(grid.n_phi)).reshape(-1, 3)
    n, n_channels = len(quadrant), brdf.n_channels
    blocks = np.empty((len(PARITIES), n, n, n_channels))
    for rows, some in parity_rows(brdf, quadrant, quadrant):
        blocks[:, rows] = some
    if _is_constant(blocks):
        return constant_factorisation(blocks[0, 0, 0] / 4.0, grid, brdf, n_terms, 2)
    weight = quadrant[:, 2] * np.sqrt(grid.ring_weight * 2.0 * np.pi / grid.n_phi)
    blocks *= weight[:, None, None] * weight[:, None]
    left, values, right = np.linalg.svd(blocks.reshape(len(PARITIES), n, -1), full_matrices=False)
    # equal values keep the sequence of the parities
    rank = np.argsort(-values.ravel(), kind="stable")
    spectrum = Spectrum.from_values(values.ravel()[rank])
    n_units, note = choose_units(spectrum, n_terms, energy_lost, max_terms)
    kept = rank[: spectrum.whole_counts[n_units - 1]]
    place, index = np.divmod(kept, n)
    # a quadrant holds a quarter of a function's energy: half its amplitude
    phi = right[place, index].reshape(-1, n, n_channels) / (2.0 * weight[:, None])
    psi = left[place, :, index] * (values[place, index, None] / (2.0 * weight))
    flip = signs(phi.transpose(1, 0, 2))[:, None]
    shape = (grid.n_theta, grid.n_phi // 4, len(kept))
    draft = OrientedFactorisation(
        grid=grid,
        parities=np.array(PARITIES, np.int32)[place],
        psi_grid=(psi * flip).T.reshape(shape),
        phi_grid=(phi * flip[:, None]).transpose(1, 0, 2).reshape(*shape, n_channels),
        singular_values=values.ravel()[rank],
        psi_rings=np.zeros((0, *shape[1:]), np.float32),
        phi_rings=np.zeros((0, *shape[1:], n_channels), np.float32),
        energy_lost=float(spectrum.energies_left[n_units - 1]),
        requested_terms=n_terms,
        note=note,
        is_constant_phi=False,
        brdf=brdf,
    )
    psi_rings, phi_rings = draft.rings_exact(cosines_of_nodes(n_nodes))
    found = replace(
        draft, psi_rings=psi_rings.astype(np.float32), phi_rings=phi_rings.astype(np.float32)
    )
    lost, squared_norm = measure_loss(brdf, found)
    ratio = float(np.sum(values**2)) / squared_norm
    return found if abs(ratio - 1.0) <= GRID_TOLERANCE else with_measured_loss(found, lost, ratio)


def _check_symmetry(brdf: Brdf) -> None:
    """Refuse a BRDF that a mirror about x or y changes, or that is not reciprocal."""
    rng = np.random.default_rng(0)
    wi, wo = rng.normal(size=(2, 16, 3))
    wi[:, 2], wo[:, 2] = np.abs(wi[:, 2]), np.abs(wo[:, 2])
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    value = brdf.eval_brdf(wi, wo)
    for mirror in MIRRORS:
        if not np.allclose(brdf.eval_brdf(wi * mirror, wo * mirror), value, rtol=1e-9, atol=1e-12):
            raise BrdfError("the BRDF is not mirror-symmetric about its tangent and bitangent")
    if not np.allclose(brdf.eval_brdf(wo, wi), value, rtol=1e-9, atol=1e-12):
        raise BrdfError("the BRDF is not reciprocal")


def _is_constant(blocks: Float64[F64, "parities n n channels"]) -> bool:
    scale = CONSTANT_TOLERANCE * blocks[0].max(axis=(0, 1))
    level = (np.ptp(blocks[0], axis=(0, 1)) <= scale).all()
    return bool(level and (np.abs(blocks[1:]).max(axis=(0, 1, 2)) <= scale).all())
