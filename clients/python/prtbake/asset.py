"""Compressed assets on this side of the wire: open, relight, colour."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prtbake_storage.decode import asset as arrays
from prtbake_storage.decode import light as lights
from prtbake_storage.decode.relight import (
    corner_colour,
    project_light,
    relight,
    rotation_matrix,
    shade,
)
from prtbake_storage.decode.texture import lookup_repeating
from prtbake_storage.hdf5.light import read_light
from prtbake_storage.hdf5.reader import read_asset

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Light = lights.Light | Path | str
"""A fitted light, several in a `LightSum`, or the ``light.h5`` that holds one."""


class Asset:
    """A compressed asset, relit in plain numpy.

    Parameters
    ----------
    data
        The asset's arrays.

    Examples
    --------
    >>> asset = Asset.open(Path("asset.h5"))  # doctest: +SKIP
    >>> colours = asset.vertex_radiance((0, 1, 3), Path("light.h5"), rotation=(0, 90, 0))
    """

    def __init__(self, data: arrays.Asset) -> None:
        self.data = data

    @classmethod
    def open(cls, path: Path | str) -> Self:
        """Read an ``asset.h5``; a damaged file raises `CorruptArtefact`."""
        return cls(read_asset(Path(path)))

    @property
    def positions(self) -> F32:
        """(verts, 3) in scene units."""
        return self.data.positions

    @property
    def faces(self) -> NDArray[np.int32]:
        """(tris, 3) vertex indices."""
        return self.data.faces

    @property
    def nbytes(self) -> dict[str, int]:
        """Bytes in memory by group."""
        return self.data.nbytes

    @property
    def precision(self) -> dict[str, arrays.Precision | None]:
        """Of each part by name, bits of its factors and the error of rounding; None if exact."""
        return {part.name: part.precision for part in self.data.parts}

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Digests, settings, seeds and versions that the asset was made with."""
        return self.data.provenance

    def relight(self, light: Light, *, rotation: ArrayLike | None = None) -> list[F32]:
        """Do the work that a light needs once, for all views.

        Parameters
        ----------
        light
            What shines.
        rotation
            Turns the light: three angles about x, y and z in degrees, or a (3, 3) matrix.

        Returns
        -------
        list
            One array (verts, R_view, 3) a part: radiance a view column.
        """
        fit = read_light(Path(light)) if isinstance(light, Path | str) else light
        turned = project_light(self.data.basis, fit, _matrix(rotation))
        return relight(self.data, turned)

    def vertex_radiance(
        self,
        eye: ArrayLike,
        light: Light | list[F32],
        *,
        rotation: ArrayLike | None = None,
    ) -> F32:
        """Colour every vertex as seen from a point.

        Parameters
        ----------
        eye
            (3,) in scene units.
        light
            What shines, or what `relight` made of it.
        rotation
            As for `relight`.

        Returns
        -------
        ndarray
            (verts, 3) linear Rec.709 radiance; 0 for vertices whose normal leans away from the
            eye.
        """
        lit = light if isinstance(light, list) else self.relight(light, rotation=rotation)
        towards = np.asarray(eye, dtype=np.float64) - self.data.positions
        distance = np.linalg.norm(towards, axis=1, keepdims=True)
        # an eye on a vertex sees it from its normal
        wo = np.where(distance > 0, towards / np.maximum(distance, 1e-300), self.data.normals)
        colours = np.zeros((self.data.n_vertices, 3), np.float32)
        for part, radiance in zip(self.data.parts, lit, strict=True):
            mine = slice(*part.vertex_range)
            all_vertices = np.arange(part.n_vertices)
            colour = corner_colour(part, radiance, all_vertices, wo[mine].astype(np.float32))
            colours[mine] = colour * self._albedo(part)
        facing = np.einsum("vi,vi->v", wo, self.data.normals) > 0
        return np.where(facing[:, None], colours, np.float32(0))

    def shade(
        self,
        triangles: NDArray[np.int32],
        barycentrics: NDArray[np.floating],
        wo_world: NDArray[np.floating],
        lit: list[F32],
    ) -> F32:
        """Colour points that another rasteriser found; ``lit`` is what `relight` returned."""
        return shade(self.data, lit, triangles, barycentrics, wo_world)

    def _albedo(self, part: arrays.Part) -> F32:
        albedo = part.albedo[None]
        if part.albedo_texture is not None and self.data.uv is not None:
            uv = self.data.uv[slice(*part.vertex_range)]
            albedo = albedo * lookup_repeating(part.albedo_texture, uv)
        if part.vertex_colours is not None:
            albedo = albedo * part.vertex_colours
        return albedo


def _matrix(rotation: ArrayLike | None) -> F64 | None:
    if rotation is None:
        return None
    given = np.asarray(rotation, dtype=np.float64)
    if given.shape == (3,):
        return rotation_matrix(given)
    if given.shape != (3, 3):
        raise ValueError(f"rotation has shape {given.shape}, not (3,) or (3, 3)")
    return given
