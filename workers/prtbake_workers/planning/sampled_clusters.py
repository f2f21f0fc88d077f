"""Vertices of a few clusters of a part, and their transfer as a bake in few directions has it."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.basis.incident import IncidentBasis
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.sampled_transfer import ProbeDirections, SampledTransfer

MOST_CLUSTERS = 16
FEWEST_CLUSTERS = 2
MOST_VERTS, FEWEST_VERTS = 800, 48
"""Of all clusters, and of each: fewer clusters are drawn where these are too many."""

VERTS_PER_RANK = 4
"""Of a cluster at least, unless all it has are fewer.  R columns of n vertices leave 1 - R / n of
what is noise to them: of as many vertices as columns nothing is left, of four times as many 0.2
bits a number less than of all."""

MOST_VALUES = 8_000_000
"""Coefficients of all: 32 MB, and no more than two or three seconds' work."""

PLACE_BITS = 5
"""Of each coordinate of a place along a space-filling curve."""

RESOLUTIONS = (8, 12, 17, 32)
"""Of cube maps with 2.5 directions a function, of up to 153, 345, 693 and 2457 functions."""


@dataclass(frozen=True)
class SampledDirections:
    """Directions of a trial, and what takes samples in them to whitened coefficients."""

    at: ProbeDirections
    matrix: Float32[F32, "dirs coeffs"]

    @classmethod
    def of(cls, basis: IncidentBasis, cube_resolution: int) -> "SampledDirections":
        """Take the coarsest cube map that resolves the basis, and none finer than the bake's."""
        fine = (one for one in RESOLUTIONS if 6 * one**2 >= 2.5 * basis.n)
        at = ProbeDirections.of_cube(min(cube_resolution, next(fine, cube_resolution)), 1)
        projection = basis.projection(at.directions, at.root_weights**2)
        # samples hold the root of their solid angle already
        matrix = projection.matrix / at.root_weights[:, None]
        return cls(at, matrix.astype(np.float32))


def draw_clusters(
    scene: Scene,
    part: int,
    n_clusters: int,
    *,
    rank: int,
    n_values: int,
    rng: np.random.Generator,
) -> tuple[Int64[I64, " verts"], int]:
    """Draw vertices of a part, and say of how many clusters they are.

    A cluster is taken to be the vertices that are nearest to one in place and normal.  Of a part
    that has no more clusters than are drawn, vertices are taken from all over it.  Either are drawn
    evenly along a curve through the part: clusters have as many vertices whatever their area, by
    which whoever compresses them weighs them.

    Parameters
    ----------
    n_clusters
        That the part will be cut into.
    rank
        Weights of a vertex.
    n_values
        Coefficients of a vertex.

    Returns
    -------
    ndarray
        Vertices of the scene.
    int
        Clusters that they are of; 0 where so few vertices as are allowed say nothing.
    """
    start, stop = scene.part_ranges[part]
    usable = np.abs(np.linalg.norm(scene.normals[start:stop], axis=1) - 1.0) < 1e-3
    own = start + np.flatnonzero(usable)
    own = own[np.argsort(_along_a_curve(scene.positions[own]), kind="stable")]
    most = min(MOST_VERTS, max(FEWEST_CLUSTERS * FEWEST_VERTS, MOST_VALUES // n_values))
    members = max(1, len(own) // n_clusters)
    each = min(members, max(FEWEST_VERTS, VERTS_PER_RANK * rank))
    drawn = min(n_clusters, MOST_CLUSTERS, most // each)
    if drawn < min(n_clusters, FEWEST_CLUSTERS):
        return own[:0], 0
    if drawn == n_clusters or not own.size:
        return np.sort(own[_evenly(len(own), most, rng)]), drawn
    places = scene.positions[own] - scene.positions[own].mean(axis=0)
    size = float(np.sqrt(np.mean(np.sum(places**2, axis=1))))
    places = np.concatenate([places / max(size, 1e-30), scene.normals[own]], axis=1)
    looked_at = np.zeros(len(own), bool)
    covered = np.zeros(len(own), bool)
    for middle in _evenly(len(own), drawn, rng):
        distances = np.sum((places - places[middle]) ** 2, axis=1)
        nearest = np.argpartition(distances, members - 1)[:members]
        covered[nearest] = True
        looked_at[rng.choice(nearest, min(members, most // drawn), replace=False)] = True
    # where middles coincide, or clusters overlap, they are fewer
    return np.sort(own[looked_at]), max(1, round(int(covered.sum()) / members))


def _evenly(length: int, count: int, rng: np.random.Generator) -> Int64[I64, " drawn"]:
    """Draw at most ``count`` different places of a list, evenly spread (systematic)."""
    count = min(length, count)
    at = (np.arange(count) + rng.random()) * (length / max(1, count))
    return np.minimum(at.astype(np.int64), length - 1)


def _along_a_curve(positions: Float64[F64, "verts 3"]) -> Int64[I64, " verts"]:
    """Give numbers that near places have near each other (Morton), so that draws spread evenly.

    What compression leaves may lie in a few clusters: those near a contact, of a smooth object.
    """
    low = positions.min(axis=0, initial=np.inf)
    size = max(float((positions - low).max(initial=0.0)), 1e-30)
    cells = ((positions - low) / size * (2**PLACE_BITS - 1)).astype(np.int64)
    code = np.zeros(len(positions), np.int64)
    for bit in range(PLACE_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


def sampled_coefficients(
    scene: Scene,
    verts: Int64[I64, " verts"],
    factorisation: Factorisation,
    accelerator: Accelerator | None,
    directions: SampledDirections,
) -> Float32[F32, "verts terms coeffs"]:
    """Bake vertices: direct light, all terms, one ray a direction."""
    terms = factorisation.n_terms
    sampled = SampledTransfer(
        origins=offset_origins(
            scene.ray_points[verts], scene.ray_sides[verts], ray_epsilon(scene.bounds)
        ),
        frames=scene.frames[verts],
        factorisation=factorisation,
        accelerator=accelerator,
        mixing=np.broadcast_to(np.eye(terms, dtype=np.float32), (len(verts), terms, terms)),
    )
    found = sampled.sample(directions.at) @ directions.matrix
    return np.asarray(found.reshape(len(verts), terms, found.shape[1]), np.float32)
