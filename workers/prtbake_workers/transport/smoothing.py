"""Bounced transfer averaged over neighbours: fewer rays do, and how far to go is measured.

Every vertex casts rays of its own, so what their small number leaves to chance differs from vertex
to vertex, while bounced light itself hardly does.  A mean over the vertices at the other ends of
the edges keeps the light and takes most of the chance; done again it reaches farther.  How often
pays is told without bias by gathering a few vertices again, twice: with f what was smoothed, x and
y fresh draws of its rows and t the truth, ``E <f - x, f - y> = |f - t|^2``: blur and chance.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.brdf.azimuthal_factorisation import AzimuthalFactorisation
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.scene import Scene

ROUNDS = (1, 2, 4)
"""How often means may be taken, beside never; the radius grows with the root of it."""

SHARPNESS = 4
"""Power of the cosine between normals in the weight of a neighbour."""


@dataclass(frozen=True)
class Smoothing:
    """One round of means over the vertices of a part.

    Attributes
    ----------
    step
        float32, (verts x terms, verts x terms): rows of weights that sum to 1, times the turn from
        one tangent frame to the other between the two terms of a pair.
    n_terms
        Terms of each vertex.
    """

    step: Any
    n_terms: int

    @classmethod
    def of_part(cls, scene: Scene, part: int, factorisation: Factorisation) -> "Smoothing | None":
        """Lay means over a part; None where its terms do not turn with their frames.

        Terms of an isotropic BRDF are waves of the azimuth: those of order m turn by m times the
        angle between frames.  Those of an anisotropic one stay in the frames that were given.

        A vertex that a border makes two of, one a part, is left as it is: both must stay alike.
        """
        if not isinstance(factorisation, AzimuthalFactorisation):
            return None
        rows, columns, weights = _neighbours(scene, part)
        n_verts = int(np.diff(scene.part_ranges[part])[0])
        if factorisation.is_constant_phi:
            step = coo_array((weights, (rows, columns)), shape=(n_verts, n_verts))
        else:
            first = scene.part_ranges[part][0]
            turn = _turns(scene, first + rows, first + columns)
            step = _with_terms(rows, columns, weights, turn, factorisation, n_verts)
        return cls(step.astype(np.float32).tocsr(), factorisation.n_terms)

    def apply(
        self, added: Float32[F32, "verts channels terms coeffs"], rounds: int
    ) -> Float32[F32, "verts channels terms coeffs"]:
        """Take means ``rounds`` times."""
        n_verts, n_channels, n_terms, n_coeffs = added.shape
        for _ in range(rounds):
            smooth = np.empty_like(added)
            for channel in range(n_channels):
                flat = np.ascontiguousarray(added[:, channel]).reshape(-1, n_coeffs)
                smooth[:, channel] = (self.step @ flat).reshape(n_verts, n_terms, n_coeffs)
            added = smooth
        return added

    def rows(self, vertices: Int64[I64, " chosen"]) -> tuple[Int64[I64, " around"], Any]:
        """Give the vertices that one round reads for some, and the rows that take their means."""
        n_terms = self.n_terms
        reach = self.step[(vertices[:, None] * n_terms + np.arange(n_terms)).ravel()]
        around = np.unique(reach.indices // n_terms)
        return around, reach[:, (around[:, None] * n_terms + np.arange(n_terms)).ravel()]

    def at(
        self,
        added: Float32[F32, "verts channels terms coeffs"],
        vertices: Int64[I64, " chosen"],
        rounds: tuple[int, ...] = ROUNDS,
    ) -> list[Float32[F32, "chosen channels terms coeffs"]]:
        """Give some vertices after each of several numbers of rounds, without all others."""
        n_verts, n_channels, n_terms, n_coeffs = added.shape
        wanted = (vertices[:, None] * n_terms + np.arange(n_terms)).ravel()
        shape = (len(wanted), n_verts * n_terms)
        ones = np.ones(len(wanted), np.float32)
        reach = coo_array((ones, (np.arange(len(wanted)), wanted)), shape=shape).tocsr()
        found = []
        for number in range(max(rounds, default=-1) + 1):
            if number:
                reach = csr_array(reach @ self.step)
            if number in rounds:
                values = [
                    reach @ np.ascontiguousarray(added[:, channel]).reshape(-1, n_coeffs)
                    for channel in range(n_channels)
                ]
                found.append(
                    np.stack([one.reshape(len(vertices), n_terms, n_coeffs) for one in values], 1)
                )
        return found


def _neighbours(
    scene: Scene, part: int
) -> tuple[Int64[I64, " n"], Int64[I64, " n"], Float64[F64, " n"]]:
    """Weigh each vertex of a part and its neighbours by area and by how alike their normals are.

    Vertices are numbered within the part; those that a seam of coordinates made of one count once.
    """
    start, stop = scene.part_ranges[part]
    # numbers of the scene until the end
    twins = scene.twins
    own = np.arange(start, stop)
    least, most = (np.full(scene.n_vertices, value) for value in (scene.n_vertices, -1))
    parts = np.repeat(
        np.arange(len(scene.part_ranges)), [last - first for first, last in scene.part_ranges]
    )
    np.minimum.at(least, twins, parts)
    np.maximum.at(most, twins, parts)
    on_border = (least != most)[twins[own]]
    # the first of each group of twins within the part stands for it
    groups, first_of, group = np.unique(twins[own], return_index=True, return_inverse=True)
    areas = np.bincount(group, scene.areas[own], minlength=len(groups))
    faces = group[scene.faces[scene.part_of_face == part] - start]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    alone = np.arange(len(groups))[:, None].repeat(2, axis=1)
    both = np.concatenate([ends, ends[:, ::-1], alone])
    # as single numbers: sorting rows takes twenty times as long
    distinct = np.unique(both[:, 0] * np.int64(len(groups)) + both[:, 1])
    pairs = np.column_stack(np.divmod(distinct, len(groups)))
    normals = scene.normals[own[first_of]]
    alike = np.maximum((normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1), 0.0)
    weights = np.maximum(areas[pairs[:, 1]], 0.0) * alike**SHARPNESS
    keeps = np.zeros(len(groups), bool)
    keeps[group[on_border]] = True
    sums = np.bincount(pairs[:, 0], weights, minlength=len(groups))
    keeps |= ~(sums > 0.0)
    itself = pairs[:, 0] == pairs[:, 1]
    weights = np.where(
        keeps[pairs[:, 0]], itself, weights / np.where(sums > 0.0, sums, 1.0)[pairs[:, 0]]
    )
    used = weights > 0.0
    pairs, weights = pairs[used], weights[used]
    # every member of a group has the row of the group
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group, minlength=len(groups))
    begins = np.concatenate([[0], np.cumsum(counts)])
    repeats = counts[pairs[:, 0]]
    entry = np.repeat(np.arange(len(pairs)), repeats)
    within = np.arange(len(entry)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    rows = order[begins[pairs[entry, 0]] + within]
    columns = first_of[pairs[entry, 1]]
    # a vertex that is left as it is keeps its own frame
    columns = np.where(keeps[pairs[entry, 0]], rows, columns)
    return rows, columns, weights[entry]


def _turns(scene: Scene, to: Int64[I64, " n"], come_from: Int64[I64, " n"]) -> Float64[F64, " n"]:
    """Give the azimuth, in one frame, of another's tangent carried over along the shortest arc."""
    tangent, normal, other = (
        scene.frames[come_from, 0], scene.frames[come_from, 2], scene.frames[to, 2],
    )  # fmt: skip
    axis = np.cross(normal, other)
    cosine = (normal * other).sum(axis=1, keepdims=True)
    along = (axis * tangent).sum(axis=1, keepdims=True)
    # of Rodrigues' formula, with the sine in the length of the axis
    carried = (
        tangent * cosine + np.cross(axis, tangent) + axis * along / np.maximum(1.0 + cosine, 1e-9)
    )
    local = np.einsum("nij,nj->ni", scene.frames[to], carried)
    return np.asarray(np.arctan2(local[:, 1], local[:, 0]))


def _with_terms(
    rows: Int64[I64, " n"],
    columns: Int64[I64, " n"],
    weights: Float64[F64, " n"],
    turn: Float64[F64, " n"],
    factorisation: AzimuthalFactorisation,
    n_verts: int,
) -> Any:
    """Turn the two terms of every pair from the frame of the column to that of the row."""
    n_terms = factorisation.n_terms
    entries = []
    for term, (order, parity) in enumerate(
        zip(factorisation.orders.tolist(), factorisation.parity.tolist(), strict=True)
    ):
        entries.append((term, term, weights * np.cos(order * turn)))
        if order:
            # cos m (phi + d) = cos m phi cos m d - sin m phi sin m d, and its like
            mate, sign = (term + 1, -1.0) if parity == 0 else (term - 1, 1.0)
            entries.append((term, mate, sign * weights * np.sin(order * turn)))
    at_rows = np.concatenate([rows * n_terms + term for term, _, _ in entries])
    at_columns = np.concatenate([columns * n_terms + mate for _, mate, _ in entries])
    values = np.concatenate([value for _, _, value in entries])
    size = n_verts * n_terms
    return coo_array((values, (at_rows, at_columns)), shape=(size, size))
