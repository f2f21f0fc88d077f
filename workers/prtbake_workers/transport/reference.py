"""Brute-force direct lighting, the reference every asset is held against.

At a surface point p with shading normal n the reflected radiance is

    B(p, wo) = integral L(wi) rho(wi, wo) V(p, wi) max(0, n . wi) dwi     [Tsai2006] eq. (8)

estimated with light samples drawn from the environment by importance.  One pass shares its
samples among all points: the pictures of an error budget then differ by what they are meant to
differ by, not by their noise.  Independent passes give the variance of the mean.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import offset_origins

RAYS_PER_BLOCK = 400_000
"""Points x samples traced at once: 0.2 GB of rays, frames and BRDF values."""

VALUES_PER_BLOCK = 6_400_000
"""Points x samples x terms at once: an array of them takes 51 MB, and five live at a time."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points to be lit, with the normal that shades and the side that rays leave from."""

    positions: Float64[F64, "points 3"]
    normals: Float64[F64, "points 3"]
    side: Float64[F64, "points 3"]
    """Unit vectors along which shadow rays leave the surface: at a pixel the geometric normal,
    turned to the shading normal's side, at a vertex its `Scene.ray_sides`."""

    def __len__(self) -> int:
        return len(self.positions)

    def block(self, which: slice | I64) -> "SurfacePoints":
        """Return some of the points."""
        return SurfacePoints(self.positions[which], self.normals[which], self.side[which])


@dataclass(frozen=True)
class LightPass:
    """Samples of the light shared by all points: ``weights`` = L / (pdf n), linear RGB."""

    directions: Float64[F64, "samples 3"]
    weights: Float64[F64, "samples 3"]


def blocks(n_points: int, n_samples: int, n_terms: int = 1) -> Iterator[slice]:
    """Cut points into blocks of bounded memory, each of one point at least."""
    rays = min(RAYS_PER_BLOCK, VALUES_PER_BLOCK // n_terms)
    size = max(1, rays // max(1, n_samples))
    for start in range(0, n_points, size):
        yield slice(start, min(start + size, n_points))


def visible_cosine(
    points: SurfacePoints,
    directions: Float64[F64, "samples 3"],
    accelerator: Accelerator | None,
    epsilon: float,
) -> Float64[F64, "points samples"]:
    """Return V(p, w) max(0, n . w) for every point and direction; no accelerator means V = 1."""
    cosine = np.maximum(points.normals @ directions.T, 0.0)
    if accelerator is None:
        return cosine
    point, sample = np.nonzero(cosine > 0.0)
    if point.size == 0:
        return cosine
    origins = offset_origins(points.positions, points.side, epsilon)
    rays: Float32[F32, "samples 3"] = directions.astype(np.float32)
    blocked = accelerator.occluded(
        np.ascontiguousarray(origins[point]), np.ascontiguousarray(rays[sample])
    )
    cosine[point[blocked], sample[blocked]] = 0.0
    return cosine


def to_local(
    frames: Float64[F64, "points 3 3"], directions: Float64[F64, "samples 3"]
) -> Float64[F64, "points samples 3"]:
    """Express shared world directions in every point's own frame."""
    return np.asarray(np.einsum("pij,sj->psi", frames, directions, optimize=True))
