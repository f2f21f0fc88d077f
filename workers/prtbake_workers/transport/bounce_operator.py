"""One diffuse bounce as a sparse matrix between vertices.

With T_p the transfer to a vertex, albedo of the vertex left out, light that the surface itself
sends adds

    (1/pi) integral over blocked w of rho(q) T_q max(0, n . w) dw,   q the point seen along w.

Directions drawn with density cos / pi turn the integral into a mean, and T_q is interpolated from
the corners of the triangle hit, so the bounce is ``F T`` with

    F_pj = (1/N) sum over rays i of front_i rho(q_i) b_ij.

Rows are not negative, and sum to at most the largest albedo.  Surfaces are opaque; a ray that hits
the back of a one-sided surface brings nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array, vstack

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import B8, F32, F64, I32, I64, Bool, Float32, Float64, Int64
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.ray_offset import offset_origins
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.hemisphere_rays import cosine_directions, lattice, shifted, shifts
from prtbake_workers.transport.surface import OpaqueSurface, SurfaceHits

RAYS_PER_CHUNK = 1 << 17
"""Rays traced and sorted at a time: about 30 MB."""


@dataclass(frozen=True)
class BounceBlock:
    """Consecutive rows of F.

    Attributes
    ----------
    matrices
        float32, (rows, columns), one a channel, all with the same pattern, indices sorted.
    escaped
        Share of each row's rays that left the scene; 1 where none was traced.
    n_rays, n_hits, n_back_hits
        Rays traced, those that hit anything, those of them that met the back of a one-sided
        surface.
    n_probes, n_self_hits
        Rays traced from the bare vertex as well, and those of them that the offset saved from
        hitting the surface right where they start.
    epsilon
        Offset of the ray origins in scene units.
    """

    matrices: tuple[Any, ...]
    escaped: Float64[F64, " rows"]
    n_rays: int
    n_hits: int
    n_back_hits: int
    n_probes: int
    n_self_hits: int
    epsilon: float

    def counters(self) -> dict[str, int]:
        """Give what a report adds up over blocks."""
        return {
            "bounce_rays": self.n_rays,
            "bounce_hits": self.n_hits,
            "bounce_back_hits": self.n_back_hits,
            "self_hit_probes": self.n_probes,
            "self_hits_saved": self.n_self_hits,
        }


def n_bounce_rows(scene: Scene, two_sided: Bool[B8, " tris"] | None) -> int:
    """Count the rows of F: a vertex each, twice that where a surface has two sides."""
    return scene.n_vertices * (1 if two_sided is None else 2)


def build_bounce_block(
    surface: OpaqueSurface,
    row_range: tuple[int, int],
    *,
    albedo: Albedo,
    n_rays: int,
    seed: int,
    two_sided: Bool[B8, " tris"] | None = None,
) -> BounceBlock:
    """Trace the rays of consecutive rows of F.

    Parameters
    ----------
    surface
        All parts, all of which reflect.
    row_range
        First and one past the last row.  Row v is vertex v.
    albedo
        Met by the rays; one channel or three.
    n_rays
        N rays a row, at least 1.  The error of one row's mean falls as 1/N where what it sees is
        smooth and as N^(-3/4) at silhouettes.
    seed
        Of the shift of every row's rays; a row depends on it and its number alone, so blocks
        stack to the same bytes however they are cut.
    two_sided
        Triangles that reflect on their back too.  Then F has twice the rows and columns: row
        n_vertices + v is the back of vertex v, its normal turned over, and so is the transfer that
        F multiplies.  The rows of backs that reflect nothing are empty.  None: all one-sided.

    Returns
    -------
    BounceBlock
        Without a ray where everything is black; a vertex with no usable normal has an empty row.

    Raises
    ------
    SettingsError
        A range outside the operator, no rays, or an albedo outside its bounds.
    """
    n_rows = n_bounce_rows(surface.scene, two_sided)
    start, stop = row_range
    if not 0 <= start <= stop <= n_rows:
        raise SettingsError(f"row range {start}..{stop} is outside the operator's {n_rows}")
    if n_rays < 1:
        raise SettingsError(f"n_rays must be at least 1, not {n_rays}")
    rows = np.arange(start, stop)
    if albedo.is_black:
        empty = csr_array((stop - start, n_rows), dtype=np.float32)
        matrices = (empty,) * albedo.n_channels
        return BounceBlock(matrices, np.ones(stop - start), 0, 0, 0, 0, 0, surface.epsilon)
    tracer = _Tracer(surface, albedo, n_rays, seed, two_sided)
    step = max(1, RAYS_PER_CHUNK // n_rays)
    chunks = [tracer.trace(rows[i : i + step]) for i in range(0, len(rows), step)]
    if not chunks:
        chunks = [tracer.trace(rows)]
    return stack_blocks(chunks)


def stack_blocks(blocks: Sequence[BounceBlock]) -> BounceBlock:
    """Put blocks of consecutive rows below each other."""
    channels = zip(*(block.matrices for block in blocks), strict=True)
    return BounceBlock(
        matrices=tuple(vstack(parts, format="csr") for parts in channels),
        escaped=np.concatenate([block.escaped for block in blocks]),
        n_rays=sum(block.n_rays for block in blocks),
        n_hits=sum(block.n_hits for block in blocks),
        n_back_hits=sum(block.n_back_hits for block in blocks),
        n_probes=sum(block.n_probes for block in blocks),
        n_self_hits=sum(block.n_self_hits for block in blocks),
        epsilon=blocks[0].epsilon,
    )


class _Tracer:
    """Makes chunks of rows, small enough that their rays stay in memory."""

    def __init__(
        self,
        surface: OpaqueSurface,
        albedo: Albedo,
        n_rays: int,
        seed: int,
        two_sided: B8 | None,
    ) -> None:
        scene = surface.scene
        self.surface = surface
        self.scene = scene
        self.albedo = albedo
        self.two_sided = two_sided
        self.seed = seed
        self.pattern = lattice(n_rays)
        self.n_rows = n_bounce_rows(scene, two_sided)
        reflects = np.ones(self.n_rows, np.bool_)
        if two_sided is not None:
            reflects[scene.n_vertices :] = False
            reflects[scene.n_vertices + scene.faces[two_sided].ravel()] = True
        self.reflects = reflects

    def trace(self, rows: Int64[I64, " rows"]) -> BounceBlock:
        """Trace the rays of a chunk of rows."""
        vertices, back = rows % self.scene.n_vertices, rows >= self.scene.n_vertices
        normals = np.where(back[:, None], -1.0, 1.0) * self.scene.normals[vertices]
        usable = np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 1e-3
        own = np.flatnonzero(usable & self.reflects[rows])
        directions = self._directions(rows[own], vertices[own], normals[own])
        n_own, n = directions.shape[:2]
        points = self.scene.ray_points[vertices[own]]
        sides = np.where(back[own, None], -1.0, 1.0) * self.scene.ray_sides[vertices[own]]
        origins = offset_origins(points, sides, self.surface.epsilon)
        flat = directions.reshape(-1, 3)
        hits = self.surface.intersect(np.repeat(origins, n, axis=0), flat)
        reflects = hits.front
        if self.two_sided is not None:
            reflects = reflects | self.two_sided[hits.triangles]
        escaped = np.ones(len(rows))
        escaped[own] -= np.bincount(hits.rays // n, minlength=n_own) / n
        which = np.flatnonzero(reflects)
        triangles, weights = hits.triangles[which], hits.barycentrics[which]
        # 32-bit numbers throughout: scipy keeps the type, and halves the memory of the indices
        columns = self.scene.faces[triangles]
        columns[~hits.front[which]] += self.scene.n_vertices
        row = own[hits.rays[which] // n].astype(np.int32)
        return BounceBlock(
            matrices=self._matrices(row, columns, triangles, weights, len(rows)),
            escaped=escaped,
            n_rays=len(flat),
            n_hits=len(hits.rays),
            n_back_hits=len(hits.rays) - len(which),
            n_probes=n_own,
            n_self_hits=self._self_hits(points, directions[:, 0], hits),
            epsilon=self.surface.epsilon,
        )

    def _self_hits(self, points: F64, directions: Float32[F32, "own 3"], hits: SurfaceHits) -> int:
        """Count the first rays of rows that hit where they start, but for the offset."""
        first = np.flatnonzero(hits.rays % len(self.pattern) == 0)
        distance = np.full(len(points), np.inf)
        distance[hits.rays[first] // len(self.pattern)] = hits.distance[first]
        bare = self.surface.accelerator.intersect(points.astype(np.float32), directions).distance
        return int(
            np.count_nonzero((bare <= self.surface.epsilon) & (distance > self.surface.epsilon))
        )

    def _directions(self, rows: I64, vertices: I64, normals: F64) -> Float32[F32, "own rays 3"]:
        """Give each row its own cosine-distributed directions."""
        shift = np.empty((0, 2))
        if len(rows):
            first, last = int(rows[0]), int(rows[-1]) + 1
            shift = shifts(self.seed, first, last, 2)[rows - first]
        local = cosine_directions(shifted(self.pattern, shift))
        axes = tangent_frames(self.scene.normals[vertices])
        # a half turn about the tangent where the back is meant
        axes[:, 1] *= np.sign(np.einsum("vi,vi->v", axes[:, 2], normals))[:, None]
        axes[:, 2] = normals
        return np.ascontiguousarray((local @ axes).astype(np.float32))

    def _matrices(
        self, row: I32, columns: I32, triangles: I64, weights: F64, n_rows: int
    ) -> tuple[Any, ...]:
        """Sum albedo times barycentrics over the rays, in float64, one matrix a channel."""
        met = self.albedo.checked_at(triangles, weights) / len(self.pattern)
        at = (np.repeat(row, 3), columns.ravel())
        shape = (n_rows, self.n_rows)
        return tuple(
            coo_array(((met[:, channel, None] * weights).ravel(), at), shape=shape)
            .tocsr()
            .astype(np.float32)
            for channel in range(self.albedo.n_channels)
        )
