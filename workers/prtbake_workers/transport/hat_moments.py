"""The dipole integrated over triangles, as weights of their corners.

Transfer is linear over a triangle T, so what a point x gets from it needs

    w_j = integral over T of R_d(|x - y|) lambda_j(y) dA

with the barycentric coordinates lambda.  A point sum is no substitute near x: where the mean free
path is short, R_d is a spike of height 1 / path^2.  With p the foot of x in the triangle's plane,
rho the distance from p and Phi' = rho R_d (see `Dipole`), the divergence theorem takes both moments
to the edges, m being an edge's outward normal:

    integral R_d dA         = sum over edges of integral (Phi(rho) - Phi(0)) dtheta,
    integral (y - p) R_d dA = sum over edges of m integral Phi(rho) ds,

theta the angle at p.  What is left is smooth: in theta where the edge's line is further from p than
the source, else in u of s = w sinh(u), w the distance from the source to the line, where
``(Phi(rho) - Phi(0)) / rho^2`` has no scale below w, and where ``exp(-s d) / d ds = exp(-s w cosh
u) du``.  Triangles that are small for their distance from the source take a plain quadrature.
"""

import numpy as np

from prtbake_workers.arrays import B8, F64, Float64
from prtbake_workers.transport.dipole import Dipole, rise

N_NODES = 12
"""Gauss-Legendre nodes an edge: 1e-4 of the total reflectance at worst, mostly 1e-7."""

PLAIN_FROM = 2.0
"""Distance from the source, over the triangle's radius, from which the plain rule serves."""

PAIRS_PER_CHUNK = 1 << 12
"""Pairs of point and triangle at a time: arrays of 1.5 MB."""

NEGLIGIBLE_EXPONENT = 40.0
"""Where exp(-s (d - w)) is below this power of 1 / e, the edge is cut off."""

_ROOT = float(np.sqrt(15.0))
_INNER, _OUTER = (6.0 + _ROOT) / 21.0, (6.0 - _ROOT) / 21.0

RULE_POINTS = np.array(
    [[1.0 / 3.0] * 3]
    + [list(np.roll([1.0 - 2.0 * a, a, a], turn)) for a in (_INNER, _OUTER) for turn in range(3)]
)
"""Radon's seven points of the triangle, exact to degree 5, in barycentric coordinates."""

RULE_WEIGHTS = np.array(
    [9.0 / 40.0] + [(155.0 + _ROOT) / 1200.0] * 3 + [(155.0 - _ROOT) / 1200.0] * 3
)
"""Their weights, which sum to 1."""


def hat_moments(
    dipole: Dipole, points: Float64[F64, "pairs 3"], corners: Float64[F64, "pairs 3 3"]
) -> Float64[F64, "channels pairs 3"]:
    """Integrate R_d times each corner's barycentric coordinate over triangles.

    Parameters
    ----------
    dipole
        Gives R_d.
    points, corners
        A point and a triangle of positive area each, in scene units.

    Returns
    -------
    array
        w_j, not negative; over the corners they sum to the integral of R_d.  Where rounding puts
        a weight of a sliver outside [0, sum] it is put back.
    """
    weights = np.empty((dipole.n_channels, len(points), 3))
    source = float(dipole.mean_free_path.min())
    for start in range(0, len(points), PAIRS_PER_CHUNK):
        part = slice(start, start + PAIRS_PER_CHUNK)
        centres = corners[part].mean(axis=1)
        radii = np.linalg.norm(corners[part] - centres[:, None], axis=2).max(axis=1)
        distance = np.hypot(np.linalg.norm(centres - points[part], axis=1), source)
        near = distance < PLAIN_FROM * radii
        found = np.empty((dipole.n_channels, len(near), 3))
        found[:, near] = _by_edges(dipole, points[part][near], corners[part][near])
        found[:, ~near] = _by_points(dipole, points[part][~near], corners[part][~near])
        weights[:, part] = found
    return weights


def _by_points(
    dipole: Dipole, points: Float64[F64, "pairs 3"], corners: Float64[F64, "pairs 3 3"]
) -> Float64[F64, "channels pairs 3"]:
    """Sum over the seven points of the plain rule."""
    samples = np.einsum("kj,pji->pki", RULE_POINTS, corners)
    distance = np.linalg.norm(samples - points[:, None], axis=2)
    profile = dipole.profile(distance.ravel()).reshape(dipole.n_channels, *distance.shape)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(across, axis=1)
    return np.asarray((profile @ (RULE_WEIGHTS[:, None] * RULE_POINTS)) * areas[:, None])


def _by_edges(
    dipole: Dipole, points: Float64[F64, "pairs 3"], corners: Float64[F64, "pairs 3 3"]
) -> Float64[F64, "channels pairs 3"]:
    """Integrate along the edges."""
    weights = np.empty((dipole.n_channels, len(points), 3))
    edges = _Edges(points, corners)
    for channel in range(dipole.n_channels):
        zeroth, first = edges.moments(dipole.depths[channel], float(dipole.decay[channel]))
        hats = edges.feet * zeroth[:, None] + np.einsum("pji,pi->pj", edges.slopes, first)
        inside = np.clip(hats, 0.0, zeroth[:, None])
        total = inside.sum(axis=1)
        share = np.divide(zeroth, total, out=np.zeros_like(total), where=total > 0.0)
        weights[channel] = dipole.albedo[channel] / (4.0 * np.pi) * share[:, None] * inside
    return weights


