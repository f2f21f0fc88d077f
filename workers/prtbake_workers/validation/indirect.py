"""Light of the chain's reference by paths from the pixels' own points: of bounces and of media."""

from collections.abc import Callable

import numpy as np

from prtbake_storage.contract.settings import MEDIUM_PATHS, ValidateSettings
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, I64, Float64
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.dipole_sampling import DipoleSampler
from prtbake_workers.transport.path_material import PathMaterial
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import trace_paths
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
    """Traces paths from the pixels of one camera, by the true BRDFs, textures and colours.

    Surfaces have the sides that they have in the bake.

    Attributes
    ----------
    whole
        Pixels that show a part which scatters light inside: theirs is all of the light, since the
        chain's other pictures reflect light where it falls.
    n_traces
        Of every pass: one for whole light, one for indirect.
    """

    def __init__(self, validation: ValidationScene, hits: PixelHits, n_bounces: int) -> None:
        self._environment = validation.environment
        self._n_bounces = n_bounces
        scene = validation.shading_scene
        self._surface = OpaqueSurface(scene, validation.accelerator)
        self._materials = [
            _material(validation, index, scene) for index in range(len(validation.parts))
        ]
        self._points = PathPoints(
            hits.points, hits.frames, hits.wo, hits.triangles, hits.barycentrics.astype(np.float64)
        )
        media = [index for index, part in enumerate(validation.parts) if part.medium is not None]
        self.whole = np.isin(hits.parts, media)
        self.n_traces = int(self.whole.any()) + int(n_bounces > 0)

    def add(
        self,
        pictures: list[Float64[F64, "_ hits 3"]],
        rotation: Float64[F64, "3 3"],
        settings: ValidateSettings,
        seed: int,
        advance: Callable[[], None],
    ) -> list[Float64[F64, "passes hits 3"]]:
        """Add the light of 1 to B bounces to pictures of direct light, pass by pass.

        Pixels that show a medium get all of theirs, in place of what they held.  ``advance`` is
        called once a pass and trace.
        """
        light = np.zeros((settings.passes, len(self.whole), 3))
        kinds = [True] * bool(self.whole.any()) + [False] * bool(self._n_bounces)
        for whole in kinds:
            which = np.flatnonzero(self.whole == whole)
            estimate = trace_paths(
                self._surface,
                self._materials,
                self._points.pick(which),
                self._environment,
                rotation,
                n_bounces=self._n_bounces,
                n_passes=settings.passes,
                n_samples=settings.paths * (MEDIUM_PATHS if whole else 1),
                seed=seed + SEED_OFFSET,
                roulette_from=ROULETTE_FROM,
                indirect_only=not whole,
                progress=lambda _: advance(),
            )
            light[:, which] = estimate.passes if whole else estimate.indirect
        lit = ~self.whole[:, None]
        return [picture * lit + light for picture in pictures]


def _material(validation: ValidationScene, index: int, scene: Scene) -> PathMaterial:
    part, texture = validation.parts[index], part_texture(validation, index)
    if part.medium is None:
        return PathMaterial(part.brdf, texture)
    if not isinstance(part.brdf, Lambert):
        raise SettingsError(f"part {index} has a medium, whose BRDF is Lambert")
    albedo = np.broadcast_to(part.brdf.albedo, 3)

    def tint(triangles: I64, barycentrics: F64) -> F64:
        whole = np.tile(albedo, (len(triangles), 1))
        return whole if texture is None else whole * texture(triangles, barycentrics)

    return PathMaterial(
        Lambert(np.ones(1)), tint, scattering=DipoleSampler(scene, index, part.medium)
    )
