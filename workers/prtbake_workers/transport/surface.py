"""The surface where rays hit it: interpolated points, and the side that a ray meets."""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import B8, F32, F64, I64, Bool, Float32, Float64, Int64
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.mesh import face_area_vectors
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.reference import SurfacePoints

HORIZON = 1e-3
"""Cosine that a view direction is lifted to where a smooth normal leans away from the eye, as the
decoder does: a silhouette is then as bright as its neighbourhood."""

COINCIDENT_OFFSETS = 2.0
"""Surfaces that are this many ray offsets apart, or less, lie in one place."""

HALVES_AXIS = np.array([0.5321, 0.6143, 0.5827], np.float32)
"""Splits triangles by the way they face; perpendicular to no plane that anyone builds on purpose,
or two layers of it could end up in one half."""

OCTANT_BITS = np.array([1, 2, 4], np.uint8)


def interpolate_surface(
    scene: Scene, triangles: Int64[I64, " points"], barycentrics: Float64[F64, "points 3"]
) -> SurfacePoints:
    """Give the points of triangles, with their smooth normals and the side that these shade."""
    corners = scene.faces[triangles]
    weights = barycentrics[:, :, None]
    positions = (scene.positions[corners] * weights).sum(axis=1)
    normals = (scene.normals[corners] * weights).sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    edges = scene.positions[corners[:, 1:]] - scene.positions[corners[:, :1]]
    side = np.cross(edges[:, 0], edges[:, 1])
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
    side *= np.where((side * normals).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    return SurfacePoints(positions, normals, side)


def turn_to_front(
    scene: Scene,
    triangles: Int64[I64, " points"],
    barycentrics: Float32[F32, "points 3"] | Float64[F64, "points 3"],
    front: Bool[B8, " points"],
) -> None:
    """Put the other side's copy in the place of triangles that show a back, where there is one.

    All three arrays are changed.
    """
    if scene.opposite is None:
        return
    turned = np.flatnonzero(~front & (scene.opposite[triangles] >= 0))
    triangles[turned] = scene.opposite[triangles[turned]]
    barycentrics[turned] = barycentrics[turned][:, ::-1]
    front[turned] = True


def above_horizon(
    wo: Float64[F64, "points 3"], normals: Float64[F64, "points 3"]
) -> Float64[F64, "points 3"]:
    """Lift directions whose cosine is below `HORIZON` to it."""
    lift = np.maximum(HORIZON - (wo * normals).sum(axis=1, keepdims=True), 0.0)
    lifted = wo + lift * normals
    return np.asarray(lifted / np.linalg.norm(lifted, axis=1, keepdims=True))


class SurfaceHits(NamedTuple):
    """What rays meet: only those that meet anything, octant by octant.

    ``front`` tells those that come from the side that the surface's normals stand on, whatever its
    winding.
    """

    rays: Int64[I64, " hits"]
    triangles: Int64[I64, " hits"]
    barycentrics: Float64[F64, "hits 3"]
    distance: Float32[F32, " hits"]
    front: Bool[B8, " hits"]


class OpaqueSurface:
    """First hits of rays on a scene whose surfaces may be one-sided.

    Where a front and a back lie in one place, as a light in the plane of a ceiling or a sheet made
    of two layers, a tracer meets either, by rounding.  What is seen is the front: every hit on a
    back is looked up once more among the triangles that face the other way.

    Of a two-sided surface the accelerator holds one copy.  The side that a ray comes from says
    which one it met, so the copies can never be confused.

    Parameters
    ----------
    scene, accelerator
        The triangles of ``scene.traced_faces``.  A robust accelerator keeps rays in closed rooms.

    Attributes
    ----------
    epsilon
        Offset of ray origins: surfaces less than two of them apart lie in one place.
    """

    def __init__(self, scene: Scene, accelerator: Accelerator) -> None:
        self.scene = scene
        self.accelerator = accelerator
        self.epsilon = ray_epsilon(scene.bounds)
        across = face_area_vectors(scene.positions, scene.faces)
        # only directions are read: areas would underflow in float32 on a tiny scene
        length = np.linalg.norm(across, axis=1, keepdims=True)
        across /= np.where(length > 0.0, length, 1.0)
        self._across: F32 = across.astype(np.float32)
        self._leaning: F64 = np.einsum("tj,tcj->tc", across, scene.normals[scene.faces])

    def intersect(
        self, origins: Float32[F32, "rays 3"], directions: Float32[F32, "rays 3"]
    ) -> SurfaceHits:
        """Find what each ray meets first."""
        found = self._hits(self.accelerator, self.scene.traced, origins, directions)
        turn_to_front(self.scene, found.triangles, found.barycentrics, found.front)
        back = np.flatnonzero(~found.front)
        if len(back) == 0:
            return found
        rays, side = found.rays[back], self._turned[found.triangles[back]]
        for half, (accelerator, own) in enumerate(self._halves):
            # the backs of one half, among the triangles of the other
            which = back[side != bool(half)]
            if len(which) == 0 or len(own) == 0:
                continue
            rays = found.rays[which]
            other = self._hits(accelerator, own, origins[rays], directions[rays])
            hit = which[other.rays]
            slope = np.einsum(
                "hj,hj->h", self._across[found.triangles[hit]], directions[found.rays[hit]]
            )
            near = (
                np.abs((other.distance - found.distance[hit]) * slope)
                <= COINCIDENT_OFFSETS * self.epsilon
            )
            keep = near & other.front
            found.triangles[hit[keep]] = other.triangles[keep]
            found.barycentrics[hit[keep]] = other.barycentrics[keep]
            found.front[hit[keep]] = True
        return found

    def _hits(
        self, accelerator: Accelerator, own: I64 | None, origins: F32, directions: F32
    ) -> SurfaceHits:
        # rays of one octant after another walk the same part of the tree: a quarter faster where it
        # outgrows the cache
        order = np.argsort((directions < 0.0) @ OCTANT_BITS, kind="stable")
        hits = accelerator.intersect(origins[order], directions[order])
        hit = np.flatnonzero(hits.triangles >= 0)
        rays = order[hit]
        triangles = hits.triangles[hit].astype(np.int64)
        if own is not None:
            triangles = own[triangles]
        barycentrics = np.maximum(hits.barycentrics[hit].astype(np.float64), 0.0)
        barycentrics /= barycentrics.sum(axis=1, keepdims=True)
        approach = np.einsum("hj,hj->h", self._across[triangles], directions[rays])
        leaning = np.einsum("hc,hc->h", self._leaning[triangles], barycentrics)
        front = np.asarray(np.where(leaning < 0.0, approach > 0.0, approach < 0.0))
        return SurfaceHits(rays, triangles, barycentrics, hits.distance[hit], front)

    @cached_property
    def _turned(self) -> Bool[B8, " tris"]:
        """Which half each triangle is in: two that face each other are never in one."""
        facing = self._across @ HALVES_AXIS
        return np.asarray((facing < 0.0) ^ (self._leaning.sum(axis=1) < 0.0))

    @cached_property
    def _halves(self) -> tuple[tuple[Accelerator, I64], tuple[Accelerator, I64]]:
        """The triangles of each half, ready for rays; built when the first back is met."""
        scene, turned = self.scene, self._turned
        first, second = np.flatnonzero(~turned), np.flatnonzero(turned)
        return (
            (Accelerator(scene.positions, scene.faces[first], robust=True), first),
            (Accelerator(scene.positions, scene.faces[second], robust=True), second),
        )