class _Edges:
    """Triangles seen from the feet of their points.

    Attributes
    ----------
    feet, slopes
        Barycentric coordinates of each foot, and their gradients, a row a corner.
    """

    def __init__(self, points: Float64[F64, "pairs 3"], corners: Float64[F64, "pairs 3 3"]) -> None:
        away = corners - points[:, None]
        across = np.cross(away[:, 1] - away[:, 0], away[:, 2] - away[:, 0])
        doubled = np.linalg.norm(across, axis=1)
        normal = across / doubled[:, None]
        # the mean over the corners: one of them would lose digits in a sliver
        height = np.einsum("pji,pi->p", away, normal) / 3.0
        flat = away - np.einsum("pji,pi->pj", away, normal)[:, :, None] * normal[:, None]
        edges = np.roll(flat, -1, axis=1) - flat
        lengths = np.linalg.norm(edges, axis=2)
        along = edges / lengths[:, :, None]
        self.outward = np.cross(along, normal[:, None])
        self.height = np.abs(height)
        self.offset = np.einsum("pji,pji->pj", flat, self.outward)
        self.start = np.einsum("pji,pji->pj", flat, along)
        self.stop = self.start + lengths
        opposite = np.roll(edges, -1, axis=1)
        self.slopes = np.cross(normal[:, None], opposite) / doubled[:, None, None]
        self.feet = -np.einsum("pji,pji->pj", self.slopes, np.roll(flat, -1, axis=1))

    def moments(
        self, depths: Float64[F64, "2"], decay: float
    ) -> tuple[Float64[F64, " pairs"], Float64[F64, "pairs 3"]]:
        """Integrate 1 and y - p against 4 pi R_d / alpha'."""
        zeroth = np.zeros(len(self.height))
        first = np.zeros((len(self.height), 3))
        for z in depths:
            below = np.hypot(self.height, z)[:, None]
            line = np.hypot(self.offset, below)
            close = np.abs(self.offset) < below
            risen = np.empty_like(line)
            risen[close] = self._risen_by_length(close, line, below, decay)
            risen[~close] = self._risen_by_angle(~close, below, decay)
            zeroth += z * (risen / below).sum(axis=1)
            first -= np.einsum("pji,pj->pi", self.outward, z * self._along(line, decay))
        return np.maximum(zeroth, 0.0), first

    def _risen_by_angle(self, which: B8, below: F64, decay: float) -> Float64[F64, " edges"]:
        """Integrate `rise` over the angle that edges span at the foot."""
        nodes, weights = _gauss()
        depth = np.broadcast_to(below, which.shape)[which]
        offset = self.offset[which]
        distance = np.abs(offset)
        turn = np.arctan2(self.start[which], distance)
        angle = np.arctan2(self.stop[which], distance) - turn
        radius = distance[:, None] / np.cos(turn[:, None] + angle[:, None] * nodes)
        return np.asarray(
            np.copysign(angle, offset) * (rise(radius, depth[:, None], decay) @ weights)
        )

    def _risen_by_length(
        self, which: B8, line: F64, below: F64, decay: float
    ) -> Float64[F64, " edges"]:
        """Integrate the same where an edge's line passes so near that the angle turns at once."""
        nodes, weights = _gauss()
        depth = np.broadcast_to(below, which.shape)[which]
        offset, line = self.offset[which], line[which]
        low = np.arcsinh(self.start[which] / line)
        span = np.arcsinh(self.stop[which] / line) - low
        u = low[:, None] + span[:, None] * nodes
        radius = np.hypot(offset[:, None], line[:, None] * np.sinh(u))
        risen = rise(radius, depth[:, None], decay)
        # at the foot itself the ratio has a limit, but no weight: the offset is then zero
        ratio = np.divide(risen, radius, out=np.zeros_like(risen), where=radius > 0.0)
        slope = np.divide(
            offset[:, None] * line[:, None], radius, out=np.zeros_like(risen), where=radius > 0.0
        )
        return np.asarray(span * ((ratio * slope * np.cosh(u)) @ weights))

    def _along(self, line: Float64[F64, "pairs 3"], decay: float) -> Float64[F64, "pairs 3"]:
        """Integrate exp(-decay d) / d over each edge, its line at the distance ``line``."""
        nodes, weights = _gauss()
        exponent = decay * line
        with np.errstate(divide="ignore", over="ignore"):
            most = np.arccosh(1.0 + NEGLIGIBLE_EXPONENT / exponent)
        low = np.clip(np.arcsinh(self.start / line), -most, most)
        span = np.clip(np.arcsinh(self.stop / line), -most, most) - low
        u = low[:, :, None] + span[:, :, None] * nodes
        return np.asarray(span * (np.exp(-exponent[:, :, None] * np.cosh(u)) @ weights))


def _gauss() -> tuple[Float64[F64, " nodes"], Float64[F64, " nodes"]]:
    """Give nodes and weights of the interval [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(N_NODES)
    return 0.5 * (nodes + 1.0), 0.5 * weights
