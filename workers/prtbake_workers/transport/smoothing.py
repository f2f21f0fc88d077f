"""Bounced transfer averaged over neighbours: fewer rays do, and how far to go is measured.

Every vertex casts rays of its own, so what their small number leaves to chance differs from vertex
to vertex, while bounced light itself hardly does.  A mean over the vertices at the other ends of
the edges keeps the light and takes most of the chance; done again it reaches farther.  How often
pays is told by `bounce_error`.

Terms of an isotropic BRDF are waves of the azimuth.  From one tangent frame to another, turned by
delta, ``c + i s``, c and s the two terms of a pair of order m, turns by ``exp(i m delta)``.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array

from prtbake_workers.arrays import F32, F64, I32, I64, Float32, Float64, Int32, Int64
from prtbake_workers.brdf.azimuthal_factorisation import AzimuthalFactorisation
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.scene import Scene

ROUNDS = (1, 2, 4)
"""How often means may be taken, beside never; the radius grows with the root of it."""

SHARPNESS = 4
"""Power of the cosine between normals in the weight of a neighbour."""


@dataclass(frozen=True)
class Means:
    """Weighted means of some vertices' terms: rows of a sparse matrix for each azimuthal order.

    Attributes
    ----------
    matrices
        (rows, columns) by order: float32 for order 0, complex64 for pairs.
    orders, parity
        Of each term; 0 for the cosine of a pair or for order 0, 1 for the sine.
    """

    matrices: dict[int, Any]
    orders: Int32[I32, " terms"]
    parity: Int32[I32, " terms"]

    def apply(
        self, values: Float32[F32, "columns channels terms coeffs"]
    ) -> Float32[F32, "rows channels terms coeffs"]:
        """Take the means, channel by channel."""
        n_rows = next(iter(self.matrices.values())).shape[0]
        if not self.orders.any():
            # all alike: one product, and no copy
            flat = self.matrices[0] @ values.reshape(len(values), -1)
            return np.asarray(flat.reshape(n_rows, *values.shape[1:]))
        means = np.empty((n_rows, *values.shape[1:]), np.float32)
        for channel in range(values.shape[1]):
            for order, matrix in self.matrices.items():
                cosines, sines = (
                    np.flatnonzero((self.orders == order) & (self.parity == parity))
                    for parity in (0, 1)
                )
                flat = values[:, channel, cosines].reshape(len(values), -1)
                if order:
                    flat = flat + np.complex64(1j) * values[:, channel, sines].reshape(flat.shape)
                found = (matrix @ flat).reshape(n_rows, len(cosines), -1)
                means[:, channel, cosines] = found.real
                if order:
                    means[:, channel, sines] = found.imag
        return means


@dataclass(frozen=True)
class Smoothing:
    """One round of means over the vertices of a part.

    Attributes
    ----------
    weights
        float32, (verts, verts): rows that sum to 1.
    turns
        In radians, beside every weight: from the tangent of the column's vertex, carried over, to
        that of the row's.
    orders, parity
        See `Means`.
    """

    weights: Any
    turns: Float64[F64, " entries"]
    orders: Int32[I32, " terms"]
    parity: Int32[I32, " terms"]

    @classmethod
    def of_part(cls, scene: Scene, part: int, factorisation: Factorisation) -> "Smoothing | None":
        """Lay means over a part; None where its terms do not turn with their frames.

        Those of an anisotropic BRDF stay in the frames that were given.  A vertex that a border
        makes two of, one a part, is left as it is: both must stay alike.
        """
        if not isinstance(factorisation, AzimuthalFactorisation):
            return None
        rows, columns, weights = _neighbours(scene, part)
        first, last = scene.part_ranges[part]
        shape = (last - first, last - first)
        turned = np.zeros(len(rows))
        if factorisation.orders.any():
            turned = _turns(scene, first + rows, first + columns)
        # both in the order of the rows
        order = np.lexsort((columns, rows))
        matrix = coo_array(
            (weights.astype(np.float32)[order], (rows[order], columns[order])), shape
        )
        return cls(matrix.tocsr(), turned[order], factorisation.orders, factorisation.parity)

    @cached_property
    def means(self) -> Means:
        """One round for all vertices."""
        return Means(
            {int(order): self._of_order(int(order)) for order in np.unique(self.orders)},
            self.orders,
            self.parity,
        )

    def apply(
        self, added: Float32[F32, "verts channels terms coeffs"], rounds: int
    ) -> Float32[F32, "verts channels terms coeffs"]:
        """Take means ``rounds`` times."""
        for _ in range(rounds):
            added = self.means.apply(added)
        return added

    def at(self, vertices: Int64[I64, " chosen"], rounds: int) -> Means:
        """Give the means of some vertices after several rounds, without all others'."""
        n_verts = self.weights.shape[0]
        ones = np.ones(len(vertices), np.float32)
        chosen = coo_array(
            (ones, (np.arange(len(vertices)), vertices)), (len(vertices), n_verts)
        ).tocsr()
        found = {}
        for order, matrix in self.means.matrices.items():
            found[order] = chosen.astype(matrix.dtype)
            for _ in range(rounds):
                found[order] = csr_array(found[order] @ matrix)
        return Means(found, self.orders, self.parity)

    def around(self, vertices: Int64[I64, " chosen"]) -> tuple[Int64[I64, " around"], Means]:
        """Give the vertices that one round reads for some, and the means from these to those."""
        reach = self.weights[vertices]
        around = np.unique(reach.indices).astype(np.int64)
        matrices = {
            order: matrix[vertices][:, around] for order, matrix in self.means.matrices.items()
        }
        return around, Means(matrices, self.orders, self.parity)

    def _of_order(self, order: int) -> Any:
        if not order:
            return self.weights
        turned = (self.weights.data * np.exp(1j * order * self.turns)).astype(np.complex64)
        return csr_array((turned, self.weights.indices, self.weights.indptr), self.weights.shape)


