"""Checks of a BRDF, and of its factorisation, by quadrature."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.azimuthal_factorisation import AzimuthalFactorisation
from prtbake_workers.brdf.base import COSINE_FLOOR, Brdf, is_isotropic
from prtbake_workers.brdf.hemisphere_grid import azimuthal_blocks, norm_of_order

RECIPROCITY_TOLERANCE = 1e-9
"""Relative: the models are symmetric up to the rounding of a few products and one power."""

ENERGY_TOLERANCE = 1e-4
"""Slack of the test for an albedo of at most 1; the quadrature is off by less than 1e-6."""

NODES_A_PANEL, N_PANELS, MAX_PANELS = 8, 16, 26
"""Quadrature of the albedo: at normal light the last panel ends 3e-5 from the mirror direction; at
grazing light, where lobes narrow like the cosine, 3e-8."""

N_RETRO_PANELS = 10
"""The same towards the light itself: 1.5e-3 rad, a sixth of the sharpest retro-reflector's lobe."""

MAX_PANEL_COSINE, MAX_PANEL_AZIMUTH = 1 / 16, np.pi / 24
"""Widest panels where a lobe may peak off these directions: their nodes lie closer than 0.01, the
width of the sharpest lobe in the contract (exponent 10,000)."""

AZIMUTHS = (0.0, 0.25 * np.pi, 0.5 * np.pi)
"""Azimuths of the light at which an anisotropic BRDF's albedo is taken."""


@dataclass(frozen=True)
class EnergyReport:
    """Directional albedo (share of the light of one direction that leaves), over all angles."""

    max_albedo: float
    cos_at_max: float
    normal_albedo: tuple[float, ...]
    conserves: bool

    def to_dict(self) -> dict[str, Any]:
        """Give plain values."""
        return asdict(self)


@dataclass(frozen=True)
class ReciprocityReport:
    """Largest difference of rho(wi, wo) and rho(wo, wi), relative to the larger of the two."""

    max_relative: float
    reciprocal: bool

    def to_dict(self) -> dict[str, Any]:
        """Give plain values."""
        return asdict(self)


@dataclass(frozen=True)
class SeparableReport:
    """Squared error of a factorisation off its own grid, weight cos_i^2 cos_o^2, over all channels.

    ``relative_error`` stands beside `Factorisation.energy_lost`: what it has more is what the grid
    does not resolve.  ``tabulation`` is the part that the tables add.
    """

    relative_error: float
    tabulation: float

    def to_dict(self) -> dict[str, Any]:
        """Give plain values."""
        return asdict(self)


def directional_albedo(
    brdf: Brdf, cos_i: Float64[F64, " n"], *, azimuth: float = 0.0
) -> Float64[F64, "n channels"]:
    """Integrate ``rho(wi, wo) cos_o`` over the upper hemisphere, for light from ``azimuth``.

    The cosines of the light must be above 0.

    The nodes crowd geometrically towards the mirror direction from all sides, so that lobes of any
    width are resolved, those at grazing light (narrower than the cosine itself) included, and less
    so towards the light.
    """
    albedo = np.zeros((len(cos_i), brdf.n_channels))
    for row, cosine in enumerate(cos_i):
        n_panels = min(MAX_PANELS, N_PANELS - int(np.log2(cosine)))
        turn, phi_weight = _azimuth_nodes(n_panels, isotropic=is_isotropic(brdf))
        phi = azimuth + turn
        above, above_weight = _graded_nodes(1.0 - cosine, n_panels, MAX_PANEL_COSINE)
        below, below_weight = _graded_nodes(cosine, n_panels, MAX_PANEL_COSINE)
        cos_o = np.concatenate([cosine + above, cosine - below])
        weight = np.concatenate([above_weight, below_weight]) * cos_o
        sine_i, sine_o = np.sqrt(1.0 - cosine**2), np.sqrt(1.0 - cos_o**2)[:, None]
        wi = np.array([[[sine_i * np.cos(azimuth), sine_i * np.sin(azimuth), cosine]]])
        parts = np.broadcast_arrays(sine_o * np.cos(phi), sine_o * np.sin(phi), cos_o[:, None])
        value = brdf.eval_brdf(wi, np.stack(parts, axis=-1))
        albedo[row] = np.einsum("opc,o,p->c", value, weight, phi_weight)
    return albedo


def _azimuth_nodes(
    n_panels: int, *, isotropic: bool
) -> tuple[Float64[F64, " n"], Float64[F64, " n"]]:
    """Nodes of the view's azimuth relative to the light's, over the whole circle.

    An isotropic BRDF is even in it, and half the circle does.
    """
    widest = np.pi if isotropic else MAX_PANEL_AZIMUTH
    near, near_weight = _graded_nodes(0.5 * np.pi, N_RETRO_PANELS, widest)
    far, far_weight = _graded_nodes(0.5 * np.pi, n_panels, widest)
    half = np.concatenate([near, np.pi - far])
    weight = np.concatenate([near_weight, far_weight])
    if isotropic:
        return half, 2.0 * weight
    return np.concatenate([half, -half]), np.concatenate([weight, weight])


