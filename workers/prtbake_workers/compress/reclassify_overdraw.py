"""Vertices moved to a neighbour's cluster where that saves draws, within a budget of error.

The greedy search of [Sloan2003]_ section 5: every vertex is tried in the clusters of the vertices
that it shares triangles with, and the move that saves most draws for the squared error it adds goes
first.  What a move does to vertex and neighbours is brought up to date before the next one.
"""

import heapq
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F64, I32, I64, Float64, Int32

BUDGET = 0.05
"""Of the squared error: [Sloan2003]_ section 7."""

ErrorsIn = Callable[[int, I64], F64]
"""From a cluster and vertices to the squared errors that these have, or would have, in it."""


class Reclassified(NamedTuple):
    """Clusters after the search.

    Attributes
    ----------
    labels, errors
        Cluster of each vertex and its squared error there, without its weight.
    n_moves
        Moves made; a vertex may move more than once.
    saved
        Draws saved, triangles times clusters.
    """

    labels: Int32[I32, " verts"]
    errors: Float64[F64, " verts"]
    n_moves: int
    saved: int


def reclassify_for_overdraw(
    faces: Int32[I32, "tris 3"],
    labels: Int32[I32, " verts"],
    errors: Float64[F64, " verts"],
    errors_in: ErrorsIn,
    *,
    weights: Float64[F64, " verts"],
    most_error: float,
) -> Reclassified:
    """Move vertices to neighbouring clusters, the most draws saved for the error first.

    Parameters
    ----------
    faces
        Corners of each triangle, indices into ``labels``.
    labels, errors
        Cluster of each vertex and its squared error there.
    errors_in
        Squared errors in other clusters, whose data stay as they are.
    weights
        Weight of each vertex in the squared error, >= 0.
    most_error
        The weighted squared error never exceeds this, or its start where that is above.

    Notes
    -----
    A move saves draws, or costs none and lowers the error: so the search ends, and overdraw never
    rises.  Moves that add no error go first, and leave room for others.  A move for which there is
    no room is passed over for smaller ones.  No cluster is emptied.  Ties go to the vertex, then
    the cluster, of lower index.
    """
    search = _Search(faces, labels, errors, errors_in, weights)
    n_moves, saved = search.run(most_error)
    found = np.array(search.labels, dtype=np.int32)
    return Reclassified(found, np.array(search.errors), n_moves, saved)


class _Search:
    """Labels, errors, and a queue of moves that is put right around each move made.

    What is looked up once a move, for a handful of vertices, lies in lists and sets: arrays of so
    few elements would take ten times as long.
    """

    def __init__(
        self,
        faces: Int32[I32, "tris 3"],
        labels: Int32[I32, " verts"],
        errors: Float64[F64, " verts"],
        errors_in: ErrorsIn,
        weights: Float64[F64, " verts"],
    ) -> None:
        self.weights, self.errors_in = weights, errors_in
        self.faces = faces
        self.labels: list[int] = labels.tolist()
        self.errors: list[float] = errors.tolist()
        # each vertex's triangles, once each also where a triangle has a corner twice
        n_tris = max(1, len(faces))
        keys = np.unique(faces.astype(np.int64) * n_tris + np.arange(len(faces))[:, None])
        verts, self.tris_of = np.divmod(keys, n_tris)
        self.ends = np.searchsorted(verts, np.arange(len(labels) + 1))
        self.rings: dict[int, list[list[int]]] = {}
        self.sizes = np.bincount(labels).tolist()
        self.versions = [0] * len(labels)
        self.known: dict[tuple[int, int], float] = {}
        self.queue: list[tuple[bool, float, float, int, int, int, int]] = []

    def run(self, most_error: float) -> tuple[int, int]:
        """Make moves until none is left that fits; return how many, and the draws they saved."""
        total = float(self.weights @ np.array(self.errors))
        own = np.array(self.labels, dtype=np.int32)[self.faces]
        border = np.unique(self.faces[(own != own[:, :1]).any(axis=1)]).tolist()
        self._offer(border)
        n_moves = saved_in_all = 0
        while self.queue:
            _, _, added, vert, cluster, saved, version = heapq.heappop(self.queue)
            label = self.labels[vert]
            if version != self.versions[vert] or self.sizes[label] == 1:
                continue
            if added > 0.0 and total + added > most_error:
                continue
            total += added
            n_moves += 1
            saved_in_all += saved
            self.sizes[label] -= 1
            self.sizes[cluster] += 1
            self.known[vert, label] = self.errors[vert]
            self.labels[vert], self.errors[vert] = cluster, self.known[vert, cluster]
            around = sorted({corner for others in self._ring(vert) for corner in others} | {vert})
            for one in around:
                self.versions[one] += 1
            self._offer(around)
        return n_moves, saved_in_all

    def _ring(self, vert: int) -> list[list[int]]:
        """Return the other corners of each of a vertex's triangles."""
        ring = self.rings.get(vert)
        if ring is None:
            tris = self.tris_of[self.ends[vert] : self.ends[vert + 1]]
            ring = [
                [corner for corner in triangle if corner != vert]
                for triangle in self.faces[tris].tolist()
            ]
            self.rings[vert] = ring
        return ring

    def _offer(self, verts: list[int]) -> None:
        """Queue the vertices' moves that save draws, or error at no draw."""
        around = [
            [{self.labels[corner] for corner in others} for others in self._ring(vert)]
            for vert in verts
        ]
        tried = [
            sorted(set().union(*clusters) - {self.labels[vert]})
            for vert, clusters in zip(verts, around, strict=True)
        ]
        self._evaluate(
            [(vert, one) for vert, clusters in zip(verts, tried, strict=True) for one in clusters]
        )
        for vert, rings, clusters in zip(verts, around, tried, strict=True):
            own, weight = self.labels[vert], float(self.weights[vert])
            here = sum(own not in others for others in rings)
            for cluster in clusters:
                saved = here - sum(cluster not in others for others in rings)
                added = weight * (self.known[vert, cluster] - self.errors[vert])
                if saved < 0 or (saved == 0 and added >= 0.0):
                    continue
                costs = added > 0.0
                rank = -saved / added if costs else -float(saved)
                move = (costs, rank, added, vert, cluster, saved, self.versions[vert])
                heapq.heappush(self.queue, move)

    def _evaluate(self, pairs: list[tuple[int, int]]) -> None:
        """Ask for the errors of vertices in clusters that are not known yet."""
        asked: dict[int, list[int]] = {}
        for vert, cluster in pairs:
            if (vert, cluster) not in self.known:
                asked.setdefault(cluster, []).append(vert)
        for cluster, verts in sorted(asked.items()):
            errors = self.errors_in(cluster, np.array(verts, dtype=np.int64)).tolist()
            self.known |= {(vert, cluster): one for vert, one in zip(verts, errors, strict=True)}