def _neighbours(
    scene: Scene, part: int
) -> tuple[Int64[I64, " n"], Int64[I64, " n"], Float64[F64, " n"]]:
    """Weigh each vertex of a part and its neighbours by area and by how alike their normals are.

    Vertices are numbered within the part; those that a seam of coordinates made of one count once.
    """
    start, stop = scene.part_ranges[part]
    own = np.arange(start, stop)
    # the first of each group of twins within the part stands for it
    groups, first_of, group = np.unique(scene.twins[own], return_index=True, return_inverse=True)
    areas = np.bincount(group, scene.areas[own], minlength=len(groups))
    faces = group[scene.faces[scene.part_of_face == part] - start]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    alone = np.arange(len(groups))[:, None].repeat(2, axis=1)
    ones = np.ones(2 * len(ends) + len(alone), np.float32)
    both = np.concatenate([ends, ends[:, ::-1], alone])
    met = coo_array((ones, (both[:, 0], both[:, 1])), (len(groups), len(groups))).tocsr()
    to = np.repeat(np.arange(len(groups)), np.diff(met.indptr))
    come_from = met.indices.astype(np.int64)
    normals = scene.normals[own[first_of]]
    alike = np.maximum((normals[to] * normals[come_from]).sum(axis=1), 0.0)
    weights = np.maximum(areas[come_from], 0.0) * alike**SHARPNESS
    sums = np.bincount(to, weights, minlength=len(groups))
    # of no area, without a normal, or on a border
    keeps = ~(sums > 0.0)
    keeps[group[_on_border(scene)[own]]] = True
    weights = np.where(keeps[to], to == come_from, weights / np.where(keeps, 1.0, sums)[to])
    used = weights > 0.0
    to, come_from, weights = to[used], come_from[used], weights[used]
    # every member of a group has the row of the group
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group, minlength=len(groups))
    begins = np.cumsum(counts) - counts
    repeats = counts[to]
    entry = np.repeat(np.arange(len(to)), repeats)
    within = np.arange(len(entry)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    rows = order[begins[to[entry]] + within]
    # a vertex that is left as it is keeps its own frame
    columns = np.where(keeps[to[entry]], rows, first_of[come_from[entry]])
    return rows, columns, weights[entry]


def _on_border(scene: Scene) -> Any:
    """Tell which vertices have twins in another part."""
    if len(scene.part_ranges) == 1:
        return np.zeros(scene.n_vertices, np.bool_)
    parts = np.repeat(
        np.arange(len(scene.part_ranges)), [last - first for first, last in scene.part_ranges]
    )
    least, most = np.full(scene.n_vertices, len(scene.part_ranges)), np.full(scene.n_vertices, -1)
    np.minimum.at(least, scene.twins, parts)
    np.maximum.at(most, scene.twins, parts)
    return (least != most)[scene.twins]


def _turns(scene: Scene, to: Int64[I64, " n"], come_from: Int64[I64, " n"]) -> Float64[F64, " n"]:
    """Give the azimuth, in one frame, of another's tangent carried over along the shortest arc."""
    tangent, normal = scene.frames[come_from, 0], scene.frames[come_from, 2]
    other = scene.frames[to, 2]
    axis = np.cross(normal, other)
    cosine = (normal * other).sum(axis=1, keepdims=True)
    along = (axis * tangent).sum(axis=1, keepdims=True)
    # of Rodrigues' formula, with the sine in the length of the axis
    carried = (
        tangent * cosine + np.cross(axis, tangent) + axis * along / np.maximum(1.0 + cosine, 1e-9)
    )
    local = np.einsum("nij,nj->ni", scene.frames[to], carried)
    # none from a vertex to itself, even if it has no normal
    return np.where(to == come_from, 0.0, np.arctan2(local[:, 1], local[:, 0]))
