"""Scenes with a known answer, solved by what bakes and by the path tracer.

All are grey and diffuse.  An answer is the radiance that vertices send under light of radiance 1, over
their own albedo: that is what transfer holds.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.procedural import constant
from prtbake_workers.environment.subdivision import subdivided_texels
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.interreflection import bounce_series
from prtbake_workers.transport.mirrored import product_of
from prtbake_workers.transport.path_material import PathMaterial
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import trace_paths
from support.bounce_scenes import (
    ball,
    ball_lights_plane,
    bowl,
    disc,
    discs_by_quadrature,
    opaque,
    patch,
)

N_RAYS = 256
"""Of a vertex, for the bounces."""

N_PASSES, N_SAMPLES = 8, 128
"""1,024 paths a vertex."""

FINE_RAD = 0.05
"""Largest texel that the light of the baked transfer is integrated in."""

N_TRACED = 40
"""Vertices that paths are traced from."""


@dataclass(frozen=True, eq=False)
class AnalyticScene:
    """A scene, and what some of its vertices send after so many bounces.

    ``albedos`` are those of the parts; ``answers`` has a row for every number of bounces from 0 to
    the one asked for, (bounces + 1, vertices); ``direct`` is the exact direct light of all vertices,
    where that is not the share of rays that escape.
    """

    scene: Scene
    albedos: tuple[float, ...]
    light: Environment
    vertices: Any
    answers: Any
    direct: Any = None

    @property
    def n_bounces(self):
        return len(self.answers) - 1

    @property
    def truth(self):
        return self.answers[-1]

    def without_bounces(self):
        """The same scene by direct light alone."""
        return replace(self, answers=self.answers[:1])

    def with_one_less(self):
        """The same scene solved with a bounce less, and the answer that this misses."""
        return replace(self, answers=np.delete(self.answers, -2, axis=0))


@dataclass(frozen=True)
class Measured:
    """Root mean square error over that of the answer, for each way of solving.

    ``bounces`` sums bounces of scalar direct light, ``baked`` those of transfer in 642 SRBFs, lit
    afterwards; ``expected`` is what the error of the path tracer should be by its own passes.
    """

    bounces: float
    baked: float
    traced: float
    expected: float


def half_sky():
    """Radiance 1 from above the horizon, nothing from below."""
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:32] = 1.0
    return Environment(radiance)


@cache
def sphere(n_bounces=2):
    """A ball under light from all around: its radiance is the light, and nothing bounces."""
    scene = Scene.from_parts([ball(3)])
    vertices = np.arange(scene.n_vertices)
    return AnalyticScene(
        scene, (0.7,), constant(16), vertices, np.ones((n_bounces + 1, len(vertices)))
    )


@cache
def furnace(n_bounces=4):
    """A half-open spherical bowl of albedo 1: half of what each point sees is bowl.

    After B bounces 1 - (1/2)^(B + 1), everywhere; at the rim linear interpolation is at its worst.
    """
    scene = Scene.from_parts([bowl(16, 64)])
    vertices = np.flatnonzero(scene.positions[:, 1] < -0.1)
    sums = 1.0 - 0.5 ** (np.arange(n_bounces + 1) + 1.0)
    return AnalyticScene(
        scene, (1.0,), constant(16), vertices, np.repeat(sums[:, None], len(vertices), axis=1)
    )


@cache
def plates(height, n_bounces=3):
    """Two equal discs of radius 1 that face each other; Gauss quadrature of the ring kernel."""
    scene = Scene.from_parts([disc(1.0, 0.0, 12, 48, up=True), disc(1.0, height, 12, 48, up=False)])
    radius, sums = discs_by_quadrature(height, 0.8, n_bounces)
    at = np.linalg.norm(scene.positions[:, [0, 2]], axis=1)
    vertices = np.flatnonzero(at < 0.92)
    answers = np.array([np.interp(at[vertices], radius, row) for row in sums])
    return AnalyticScene(scene, (0.8, 0.8), constant(16), vertices, answers)


@cache
def ball_on_plane():
    """A ball of radius 1 on a plane under half a sky, seen from the plane, one bounce.

    At the offset r it covers (1 + r^2)^(-3/2) of the sky, cosine-weighted; by direct light it sends
    (1 + n_y) / 2 times its albedo, in closed form, and what of that arrives is a quadrature.
    """
    plane = patch([-4, 0, 4], [8, 0, 0], [0, 0, -8], 16, 16)
    scene = Scene.from_parts([plane, ball(4, (0.0, 1.0, 0.0))])
    (start, stop), (first, last) = scene.part_ranges
    offset = np.linalg.norm(scene.positions[start:stop, [0, 2]], axis=1)
    open_ = 1.0 - (1.0 + offset**2) ** -1.5
    direct = np.concatenate([open_, 0.5 * (1.0 + scene.normals[first:last, 1])])
    # the contact point itself lies under the ball
    vertices = np.flatnonzero((offset > 0.4) & (offset < 4.0))
    distances, where = np.unique(np.round(offset[vertices], 9), return_inverse=True)
    sent = np.array([ball_lights_plane(r, lambda up: 0.5 * (1.0 + up), 200) for r in distances])
    answers = np.array([open_[vertices], open_[vertices] + 0.8 * sent[where]])
    return AnalyticScene(scene, (0.5, 0.8), half_sky(), vertices, answers, direct)


def measure(case):
    """Solve a scene in every way."""
    block = _block(case.scene, case.albedos)
    direct = block.escaped if case.direct is None else case.direct
    bounces = _series(case, block, direct[:, None])[:, 0]
    # the basis sees the light at texel centres: those of a map of 8 rows would be too far apart
    light = _basis()[0].light_from_radiance(*subdivided_texels(case.light, FINE_RAD))
    baked = _series(case, block, _baked(case.scene)) @ light[:, 0]
    some = np.arange(len(case.vertices))[:: max(1, len(case.vertices) // N_TRACED)]
    traced, error = _traced(case, case.vertices[some])
    return Measured(
        relative_error(bounces[case.vertices] - case.truth, case.truth),
        relative_error(baked[case.vertices] - case.truth, case.truth),
        relative_error(traced - case.truth[some], case.truth[some]),
        relative_error(error, case.truth[some]),
    )


def relative_error(wrong, truth):
    """Root mean square of one over that of the other."""
    return float(np.linalg.norm(wrong) / np.linalg.norm(truth))


@cache
def _block(scene, albedos):
    sizes = [stop - start for start, stop in scene.part_ranges]
    albedo = Albedo.of_vertices(scene.faces, np.repeat(albedos, sizes)[:, None])
    return build_bounce_block(
        opaque(scene), (0, scene.n_vertices), albedo=albedo, n_rays=N_RAYS, seed=2
    )


def _series(case, block, direct):
    found = bounce_series(
        direct.astype(np.float32), block.matrices, areas=case.scene.areas,
        tolerance=0.0, max_bounces=case.n_bounces,
    )  # fmt: skip
    return found.transfer[0].astype(np.float64)


@cache
def _basis():
    """642 SRBFs, and their projection in 6,144 directions."""
    basis, directions = SrbfBasis(icosphere(3)), cube_directions(32)
    return basis, basis.projection(directions.directions, directions.weights), directions


@cache
def _baked(scene):
    """Direct transfer of all vertices, whitened."""
    _, projection, directions = _basis()
    diffuse = factorise(Lambert(np.ones(1)))
    product = product_of(projection, directions.directions)
    accelerator = Accelerator(scene.positions, scene.faces)
    return np.concatenate(
        [
            bake_block(
                scene, accelerator, of_part,
                factorisation=diffuse, projection=projection, directions=directions,
                product=product,
            ).coefficients[:, 0]
            for of_part in scene.part_ranges
        ]
    )  # fmt: skip


def _traced(case, vertices):
    """Radiance over the albedo, and its standard error."""
    scene = case.scene
    found = trace_paths(
        opaque(scene), [PathMaterial(Lambert(np.array([albedo]))) for albedo in case.albedos],
        PathPoints.of_vertices(scene, vertices, scene.normals[vertices]), case.light, np.eye(3),
        n_bounces=case.n_bounces, n_passes=N_PASSES, n_samples=N_SAMPLES, seed=4,
    )  # fmt: skip
    own = np.array(case.albedos)[_part_of(scene, vertices)]
    return found.mean[:, 0] / own, np.sqrt(found.variance[:, 0]) / own


def _part_of(scene, vertices):
    return np.searchsorted([stop for _, stop in scene.part_ranges], vertices, side="right")
