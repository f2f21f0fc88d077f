"""What surfaces reflect of the light that falls on them, at any point that a ray hits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from prtbake_storage.decode.texture import lookup_repeating
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I32, I64, Float32, Float64, Int32, Int64
from prtbake_workers.geometry.scene import Scene

AlbedoAt = Callable[[Int64[I64, " hits"], Float64[F64, "hits 3"]], Float64[F64, "hits channels"]]
"""Triangles and barycentrics to linear albedo, e.g. a texture looked up through the UVs."""

ROUNDING = 1e-6
"""How far above its stated maximum an albedo may lie: textures hold float32."""


@dataclass(frozen=True, eq=False)
class Albedo:
    """Diffuse albedo over a surface.

    Attributes
    ----------
    at
        Gives the albedo where rays hit.
    maximum
        What ``at`` never exceeds, a channel each, in [0, 1]; its length, 1 or 3, is the number of
        channels.

    Raises
    ------
    SettingsError
        A maximum outside [0, 1], or neither one nor three channels.
    """

    at: AlbedoAt
    maximum: Float64[F64, " channels"]

    def __post_init__(self) -> None:
        if len(self.maximum) not in (1, 3):
            raise SettingsError(f"albedo has one channel or three, not {len(self.maximum)}")
        if not ((self.maximum >= 0.0) & (self.maximum <= 1.0)).all():
            raise SettingsError(f"albedo lies in [0, 1], not {self.maximum.tolist()}")

    @classmethod
    def constant(cls, *values: float) -> "Albedo":
        """Make one albedo for everything: one value, or three."""
        row = np.array(values)
        return cls(lambda triangles, _: np.broadcast_to(row, (len(triangles), len(row))), row)

    @classmethod
    def of_vertices(
        cls, faces: Int32[I32, "tris 3"], values: Float64[F64, "verts channels"]
    ) -> "Albedo":
        """Interpolate vertex values; three channels that are everywhere equal become one."""
        if not np.isfinite(values).all():
            vertex = int(np.argwhere(~np.isfinite(values))[0, 0])
            raise SettingsError(f"the albedo of vertex {vertex} is not finite")
        if (values < 0.0).any():
            vertex = int(np.argwhere(values < 0.0)[0, 0])
            raise SettingsError(f"the albedo of vertex {vertex} is negative")
        grey = values[:, :1] if (values == values[:, :1]).all() else values

        def at(triangles: I64, barycentrics: F64) -> F64:
            return np.asarray(np.einsum("hc,hck->hk", barycentrics, grey[faces[triangles]]))

        return cls(at, grey.max(axis=0, initial=0.0))

    @classmethod
    def of_parts(
        cls,
        scene: Scene,
        values: Sequence[Float64[F64, " _"]],
        textures: Sequence[Float32[F32, "_ _ 3"] | None],
        colours: Sequence[Float32[F32, "_ 3"] | None] | None = None,
    ) -> "Albedo":
        """Give every part an albedo and what multiplies it: a texture, vertex colours, or both.

        Textures are read at the scene's texture coordinates and ``colours`` (part_verts, 3) are
        interpolated, as the decoder does; None stands for no part with any.  Three channels that
        are everywhere equal become one.
        """
        colours = [None] * len(values) if colours is None else colours
        rows = np.stack([np.broadcast_to(np.asarray(value, np.float64), 3) for value in values])
        maximum = np.stack(
            [
                row * _largest(texture) * _largest(tints)
                for row, texture, tints in zip(rows, textures, colours, strict=True)
            ]
        ).max(axis=0, initial=0.0)
        grey = all(
            array is None or bool((array == array[..., :1]).all())
            for array in (rows, *textures, *colours)
        )
        n_channels = 1 if grey else 3

        def at(triangles: I64, barycentrics: F64) -> F64:
            parts = scene.part_of_face[triangles]
            albedo = rows[parts]
            for part, (texture, tints) in enumerate(zip(textures, colours, strict=True)):
                own = np.flatnonzero(parts == part)
                if not len(own):
                    continue
                corners = scene.faces[triangles[own]]
                if texture is not None and scene.uv is not None:
                    uv = np.einsum("hc,hci->hi", barycentrics[own], scene.uv[corners])
                    albedo[own] *= lookup_repeating(texture, uv)
                if tints is not None:
                    local = corners - scene.part_ranges[part][0]
                    albedo[own] *= np.einsum("hc,hck->hk", barycentrics[own], tints[local])
            return albedo[:, :n_channels]

        return cls(at, maximum[:n_channels])

    def greyed(self) -> "Albedo":
        """Replace three channels by their mean."""
        if self.n_channels == 1:
            return self
        return Albedo(
            lambda triangles, weights: self.at(triangles, weights).mean(axis=1, keepdims=True),
            self.maximum.max(keepdims=True),
        )

    @property
    def n_channels(self) -> int:
        """1 where everything is grey, else 3."""
        return len(self.maximum)

    @property
    def is_black(self) -> bool:
        """Whether nothing is reflected."""
        return not self.maximum.any()

    def checked_at(
        self, triangles: Int64[I64, " hits"], barycentrics: Float64[F64, "hits 3"]
    ) -> Float64[F64, "hits channels"]:
        """Call ``at`` and refuse what lies outside [0, maximum]; names the triangle."""
        values = self.at(triangles, barycentrics)
        wrong = ~((values >= 0.0) & (values <= self.maximum + ROUNDING)).all(axis=1)
        if wrong.any():
            first = int(np.flatnonzero(wrong)[0])
            raise SettingsError(
                f"the albedo at triangle {int(triangles[first])} is {values[first].tolist()}, "
                f"outside 0..{self.maximum.tolist()}"
            )
        return np.minimum(values, self.maximum)


def _largest(array: Float32[F32, "*_ 3"] | None) -> Float64[F64, "3"]:
    """Give the largest value of each channel; 1 of nothing."""
    return np.ones(3) if array is None else array.reshape(-1, 3).max(axis=0).astype(np.float64)
