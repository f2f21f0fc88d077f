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

from functools import cache

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64
from prtbake_workers.transport.dipole import Dipole, rise

N_NODES = 12
"""Gauss-Legendre nodes an edge: mostly 1e-7 of the total reflectance, 1e-4 on edges like a mesh's.

Worst are edges of many mean free paths that a point is a fraction of one from: 3e-3 of a triangle
500 of its decays long, seen from beside an edge, and up to 9e-3 of an edge by itself.
"""

FEW_NODES = 6
"""Of an edge that is short for its distance, and over which light hardly falls off."""

SHORT_SPAN, SHORT_TURN, SHORT_FALL = 2.0, 1.0, 1.0
"""Most of such an edge: its span of u, its angle from the nearest point of its line, and the
exponent by which exp(-s d) changes along it.  Poles are pi / 2 away in u, so that six nodes leave
1e-6 of the edge's share."""

PLAIN_FROM = 2.0
"""Distance from the source, over the triangle's radius, from which the plain rule serves."""

PAIRS_PER_CHUNK = 1 << 12
"""Pairs of point and triangle at a time: arrays of 1.5 MB."""

TINY = float(np.finfo(np.float64).tiny)

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
            below = np.sqrt(self.height**2 + z * z)
            lines = _Lines(self.offset, self.start, self.stop, below, decay)
            zeroth += z * (lines.risen / below[:, None]).sum(axis=1)
            first -= np.einsum("pji,pj->pi", self.outward, z * lines.along)
        return np.maximum(zeroth, 0.0), first


class _Lines:
    """Integrals along edges, each at the distance ``offset`` from the foot of its point.

    Attributes
    ----------
    risen, along
        Integrals of `rise` over the angle at the foot, and of exp(-decay d) / d over the length,
        shaped as the edges are.
    """

    def __init__(
        self,
        offset: Float64[F64, "pairs 3"],
        start: Float64[F64, "pairs 3"],
        stop: Float64[F64, "pairs 3"],
        below: Float64[F64, " pairs"],
        decay: float,
    ) -> None:
        self._offset, self._start, self._stop = offset.ravel(), start.ravel(), stop.ravel()
        self._below, self._decay = np.repeat(below, 3), decay
        self._line = np.sqrt(self._offset**2 + self._below**2)
        self._low = np.arcsinh(self._start / self._line)
        self._span = np.arcsinh(self._stop / self._line) - self._low
        farthest = np.maximum(np.abs(self._start), np.abs(self._stop))
        # s (d - w) at the end
        fall = decay * (np.sqrt(self._line**2 + farthest**2) - self._line)
        close = np.abs(self._offset) < self._below
        whole = fall < NEGLIGIBLE_EXPONENT
        short = (self._span < SHORT_SPAN) & (fall < SHORT_FALL)
        gentle = (farthest < SHORT_TURN * np.abs(self._offset)) & (fall < SHORT_FALL)
        risen, along = np.empty_like(self._line), np.empty_like(self._line)
        for few, nodes in ((True, FEW_NODES), (False, N_NODES)):
            own = short == few
            both = np.flatnonzero(own & close & whole)
            risen[both], along[both] = self._by_length(both, nodes)
            apart = np.flatnonzero(own & close & ~whole)
            risen[apart] = self._by_length(apart, nodes)[0]
            turning = np.flatnonzero(~close & (gentle == few))
            risen[turning] = self._by_angle(turning, nodes)
            rest = np.flatnonzero(own & ~(close & whole))
            along[rest] = self._along(rest, nodes)
        self.risen, self.along = risen.reshape(offset.shape), along.reshape(offset.shape)

    def _by_angle(self, which: I64, n_nodes: int) -> Float64[F64, " edges"]:
        """Integrate `rise` over the angle that edges span at the foot."""
        nodes, weights = _gauss(n_nodes)
        offset = self._offset[which]
        distance = np.abs(offset)
        turn = np.arctan2(self._start[which], distance)
        angle = np.arctan2(self._stop[which], distance) - turn
        # 1 / cos by way of tan, which takes a tenth of its time
        slope = np.tan(turn[:, None] + angle[:, None] * nodes)
        radius = distance[:, None] * np.sqrt(1.0 + slope * slope)
        risen = rise(radius, self._below[which][:, None], self._decay)
        return np.asarray(np.copysign(angle, offset) * (risen @ weights))

    def _by_length(
        self, which: I64, n_nodes: int
    ) -> tuple[Float64[F64, " edges"], Float64[F64, " edges"]]:
        """Integrate both in u: where the line passes so near that the angle turns at once.

        There ``d = w cosh(u)``, ``dtheta = offset d / rho^2 du``, and d - z, which is
        ``rho^2 / (d + z)``, takes the square of rho out of `rise`.
        """
        nodes, weights = _gauss(n_nodes)
        offset, line = self._offset[which][:, None], self._line[which][:, None]
        depth, span = self._below[which][:, None], self._span[which]
        grown = np.exp(self._low[which][:, None] + span[:, None] * nodes)
        shrunk = 1.0 / grown
        d = (0.5 * line) * (grown + shrunk)
        height = (0.5 * line) * (grown - shrunk)
        squared = offset * offset + height * height
        reach = d + depth
        fallen = np.expm1(-self._decay * squared / reach)
        kept = 1.0 + fallen
        # at the foot itself the ratio has a limit, but no weight: the offset is then zero
        ratio = kept / reach - fallen * d / np.maximum(squared, TINY)
        scale = span * np.exp(-self._decay * self._below[which])
        return scale * offset[:, 0] * (ratio @ weights), scale * (kept @ weights)

    def _along(self, which: I64, n_nodes: int) -> Float64[F64, " edges"]:
        """Integrate exp(-decay d) / d over each edge, as far as it is not negligible."""
        nodes, weights = _gauss(n_nodes)
        low, span = self._low[which], self._span[which]
        exponent = self._decay * self._line[which]
        with np.errstate(divide="ignore", over="ignore"):
            most = np.arccosh(1.0 + NEGLIGIBLE_EXPONENT / exponent)
        high = np.clip(low + span, -most, most)
        low = np.clip(low, -most, most)
        span = high - low
        u = low[:, None] + span[:, None] * nodes
        return np.asarray(span * (np.exp(-exponent[:, None] * np.cosh(u)) @ weights))


@cache
def _gauss(n_nodes: int) -> tuple[Float64[F64, " nodes"], Float64[F64, " nodes"]]:
    """Give nodes and weights of the interval [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(n_nodes)
    return 0.5 * (nodes + 1.0), 0.5 * weights
