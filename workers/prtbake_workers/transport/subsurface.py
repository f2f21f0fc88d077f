"""Subsurface scattering of diffuse transfer: a sparse matrix of dipoles, far light in clusters.

With T the diffuse transfer of the surface, so that E = pi T is its irradiance transfer, the
radiance that leaves x after scattering inside is, averaged over the directions of leaving,

    T_out(x) = F integral of R_d(|x - y|) T(y) dA(y),                     [Jensen2002]_, section 3

with F the share of diffuse light that enters (`Dipole.entering_transmittance`).  It is linear in
every coefficient.  On the way out no Fresnel factor is left: R_d is power that has left already,
and F_t(w_o) only shares it out among directions, its mean over the cosine being divided out.
Reciprocity, visibility through the inside and the single-scattering term are not in the dipole.

T is linear over triangles.  A cluster stands for its triangles where it is small seen from the
source, which lies a mean free path below x: its area over ``r^2 + z_r^2`` is the solid angle of
[Jensen2002]_.  It counts with R_d averaged over its triangles, to second order, times the mean of
T.  Triangles that are not small are integrated (`hat_moments`), so that a mean free path below the
sampling distance is no special case: T_out then tends to F R T, R the total reflectance.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.hat_moments import hat_moments
from prtbake_workers.transport.triangle_octree import TriangleOctree, build_triangle_octree

MAX_SOLID_ANGLE = 0.3
"""Of a cluster that stands for its members, in steradians."""

DROPPED_SHARE = 1e-4
"""Share of the total reflectance that what is too far away to count may hold, at most."""

VERTICES_PER_CHUNK = 512
"""Rows built and multiplied at a time: some 500,000 entries a channel."""

COLUMNS_PER_PRODUCT = 64
"""Coefficients whose cluster means are summed at a time in float64."""

CUT_RADII = 4096
"""Radii tried for the distance at which all light is too far away to count."""


@dataclass(frozen=True)
class SubsurfaceBlock:
    """Rows of the operator.

    Attributes
    ----------
    matrices
        float32, (rows, verts + nodes), one a channel: weights of the vertices' own transfer, and
        of its means over the clusters (see `SubsurfaceOperator.sources`).
    n_clusters, n_triangles
        Clusters that stand for their members, and triangles that were integrated.
    bound
        Largest error of each row from clusters and what was dropped, a row a channel, where the
        transfer lies in [-1, 1]; None where it was not asked for.
    """

    matrices: tuple[Any, ...]
    n_clusters: int
    n_triangles: int
    bound: Float64[F64, "channels rows"] | None


@dataclass(frozen=True)
class SubsurfaceReport:
    """What the scattering did.

    Attributes
    ----------
    albedo
        F R, what a plane under even light gives back, a channel each.
    mean_free_path, extent
        1 / sigma_t' and the radius in which 99 % of the reflected light leaves, in scene units.
    resolution
        Mean free path over the sampling distance, the root of a vertex's mean area.  Well below 1
        light does not reach the next vertex.
    clusters, triangles
        Entries a vertex, on average.
    """

    albedo: tuple[float, ...]
    mean_free_path: tuple[float, ...]
    extent: tuple[float, ...]
    resolution: tuple[float, ...]
    clusters: float
    triangles: float

    def to_dict(self) -> dict[str, Any]:
        """Give the report as JSON."""
        return asdict(self)


@dataclass(frozen=True)
class ScatteredTransfer:
    """T_out, one row of coefficients a channel and vertex; the report beside it."""

    transfer: Float32[F32, "channels verts coeffs"]
    report: SubsurfaceReport


class SubsurfaceOperator:
    """Takes the transfer of a scene of one material to what leaves it after scattering inside.

    Parameters
    ----------
    scene
        All parts scatter, and light passes from one to another as if what is between were the
        material too: pass parts that do not touch one by one where it should not.
    dipole
        In units of the scene.
    max_solid_angle
        Of clusters that stand for their members, in steradians; 0 integrates every triangle.
    dropped_share
        Share of the total reflectance, in [0, 1), that may be dropped with all that is too far
        away to count: a bound that holds for any light.
    tree
        Of the scene, where it is built already.

    Raises
    ------
    SettingsError
        A negative solid angle or a share outside [0, 1).

    Notes
    -----
    Nothing is normalised: at an open edge light leaves the surface, and at a crease the
    tangent planes give less than a full turn; so rows do not sum to the same everywhere.
    """

    def __init__(
        self,
        scene: Scene,
        dipole: Dipole,
        *,
        max_solid_angle: float = MAX_SOLID_ANGLE,
        dropped_share: float = DROPPED_SHARE,
        tree: TriangleOctree | None = None,
    ) -> None:
        if not max_solid_angle >= 0.0:
            raise SettingsError(f"max_solid_angle must not be negative, got {max_solid_angle}")
        if not 0.0 <= dropped_share < 1.0:
            raise SettingsError(f"dropped_share must lie in [0, 1), not {dropped_share}")
        self.scene = scene
        self.dipole = dipole
        self.max_solid_angle = max_solid_angle
        self.dropped_share = dropped_share
        self.tree = tree or build_triangle_octree(scene.positions, scene.faces)

    @cached_property
    def resolution(self) -> Float64[F64, " channels"]:
        """Mean free path over the sampling distance; infinite where nothing has an area."""
        areas = self.scene.areas[self.scene.areas > 0.0]
        spacing = float(np.sqrt(areas.mean())) if len(areas) else 0.0
        with np.errstate(divide="ignore"):
            return np.asarray(self.dipole.mean_free_path / spacing)

    @cached_property
    def cut(self) -> float:
        """Distance from which all of the surface together gives less than the share dropped."""
        total = self.dipole.total_reflectance
        if self.dropped_share == 0.0 or not self.tree.n_nodes:
            return np.inf
        # the furthest that anything can be, down to nothing, in steps of half a per cent
        distance = 4.0 * float(self.tree.radii[0]) * np.geomspace(1e-9, 1.0, CUT_RADII)
        most = self.dipole.profile(distance) * float(self.tree.areas[0])
        negligible = (most <= self.dropped_share * total[:, None]).all(axis=0)
        return float(distance[np.argmax(negligible)]) if negligible.any() else np.inf

    @cached_property
    def _cut_from(self) -> Float64[F64, " nodes"]:
        """Squared distance from which a node is too far away to count."""
        return np.asarray((self.cut + self.tree.radii) ** 2)

    @cached_property
    def _small_from(self) -> Float64[F64, " nodes"]:
        """Squared distance from which a node may stand for its members."""
        # a folded or scattered cluster is wide even where its area is small
        size = np.maximum(self.tree.areas, np.pi * self.tree.radii**2)
        depth = float(self.dipole.mean_free_path.min())
        with np.errstate(divide="ignore"):
            return np.asarray(size / self.max_solid_angle - depth**2)

    def sources(self, transfer: Float32[F32, "verts coeffs"]) -> Float32[F32, "sources coeffs"]:
        """Put the area-weighted means over the clusters below the vertices' own transfer."""
        n_verts, n_coeffs = transfer.shape
        result = np.empty((n_verts + self.tree.n_nodes, n_coeffs), np.float32)
        result[:n_verts] = transfer
        for start in range(0, n_coeffs, COLUMNS_PER_PRODUCT):
            part = slice(start, start + COLUMNS_PER_PRODUCT)
            result[n_verts:, part] = self.tree.means @ transfer[:, part].astype(np.float64)
        return result

    def block(self, rows: Int64[I64, " rows"], *, with_bound: bool = False) -> SubsurfaceBlock:
        """Build rows of the operator: those of vertices, see `block_at`."""
        return self.block_at(self.scene.positions[rows], with_bound=with_bound)

    def block_at(
        self, points: Float64[F64, "rows 3"], *, with_bound: bool = False
    ) -> SubsurfaceBlock:
        """Build the rows of any points of the surface.

        Parameters
        ----------
        points
            A row depends on its point alone, so blocks may be cut in any way.
        with_bound
            Bound their error too.  R_d falls with distance, so over a cluster of radius s at the
            distance r it lies between R_d(r - s) and R_d(r + s): their difference times its area
            bounds what its error can be.  Real errors are ten to a hundred times smaller.
        """
        n_verts, channels = self.scene.n_vertices, self.dipole.n_channels
        entering = self.dipole.entering_transmittance
        n_rows = len(points)
        shape = (n_rows, n_verts + self.tree.n_nodes)
        far_rows, far_nodes, near_rows, near_nodes = self._interactions(points)
        away = points[far_rows] - self.tree.centres[far_nodes]
        areas = entering * self.tree.areas[far_nodes]
        mean = self.dipole.profile_over(away, self.tree.spreads[far_nodes])
        corners = self.scene.faces[self.tree.triangles[near_nodes]]
        near = entering * hat_moments(self.dipole, points[near_rows], self.scene.positions[corners])
        # triangles share corners: one entry each, summed before it is rounded
        at, place = np.unique(near_rows[:, None] * n_verts + corners, return_inverse=True)
        summed = [np.bincount(place.ravel(), own.ravel(), minlength=len(at)) for own in near]
        near_row, near_column = np.divmod(at, max(n_verts, 1))
        # one pattern for all channels
        row = np.concatenate([far_rows, near_row])
        order = np.argsort(row, kind="stable")
        columns = np.concatenate([n_verts + far_nodes, near_column])[order]
        indptr = np.searchsorted(row[order], np.arange(n_rows + 1)).astype(np.int32)
        matrices = tuple(
            csr_array(
                (
                    np.concatenate([mean[c] * areas, summed[c]])[order].astype(np.float32),
                    columns.astype(np.int32),
                    indptr,
                ),
                shape=shape,
            )
            for c in range(channels)
        )
        bound = None
        if with_bound:
            distance, radius = np.linalg.norm(away, axis=1), self.tree.radii[far_nodes]
            most = self.dipole.profile(np.maximum(distance - radius, 0.0))
            least = self.dipole.profile(distance + radius)
            wrong = areas * np.maximum(most - mean, mean - least)
            bound = np.zeros((channels, n_rows))
            for channel in range(channels):
                bound[channel] += np.bincount(far_rows, wrong[channel], minlength=n_rows)
            if np.isfinite(self.cut):
                dropped = entering * self.dropped_share * self.dipole.total_reflectance
                bound += dropped[:, None]
        return SubsurfaceBlock(matrices, len(far_nodes), len(near_nodes), bound)

    def apply(self, transfer: Float32[F32, "verts coeffs"]) -> ScatteredTransfer:
        """Scatter transfer.

        Parameters
        ----------
        transfer
            Diffuse transfer T, bounces included, in any linear basis; without an albedo.

        Returns
        -------
        ScatteredTransfer
            The colour is in it: it is multiplied by no albedo later.

        Raises
        ------
        SettingsError
            Transfer of another number of vertices, or not finite.

        Notes
        -----
        Memory: the result, and the transfer of vertices and clusters, some four times the input.
        """
        n_verts = self.scene.n_vertices
        if len(transfer) != n_verts:
            raise SettingsError(f"the transfer has {len(transfer)} vertices, the scene {n_verts}")
        if not np.isfinite(transfer).all():
            vertex, coeff = np.argwhere(~np.isfinite(transfer))[0].tolist()
            raise SettingsError(
                f"coefficient {coeff} of the transfer to vertex {vertex} is not finite"
            )
        sources = self.sources(transfer)
        result = np.empty((self.dipole.n_channels, *transfer.shape), np.float32)
        n_clusters = n_triangles = 0
        for start in range(0, n_verts, VERTICES_PER_CHUNK):
            rows = np.arange(start, min(start + VERTICES_PER_CHUNK, n_verts))
            block = self.block(rows)
            for channel, matrix in enumerate(block.matrices):
                result[channel, rows] = matrix @ sources
            n_clusters += block.n_clusters
            n_triangles += block.n_triangles
        return ScatteredTransfer(result, self.report(n_clusters, n_triangles))

    def report(self, n_clusters: int, n_triangles: int) -> SubsurfaceReport:
        """Tell what was done, from the counts of the rows of all vertices."""
        dipole, n_verts = self.dipole, max(self.scene.n_vertices, 1)
        return SubsurfaceReport(
            albedo=_floats(dipole.diffuse_albedo),
            mean_free_path=_floats(dipole.mean_free_path),
            extent=_floats(dipole.extent()),
            resolution=_floats(self.resolution),
            clusters=n_clusters / n_verts,
            triangles=n_triangles / n_verts,
        )

    def measured_error(
        self,
        transfer: Float32[F32, "verts coeffs"],
        rows: Int64[I64, " rows"],
        weights: Float64[F64, " rows"] | None = None,
    ) -> float:
        """Measure the squared-error ratio of clusters and cut at some vertices.

        Over all channels, against the same rows with every triangle integrated; 0 where those are
        black.  Rows are weighted by area, or by ``weights``: those that were drawn by area are not
        to be weighted by it again.
        """
        every = SubsurfaceOperator(
            self.scene, self.dipole, max_solid_angle=0.0, dropped_share=0.0, tree=self.tree
        )
        sources = self.sources(transfer)
        error = energy = 0.0
        shares = self.scene.areas[rows] if weights is None else weights
        for part in np.array_split(np.arange(len(rows)), max(1, len(rows) // 4)):
            found, exact = self.block(rows[part]), every.block(rows[part])
            for ours, theirs in zip(found.matrices, exact.matrices, strict=True):
                true = (theirs @ sources).astype(np.float64)
                wrong = (ours @ sources).astype(np.float64) - true
                error += float(shares[part] @ np.vecdot(wrong, wrong))
                energy += float(shares[part] @ np.vecdot(true, true))
        return error / energy if energy else 0.0

    def _interactions(self, points: Float64[F64, "rows 3"]) -> tuple[I64, I64, I64, I64]:
        """Walk the tree for all points at once: rows and nodes of clusters, of triangles."""
        tree = self.tree
        black = not self.dipole.total_reflectance.any()
        n_start = 0 if black or not tree.n_nodes else len(points)
        row, node = np.arange(n_start), np.zeros(n_start, np.int64)
        empty = np.empty(0, np.int64)
        far: list[tuple[I64, I64]] = [(empty, empty)]
        near: list[tuple[I64, I64]] = [(empty, empty)]
        while len(row):
            away = points[row] - tree.centres[node]
            squared = away[:, 0] ** 2 + away[:, 1] ** 2 + away[:, 2] ** 2
            counts, small = squared < self._cut_from[node], squared >= self._small_from[node]
            single = tree.triangles[node] >= 0
            is_far, is_near = counts & small, counts & ~small & single
            far.append((row[is_far], node[is_far]))
            near.append((row[is_near], node[is_near]))
            split = counts & ~small & ~single
            row, node = row[split], node[split]
            n_children = tree.n_children[node].astype(np.int64)
            child = np.arange(int(n_children.sum()))
            child -= np.repeat(np.cumsum(n_children) - n_children, n_children)
            node = np.repeat(tree.first_child[node].astype(np.int64), n_children) + child
            row = np.repeat(row, n_children)
        rows_and_nodes = [
            np.concatenate(part) for pairs in (far, near) for part in zip(*pairs, strict=True)
        ]
        return rows_and_nodes[0], rows_and_nodes[1], rows_and_nodes[2], rows_and_nodes[3]


def _floats(values: Float64[F64, " channels"]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
