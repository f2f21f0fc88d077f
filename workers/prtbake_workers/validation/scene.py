"""What a validation holds against each other: the true scene and the steps towards its asset."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from prtbake_storage.decode.asset import Asset
from prtbake_storage.decode.light import Light
from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.basis.incident import IncidentBasis
from prtbake_workers.brdf.base import Brdf, is_isotropic
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.environment.environment import Environment
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.directions import CubeDirections


@dataclass(frozen=True)
class ValidationPart:
    """One part: its true BRDF, its separable form, and what its bake simulated."""

    brdf: Brdf
    factorisation: Factorisation
    view_texture: Float32[F32, "res res terms channels"] | None
    """Of the terms themselves, before U_view; None where phi is constant."""
    occluders: Accelerator | None
    """The triangles that the bake let block its light; None where it traced no ray."""
    medium: Dipole | None = None
    """What scatters inside."""
    scattered: bool = False
    """Whether the stored transfer holds that."""


@dataclass(frozen=True)
class ValidationScene:
    """Everything between the reference and the asset.

    ``relight_stored(part, vertices, light)`` contracts the stored whitened coefficients of
    vertices, in scene numbering, with columns of whitened light.  ``exact`` is the asset before
    its factors were quantised, None where that is not at hand: then compression and quantisation
    share a line of the budget.
    """

    scene: Scene
    accelerator: Accelerator
    parts: tuple[ValidationPart, ...]
    basis: IncidentBasis
    directions: CubeDirections
    supersample: int
    relight_stored: Callable[
        [int, Int64[I64, " verts"], Float64[F64, "coeffs columns"]],
        Float64[F64, "verts terms columns"],
    ]
    exact: Asset | None
    delivered: Asset
    environment: Environment
    light: Light
    baked_bounces: bool
    """Whether the stored transfer holds bounces."""

    @cached_property
    def shading_scene(self) -> Scene:
        """The scene in the frames that the true BRDFs are read in.

        Those of the normals alone where a BRDF is isotropic: it looks alike in any, but paths drawn
        in others would be others.
        """
        frames = tangent_frames(self.scene.normals)
        for part, (start, stop) in zip(self.parts, self.scene.part_ranges, strict=True):
            if not is_isotropic(part.brdf):
                frames[start:stop] = self.scene.frames[start:stop]
        return replace(self.scene, frames=frames)

    @property
    def finest(self) -> Asset:
        """The asset with the surfaces least rounded: the exact one where it is at hand."""
        return self.delivered if self.exact is None else self.exact

    def part_of_triangle(self, triangles: Int64[I64, " n"]) -> Int64[I64, " n"]:
        """Return the part that each triangle belongs to."""
        first = self.scene.faces[triangles, 0]
        starts = np.array([start for start, _ in self.scene.part_ranges])
        return np.asarray(np.searchsorted(starts, first, side="right") - 1, dtype=np.int64)
