"""The brute-force reference with interreflection: a path tracer over numpy and Embree.

From a surface point paths go on for exactly B bounces.  At every vertex of a path the environment
is sampled twice, by its own importance and along the direction in which the path goes on, and the
two are weighted by the balance heuristic [Veach1995]_; with f = rho cos, p the density
of the environment's samples and q that of directions,

    f L / (p + q)   for the one, where it is visible, and for the other, where it escapes.

Where a part scatters light inside, a path that reaches it goes on from where the light entered
(`dipole_sampling`), as from a Lambert surface of albedo 1.

Light goes where it goes in the bake: surfaces are opaque, the back of a one-sided one is black, and
rays start at p + epsilon n_g.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import B8, F32, F64, I64, Bool, Float32, Float64
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.sampling import EnvironmentSampler
from prtbake_workers.geometry.ray_offset import offset_origins
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.path_material import PathMaterial
from prtbake_workers.transport.path_numbers import PathNumbers
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.reference import blocks
from prtbake_workers.transport.surface import OpaqueSurface

LEAST_SURVIVAL = 0.05
"""Of a path in the roulette, so that no weight grows beyond 20."""


@dataclass(frozen=True)
class PathEstimate:
    """Radiance towards wo.

    Attributes
    ----------
    passes
        Of each independent pass.
    indirect
        The part of each pass that came by one bounce or more.
    by_bounce
        Mean over the passes of the light that came by each number of bounces.
    n_rays
        Rays traced.
    """

    passes: Float64[F64, "passes points 3"]
    indirect: Float64[F64, "passes points 3"]
    by_bounce: Float64[F64, "bounces points 3"]
    n_rays: int

    @property
    def mean(self) -> Float64[F64, "points 3"]:
        """The estimate."""
        return np.asarray(self.passes.mean(axis=0))

    @property
    def variance(self) -> Float64[F64, "points 3"]:
        """Of the mean, estimated from the passes; they must be at least two."""
        if len(self.passes) < 2:
            raise SettingsError("one pass has no variance: ask for two or more")
        return np.asarray(self.passes.var(axis=0, ddof=1) / len(self.passes))


def trace_paths(
    surface: OpaqueSurface,
    materials: Sequence[PathMaterial],
    points: PathPoints,
    environment: Environment,
    rotation: Float64[F64, "3 3"],
    *,
    n_bounces: int,
    n_passes: int,
    n_samples: int,
    seed: int,
    roulette_from: int | None = None,
    indirect_only: bool = False,
    progress: Callable[[float], None] | None = None,
) -> PathEstimate:
    """Estimate the radiance that points reflect, by paths of up to ``n_bounces`` bounces.

    Parameters
    ----------
    surface
        All parts.
    materials
        One a part.
    points
        Where the paths begin; those on a back side must have been turned.
    environment, rotation
        The light L'(d) = L(R^T d).
    n_bounces
        B: 0 is direct light alone, and has the expectation of the direct reference.
    n_passes, n_samples
        Independent passes, and paths a point in each; those of one pass are stratified.
    seed
        The same seed gives the same numbers on one platform.
    roulette_from
        From this bounce on paths end at random, with their weight kept in expectation.  None, the
        default, ends none.
    indirect_only
        Leave direct light out of the estimate, and the rays towards it at the points untraced.  The
        indirect light is the same, number by number.
    progress
        Called with the fraction done.

    Returns
    -------
    PathEstimate
        Memory: ``passes`` and some 100 MB for the paths under way.

    Raises
    ------
    SettingsError
        Counts out of range, or not one material a part.
    """
    _check(surface.scene, materials, n_bounces, n_passes, n_samples)
    tracer = _PathTracer(surface, materials, environment, rotation, roulette_from, indirect_only)
    indirect = np.zeros((n_passes, len(points), 3))
    passes = np.zeros_like(indirect)
    by_bounce = np.zeros((n_bounces + 1, len(points), 3))
    for index in range(n_passes):
        numbers = [PathNumbers([seed, index, depth], len(points), n_samples)
                   for depth in range(n_bounces + 1)]  # fmt: skip
        inside = [PathNumbers([seed, index, depth, 1], len(points), n_samples)
                  for depth in range(n_bounces + 1) if tracer.scatters]  # fmt: skip
        for block in blocks(len(points), n_samples):
            found = tracer.trace(points, block, numbers, inside, n_samples)
            indirect[index, block] = found[1:].sum(axis=0)
            passes[index, block] = found[0] + indirect[index, block]
            by_bounce[:, block] += found / n_passes
        if progress is not None:
            progress((index + 1) / n_passes)
    return PathEstimate(passes, indirect, by_bounce, tracer.n_rays)


class _PathTracer:
    def __init__(
        self,
        surface: OpaqueSurface,
        materials: Sequence[PathMaterial],
        environment: Environment,
        rotation: Float64[F64, "3 3"],
        roulette_from: int | None,
        indirect_only: bool,
    ) -> None:
        self.surface = surface
        self.scene = surface.scene
        self.materials = materials
        self.environment = environment
        self.sampler = EnvironmentSampler(environment)
        self.rotation = rotation
        self.roulette_from = roulette_from
        self.first_lit = 1 if indirect_only else 0
        self.two_sided = np.array([material.two_sided for material in materials])
        self.scatters = any(material.scattering is not None for material in materials)
        self.n_rays = 0

    def trace(
        self,
        points: PathPoints,
        block: slice,
        numbers: list[PathNumbers],
        inside: list[PathNumbers],
        n_samples: int,
    ) -> Float64[F64, "bounces points 3"]:
        """Follow the paths of a block of points, all of them one bounce at a time."""
        n_points = block.stop - block.start
        point = np.repeat(np.arange(block.start, block.stop), n_samples)
        sample = np.tile(np.arange(n_samples), n_points)
        at, throughput = points.pick(point), np.full((len(point), 3), 1.0 / n_samples)
        result = np.zeros((len(numbers), n_points, 3))
        for depth, own in enumerate(numbers):
            if inside:
                at = self._enter(at, throughput, inside[depth].of(point, sample))
                lit = np.flatnonzero(throughput.any(axis=1))
                at, throughput = at.pick(lit), throughput[lit]
                point, sample = point[lit], sample[lit]
            u = own.of(point, sample)
            wo = np.einsum("pij,pj->pi", at.frames, at.wo)
            texture = self._texture(at)
            wi, weight, density = self._go_on(at, wo, texture, u)
            weight *= throughput
            last = depth == len(numbers) - 1
            escaped, hit, (triangles, barycentrics) = self._follow(at, wi, weight, last)
            if depth >= self.first_lit:
                light = throughput * self._sampled_light(at, wo, texture, u)
                light[escaped] += weight[escaped] * self._escaped_light(
                    wi[escaped], density[escaped]
                )
                for channel in range(3):
                    result[depth, :, channel] = np.bincount(
                        point - block.start, light[:, channel], n_points
                    )
            if last or len(hit) == 0:
                break
            throughput = weight[hit]
            at, faces_ray = PathPoints.seen(
                self.scene, triangles, barycentrics, -wi[hit],
                self.two_sided[self.scene.part_of_face[triangles]],
            )  # fmt: skip
            alive = faces_ray & self._survives(throughput, u[hit, 5], depth, n_samples)
            at, throughput = at.pick(alive), throughput[alive]
            point, sample = point[hit[alive]], sample[hit[alive]]
        return result

    def _enter(self, at: PathPoints, throughput: F64, u: F64) -> PathPoints:
        """Move the points of scattering parts to where their light entered; scales in place."""
        part = self.scene.part_of_face[at.triangles]
        for index, material in enumerate(self.materials):
            own = np.flatnonzero(part == index)
            if material.scattering is None or len(own) == 0:
                continue
            here = at.pick(own)
            if material.texture is not None:
                throughput[own] *= material.texture(here.triangles, here.barycentrics)
            entered, weights = material.scattering.enter(here, u[own, :5])
            throughput[own] *= weights
            at = at.replaced(own, entered)
        return at

    def _sampled_light(
        self, at: PathPoints, wo: F64, texture: F64, u: F64
    ) -> Float64[F64, "paths 3"]:
        """Sample the environment by its own importance: f L / (p + q) where it is visible."""
        samples = self.sampler.place(u[:, 0], u[:, 1])
        directions = samples.directions @ self.rotation.T
        wi = np.einsum("pij,pj->pi", at.frames, directions)
        value, density = self._reflect(at, wi, wo)
        light = value * texture * samples.radiance / (samples.pdf + density)[:, None]
        open_ = np.flatnonzero(light.any(axis=1))
        blocked = self.surface.accelerator.occluded(
            self._origins(at, open_), directions[open_].astype(np.float32)
        )
        self.n_rays += len(open_)
        light[open_[blocked]] = 0.0
        return light

    def _go_on(
        self, at: PathPoints, wo: F64, texture: F64, u: F64
    ) -> tuple[Float64[F64, "paths 3"], Float64[F64, "paths 3"], Float64[F64, " paths"]]:
        """Draw world directions, with f / q and q; a weight of 0 where nothing is reflected."""
        local = np.zeros_like(wo)
        part = self.scene.part_of_face[at.triangles]
        for index, material in enumerate(self.materials):
            own = np.flatnonzero(part == index)
            local[own] = material.proposal.sample(wo[own], u[own, 2], u[own, 3:5])
        value, density = self._reflect(at, local, wo)
        weight = value * texture / np.where(density > 0.0, density, 1.0)[:, None]
        return np.einsum("pij,pi->pj", at.frames, local), weight, density

    def _follow(
        self, at: PathPoints, wi: F64, weight: F64, last: bool
    ) -> tuple[I64, I64, tuple[I64, F64]]:
        """Trace the paths that carry anything: which escape, which hit, and where they do."""
        carrying = np.flatnonzero(weight.any(axis=1))
        origins, directions = self._origins(at, carrying), wi[carrying].astype(np.float32)
        self.n_rays += len(carrying)
        if last:
            blocked = self.surface.accelerator.occluded(origins, directions)
            nowhere = np.zeros(0, np.int64)
            return carrying[~blocked], nowhere, (nowhere, np.zeros((0, 3)))
        hits = self.surface.intersect(origins, directions)
        escaped = np.ones(len(carrying), np.bool_)
        escaped[hits.rays] = False
        return carrying[escaped], carrying[hits.rays], (hits.triangles, hits.barycentrics)

    def _escaped_light(self, wi: F64, density: F64) -> Float64[F64, "paths 3"]:
        """L q / (p + q), the factor of f / q on a path that leaves the scene."""
        own = wi @ self.rotation
        share = density / (self.sampler.pdf(own) + density)
        return self.environment.lookup(own) * share[:, None]

    def _reflect(
        self, at: PathPoints, wi: F64, wo: F64
    ) -> tuple[Float64[F64, "paths 3"], Float64[F64, " paths"]]:
        """Evaluate rho cos and q for local directions, part by part."""
        value, density = np.zeros_like(wi), np.zeros(len(wi))
        part = self.scene.part_of_face[at.triangles]
        for index, material in enumerate(self.materials):
            own = np.flatnonzero((part == index) & (wi[:, 2] > 0.0))
            if len(own):
                value[own] = material.brdf.eval_brdf(wi[own], wo[own]) * wi[own, 2:]
                density[own] = material.proposal.pdf(wi[own], wo[own])
        return value, density

    def _texture(self, at: PathPoints) -> Float64[F64, "paths 3"]:
        scale = np.ones((len(at), 3))
        part = self.scene.part_of_face[at.triangles]
        for index, material in enumerate(self.materials):
            if material.texture is not None and material.scattering is None:
                own = np.flatnonzero(part == index)
                scale[own] = material.texture(at.triangles[own], at.barycentrics[own])
        return scale

    def _survives(
        self, throughput: Float64[F64, "paths 3"], u: F64, depth: int, n_samples: int
    ) -> Bool[B8, " paths"]:
        """Play the roulette; the weight of the survivors grows in place."""
        if self.roulette_from is None or depth + 1 < self.roulette_from:
            return np.ones(len(u), np.bool_)
        chance = np.clip(n_samples * throughput.max(axis=1), LEAST_SURVIVAL, 1.0)
        throughput /= chance[:, None]
        return np.asarray(u < chance)

    def _origins(self, at: PathPoints, which: I64) -> Float32[F32, "rays 3"]:
        points = at.surface
        return offset_origins(points.positions[which], points.side[which], self.surface.epsilon)


def _check(
    scene: Scene,
    materials: Sequence[PathMaterial],
    n_bounces: int,
    n_passes: int,
    n_samples: int,
) -> None:
    if len(materials) != len(scene.part_ranges):
        raise SettingsError(
            f"the scene has {len(scene.part_ranges)} parts, but {len(materials)} materials"
        )
    if n_bounces < 0:
        raise SettingsError(f"n_bounces must not be negative, got {n_bounces}")
    if min(n_passes, n_samples) < 1:
        raise SettingsError(
            f"passes and samples must be at least 1, got {n_passes} and {n_samples}"
        )
