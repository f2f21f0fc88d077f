"""The indirect light of the chain's reference: paths from the pixels' own points."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from prtbake_storage.contract.settings import ValidateSettings
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import PathMaterial, trace_paths
from prtbake_workers.transport.surface import OpaqueSurface
from prtbake_workers.validation.hits import PixelHits
from prtbake_workers.validation.scene import ValidationScene
from prtbake_workers.validation.shading import part_texture

ROULETTE_FROM = 3
"""Bounce from which paths end at random: what comes later is a few per cent of the light."""

SEED_OFFSET = 1_000_000
"""Beyond all cameras and rotations: numpy pads seeds with zeros, so that the first pass of the
paths would draw the direct light's own random numbers."""


class PathLight:
    """Traces paths from the pixels of one camera, by the true BRDFs and albedo textures.

    Surfaces have one side, as in the bake.
    """

    def __init__(self, validation: ValidationScene, hits: PixelHits) -> None:
        self._environment = validation.environment
        scene = validation.scene
        # isotropic BRDFs look alike in any frames, but paths drawn in others would be others
        upright = replace(scene, frames=tangent_frames(scene.normals))
        self._surface = OpaqueSurface(upright, validation.accelerator)
        self._materials = [
            PathMaterial(part.brdf, part_texture(validation, index))
            for index, part in enumerate(validation.parts)
        ]
        self._points = PathPoints(
            hits.points, hits.frames, hits.wo, hits.triangles, hits.barycentrics.astype(np.float64)
        )

    def indirect(
        self,
        rotation: Float64[F64, "3 3"],
        n_bounces: int,
        settings: ValidateSettings,
        seed: int,
        advance: Callable[[], None],
    ) -> Float64[F64, "passes hits 3"]:
        """Estimate the light of 1 to ``n_bounces`` bounces; ``advance`` is called a pass."""
        estimate = trace_paths(
            self._surface,
            self._materials,
            self._points,
            self._environment,
            rotation,
            n_bounces=n_bounces,
            n_passes=settings.passes,
            n_samples=settings.paths,
            seed=seed + SEED_OFFSET,
            roulette_from=ROULETTE_FROM,
            indirect_only=True,
            progress=lambda _: advance(),
        )
        return estimate.indirect