def _graded_nodes(
    length: float, n_panels: int, widest: float
) -> tuple[Float64[F64, " n"], Float64[F64, " n"]]:
    """Gauss nodes and weights on (0, length], in panels that halve towards 0, none too wide."""
    node, weight = np.polynomial.legendre.leggauss(NODES_A_PANEL)
    top = length * 0.5 ** np.arange(n_panels)
    bottom = np.append(top[1:], 0.0)
    edges = [
        np.linspace(high, low, max(1, int(np.ceil((high - low) / widest))) + 1)
        for high, low in zip(top, bottom, strict=True)
    ]
    top = np.concatenate([edge[:-1] for edge in edges])
    bottom = np.concatenate([edge[1:] for edge in edges])
    width = (top - bottom)[:, None]
    nodes = bottom[:, None] + width * (node + 1.0) / 2.0
    return nodes.ravel(), (width * weight / 2.0).ravel()


def check_energy(brdf: Brdf, *, n_angles: int = 33) -> EnergyReport:
    """Find the largest directional albedo; above 1 the surface would create light."""
    cos_i = np.maximum(np.linspace(0.0, 1.0, n_angles), COSINE_FLOOR)
    azimuths = AZIMUTHS[:1] if is_isotropic(brdf) else AZIMUTHS
    albedo = np.stack([directional_albedo(brdf, cos_i, azimuth=phi) for phi in azimuths])
    worst = int(albedo.max(axis=(0, 2)).argmax())
    top = float(albedo.max())
    return EnergyReport(
        max_albedo=top,
        cos_at_max=float(cos_i[worst]),
        normal_albedo=tuple(float(value) for value in albedo[0, -1]),
        conserves=top <= 1.0 + ENERGY_TOLERANCE,
    )


def check_reciprocity(brdf: Brdf, *, n_pairs: int = 4096, seed: int = 0) -> ReciprocityReport:
    """Compare rho with its arguments exchanged, at random pairs of directions."""
    rng = np.random.default_rng(seed)
    cos = rng.random((2, n_pairs))
    phi = 2.0 * np.pi * rng.random((2, n_pairs))
    sine = np.sqrt(1.0 - cos * cos)
    wi, wo = np.stack([sine * np.cos(phi), sine * np.sin(phi), cos], axis=-1)
    there, back = brdf.eval_brdf(wi, wo), brdf.eval_brdf(wo, wi)
    larger = np.maximum(np.abs(there), np.abs(back))
    relative = np.abs(there - back) / np.where(larger > 0.0, larger, 1.0)
    worst = float(relative.max())
    return ReciprocityReport(worst, worst <= RECIPROCITY_TOLERANCE)


def check_factorisation(
    brdf: Brdf, factorisation: AzimuthalFactorisation, *, n_theta: int = 61, n_phi: int = 240
) -> SeparableReport:
    """Measure how far the sum of products is from the BRDF, on another, finer grid.

    Both are expanded in azimuthal orders, where the squared norm is a sum over orders (Parseval);
    Gauss-Legendre rings in cos theta fall between those of the factorisation.
    """
    node, weight = np.polynomial.legendre.leggauss(n_theta)
    cosines, ring = (node + 1.0) / 2.0, weight / 2.0 * ((node + 1.0) / 2.0) ** 2
    blocks = azimuthal_blocks(brdf, cosines, cosines, n_phi)
    pair_weight = ring[:, None, None] * ring[:, None]
    norm = norm_of_order(np.arange(len(blocks), dtype=np.int32))
    total = _energy(blocks, norm, pair_weight)

    meridian = np.stack([np.sqrt(1.0 - cosines**2), np.zeros(n_theta), cosines], axis=-1)
    first = factorisation.parity == 0
    orders = factorisation.orders[first]
    exact = (
        factorisation.radial_exact(cosines, light_side=True)[..., 0],
        factorisation.radial_exact(cosines, light_side=False),
    )
    tabled = (
        factorisation.eval_psi(meridian)[:, first],
        factorisation.eval_phi(meridian)[:, first],
    )
    left, added = blocks.copy(), np.zeros_like(blocks)
    for unit, m in enumerate(orders):
        product = _product(*exact, unit) * norm[m]
        left[m] -= product
        added[m] += _product(*tabled, unit) * norm[m] - product
    return SeparableReport(
        relative_error=_energy(left, norm, pair_weight) / total,
        tabulation=_energy(added, norm, pair_weight) / total,
    )


def _product(
    psi: Float64[F64, "n units"], phi: Float64[F64, "n units channels"], unit: int
) -> Float64[F64, "n n channels"]:
    product: F64 = psi[:, unit, None, None] * phi[:, unit]
    return product


def _energy(
    blocks: Float64[F64, "orders n n channels"],
    norm: Float64[F64, " orders"],
    weight: Float64[F64, "n n 1"],
) -> float:
    return float(
        sum((block * block * weight).sum() / n for block, n in zip(blocks, norm, strict=True))
    )
