"""Direct transfer of a few vertices of a part, sampled as a bake would sample it."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.probe import draw_by_area
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.held_out import random_turn
from prtbake_workers.transport.left_side import (
    Sampling,
    Workspace,
    local_directions,
    visible_share,
    weighted_transport,
)
from prtbake_workers.transport.visibility import padded_directions

MIXTURES = 4
"""Random sums that stand for the terms of a vertex.  On average they have the terms' energies;
what they have by chance evens out over the vertices."""

VALUES_PER_BLOCK = 6_000_000
"""Vertices x directions x terms at once: 24 MB."""


@dataclass(frozen=True, eq=False)
class ProbeDirections:
    """Where transfer is sampled.

    Attributes
    ----------
    directions
        Unit vectors in world space.
    root_weights
        Square roots of their solid angles.
    rays
        Directions of the shadow rays, one set a supersample.
    """

    directions: Float64[F64, "dirs 3"]
    root_weights: Float64[F64, " dirs"]
    rays: Float32[F32, "samples dirs 3"]

    @classmethod
    def of_cube(cls, resolution: int, supersample: int) -> "ProbeDirections":
        """Take those of a bake."""
        cube = cube_directions(resolution)
        return cls(cube.directions, np.sqrt(cube.weights), cube.sub_directions(supersample))

    @classmethod
    def held_out(cls, resolution: int, rng: np.random.Generator) -> "ProbeDirections":
        """Turn a cube map at random: directions that no bake has, a ray each."""
        cube = cube_directions(resolution)
        turned = cube.directions @ random_turn(rng)
        return cls(turned, np.sqrt(cube.weights), turned.astype(np.float32)[None])

    @property
    def n(self) -> int:
        """Number of directions."""
        return len(self.directions)


@dataclass(frozen=True, eq=False)
class SampledTransfer:
    """The vertices of a part that are looked at, and all that their transfer depends on.

    Attributes
    ----------
    origins, frames
        Where shadow rays start, and the vertices' frames.
    factorisation, accelerator
        Of the part, as given to `bake_block`.
    mixing
        Takes the terms of each vertex to `MIXTURES` functions, or to as many as there are terms.
    """

    origins: Float32[F32, "verts 3"]
    frames: Float64[F64, "verts 3 3"]
    factorisation: Factorisation
    accelerator: Accelerator | None
    mixing: Float32[F32, "verts functions terms"]

    @classmethod
    def of(
        cls,
        scene: Scene,
        part: int,
        factorisation: Factorisation,
        accelerator: Accelerator | None,
        *,
        count: int,
        rng: np.random.Generator,
    ) -> "SampledTransfer":
        """Draw at most ``count`` vertices of a part by area, less those without a normal."""
        start, stop = scene.part_ranges[part]
        chosen = start + draw_by_area(scene.areas[start:stop], min(count, stop - start), rng)
        chosen = chosen[np.abs(np.linalg.norm(scene.normals[chosen], axis=1) - 1.0) < 1e-3]
        terms = factorisation.n_terms
        if terms <= MIXTURES:
            mixing = np.tile(np.eye(terms), (len(chosen), 1, 1))
        else:
            mixing = rng.choice([-1.0, 1.0], (len(chosen), MIXTURES, terms)) / np.sqrt(MIXTURES)
        return cls(
            origins=offset_origins(
                scene.ray_points[chosen], scene.ray_sides[chosen], ray_epsilon(scene.bounds)
            ),
            frames=scene.frames[chosen],
            factorisation=factorisation,
            accelerator=accelerator,
            mixing=mixing.astype(np.float32),
        )

    @property
    def n_vertices(self) -> int:
        """Number of vertices, of which some may be the same."""
        return len(self.mixing)

    @property
    def n_functions(self) -> int:
        """Number of functions, of all vertices."""
        return self.n_vertices * int(self.mixing.shape[1])

    def sample(self, at: ProbeDirections) -> Float32[F32, "functions dirs"]:
        """Sample ``sqrt(W) T(w)``, [Tsai2006]_ eq. (9), by the same steps as `bake_block`.

        Returns
        -------
        ndarray
            Of the first vertex all functions, then of the next.
        """
        sampling = Sampling(
            samples=padded_directions(at.rays),
            centres=np.ascontiguousarray(at.directions.T, dtype=np.float32),
            root_weights=at.root_weights.astype(np.float32),
        )
        work = Workspace()
        found = np.empty((*self.mixing.shape[:2], at.n), np.float32)
        step = max(1, VALUES_PER_BLOCK // (at.n * self.factorisation.n_terms))
        for start in range(0, self.n_vertices, step):
            some = slice(start, start + step)
            frames = self.frames[some]
            local = local_directions(frames, sampling, work)
            share, _ = visible_share(
                self.accelerator,
                self.origins[some],
                frames[:, 2].astype(np.float32),
                local[2],
                sampling,
                work,
            )
            terms, _ = weighted_transport(self.factorisation, local, share, sampling, work)
            np.matmul(self.mixing[some], terms.transpose(1, 0, 2), out=found[some])
        return found.reshape(-1, at.n)
