"""Geometry coherence: clusters whose vertices also lie near each other on the mesh.

Vertex i pays for cluster j, beside the distance d_ij of its signal,

    E_ij = d_ij + alpha min over k in cluster j, k != i, of |P_i - P_k|    [Chen2005]_ (9), (10)

with ``distances`` d, ``alpha`` and ``positions`` P.  Of its own cluster the vertex itself does not
count: it would be at distance zero, and a vertex alone among others would never leave.

The thesis leaves units open, so that alpha means something else on every mesh and material.  Here
positions are in diagonals of the vertices' bounding box, and signal distances in root mean square
norms of the signal: the same alpha does the same at any scale and albedo.

Clusters found by means take E as it is, and the squared error may rise.  Where clusters have bases,
d is the root of the squared error in them, and a vertex moves only where E and that error both fall
(`CoherentMoves`): so the objective never rises.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import B8, F32, F64, I32, Bool, Float32, Float64, Int32
from prtbake_workers.compress.clusters import members_by_cluster
from prtbake_workers.compress.parallel import map_in_order

ALPHA = 0.05
"""Of the tables of [Chen2005]_."""


@dataclass(frozen=True)
class Coherence:
    """Positions of the vertices, and what distance between them costs.

    Attributes
    ----------
    positions
        P in diagonals of the bounding box.
    alpha
        Root mean square norms of the signal that one diagonal costs, above 0.
    """

    positions: Float64[F64, "verts 3"]
    alpha: float


def coherence_of(positions: NDArray[Any], alpha: float | None) -> Coherence | None:
    """Return the coherence of vertices at ``positions`` (verts, 3); None where it costs nothing.

    Parameters
    ----------
    positions
        In any unit of length.
    alpha
        At least 0; None and 0 are no coherence.

    Raises
    ------
    SettingsError
        Alpha is negative or not finite, or positions are not finite.
    """
    if alpha is None or alpha == 0.0:
        return None
    if not (np.isfinite(alpha) and alpha > 0.0):
        raise SettingsError(f"coherence is {alpha}: at least 0", pointer="/coherence")
    places = np.asarray(positions, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 3 or not np.isfinite(places).all():
        raise SettingsError(
            "coherence needs finite positions of the shape (verts, 3)", pointer="/positions"
        )
    diagonal = float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) else 0.0
    # all in one point: no cluster is farther than another
    return Coherence(places / diagonal, float(alpha)) if diagonal > 0.0 else None


class ClusterPlaces:
    """Where the vertices of each cluster lie, for the last term of E."""

    def __init__(self, coherence: Coherence, labels: Int32[I32, " verts"], n_clusters: int) -> None:
        self.coherence = coherence
        self.n_clusters = n_clusters
        positions = coherence.positions
        if len(positions) != len(labels):
            raise SettingsError(
                f"coherence has {len(positions)} positions for {len(labels)} vertices",
                pointer="/positions",
            )
        self.own = np.full(len(labels), np.inf)
        members = members_by_cluster(labels, n_clusters)

        def plant(cluster: int) -> KDTree | None:
            verts = members[cluster]
            if len(verts) == 0:
                return None
            tree = KDTree(positions[verts])
            # the nearest of two is the vertex itself, or one at the same place
            self.own[verts] = tree.query(positions[verts], k=[2])[0][:, 0]
            return tree

        self.trees = map_in_order(plant, range(n_clusters))

    def own_cost(self) -> Float64[F64, " verts"]:
        """Return what each vertex pays in its own cluster.

        A vertex alone pays for one diagonal, the most there is: it cannot be nearer to nothing.
        """
        return np.asarray(self.coherence.alpha * np.minimum(self.own, 1.0), dtype=np.float64)

    def cost(self, verts: NDArray[Any], cluster: int) -> Float64[F64, " verts"]:
        """Return what vertices pay in a cluster that they are not in."""
        tree = self.trees[cluster]
        if tree is None:
            return np.full(len(verts), self.coherence.alpha)
        nearest = tree.query(self.coherence.positions[verts])[0]
        return np.asarray(self.coherence.alpha * nearest, dtype=np.float64)


class CoherentMoves:
    """What E says to moves by squared error, while clusters are as they are.

    Parameters
    ----------
    coherence, labels, n_clusters
        As of `ClusterPlaces`.
    errors
        Squared error of each vertex in its cluster, and what else is charged for being there.
    unit
        Root mean square norm of the signal, above 0.
    """

    def __init__(
        self,
        coherence: Coherence,
        labels: Int32[I32, " verts"],
        n_clusters: int,
        errors: Float64[F64, " verts"],
        unit: float,
    ) -> None:
        self.places = ClusterPlaces(coherence, labels, n_clusters)
        self.unit = unit
        self.own = np.sqrt(errors) / unit + self.places.own_cost()

    def cost(
        self, verts: NDArray[Any], cluster: int, errors: Float64[F64, " some"]
    ) -> Float64[F64, " some"]:
        """Return E of vertices in a cluster that is not theirs, from their squared errors there."""
        distances = np.sqrt(np.maximum(errors, 0.0)) / self.unit
        return np.asarray(distances + self.places.cost(verts, cluster), dtype=np.float64)

    def pays(
        self, verts: NDArray[Any], cluster: int, errors: Float64[F64, " some"]
    ) -> Bool[B8, " some"]:
        """Tell which vertices would pay less in that cluster than in their own."""
        return np.asarray(self.cost(verts, cluster, errors) < self.own[verts], dtype=np.bool_)


def cheapest_clusters(
    places: ClusterPlaces,
    verts: slice,
    labels: Int32[I32, " verts"],
    distances: Float32[F32, "part_verts clusters"] | Float64[F64, "part_verts clusters"],
) -> Int32[I32, " part_verts"]:
    """Return for vertices the cluster of least E; their own where no other costs less.

    Parameters
    ----------
    places
        Of the clusters as they are.
    verts, labels
        The vertices in question, and the present cluster of every vertex.
    distances
        d, in root mean square norms of the signal.
    """
    rows = np.arange(verts.start, verts.stop)
    own = labels[verts]
    least = distances[np.arange(len(rows)), own] + places.own_cost()[verts]
    chosen = own.copy()
    # d alone is a lower bound of E: only clusters below the vertex's own E can win
    possible = distances < least[:, None]
    possible[np.arange(len(rows)), own] = False
    for cluster in np.flatnonzero(possible.any(axis=0)).tolist():
        tried = np.flatnonzero(possible[:, cluster])
        # what was found since may already be below this one's lower bound
        tried = tried[distances[tried, cluster] < least[tried]]
        if tried.size == 0:
            continue
        total = distances[tried, cluster] + places.cost(rows[tried], cluster)
        less = total < least[tried]
        least[tried[less]] = total[less]
        chosen[tried[less]] = cluster
    return chosen
