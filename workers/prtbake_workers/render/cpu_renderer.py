"""Render without a GPU or GL: rays through pixel centres and the numpy decode."""

from collections.abc import Callable

import numpy as np

from prtbake_storage.decode.asset import Asset
from prtbake_storage.decode.relight import facing, relight, shade
from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.render.camera import Pinhole
from prtbake_workers.render.picture import (
    Picture,
    Renderer,
    RendererInfo,
    Visibility,
    reduce_samples,
)

Intersector = Callable[
    [Float32[F32, "rays 3"], Float32[F32, "rays 3"]],
    tuple[Int32[I32, " rays"], Float32[F32, "rays 3"]],
]
"""Origins and directions to triangles (-1 for none) and barycentrics."""


class CpuRenderer(Renderer):
    """Primary rays through Embree, colours by `prtbake_storage.decode.relight`.

    Parameters
    ----------
    asset
        What to draw.
    intersector
        Finds the first triangle along rays; an Accelerator over the asset's mesh by default.
    reason
        Why this backend draws.
    """

    def __init__(
        self, asset: Asset, intersector: Intersector | None = None, *, reason: str = "asked for"
    ) -> None:
        self._asset = asset
        self._intersect = intersector or _embree(asset)
        self._radiances: list[F32] | None = None
        self._info = RendererInfo("cpu", "Embree and numpy", np.__version__, reason)

    @property
    def info(self) -> RendererInfo:
        """What draws."""
        return self._info

    def set_light(self, light: Float64[F64, "coeffs 3"]) -> None:
        """Relight with whitened coefficients."""
        self._radiances = relight(self._asset, light)

    def visibility(self, view: Pinhole, width: int, height: int) -> Visibility:
        """Return the triangle behind every pixel centre."""
        directions = view.directions(width, height).astype(np.float32)
        origins = np.tile(view.eye.astype(np.float32), (len(directions), 1))
        triangles, barycentrics = self._intersect(origins, directions)
        triangles, barycentrics = facing(self._asset, triangles, barycentrics, -directions)
        return Visibility(triangles.reshape(height, width), barycentrics.reshape(height, width, 3))

    def render(self, view: Pinhole, width: int, height: int, samples: int = 1) -> Picture:
        """Draw with ``samples`` x ``samples`` points a pixel."""
        if self._radiances is None:
            raise ValueError("set_light comes before render")
        columns, rows = width * samples, height * samples
        seen = self.visibility(view, columns, rows)
        triangles = seen.triangles.reshape(-1)
        wo_world = -view.directions(columns, rows)
        barycentrics = seen.barycentrics.reshape(-1, 3)
        colours = shade(self._asset, self._radiances, triangles, barycentrics, wo_world)
        coverage = (seen.triangles >= 0).astype(np.float32)
        return reduce_samples(Picture(colours.reshape(rows, columns, 3), coverage), samples)

    def release(self) -> None:
        """Give everything back."""
        self._radiances = None


def _embree(asset: Asset) -> Intersector:
    # robust: a ray through a pixel centre may meet an edge, and a hole would show
    accelerator = Accelerator(asset.positions.astype(np.float64), asset.faces, robust=True)

    def intersect(
        origins: Float32[F32, "rays 3"], directions: Float32[F32, "rays 3"]
    ) -> tuple[Int32[I32, " rays"], Float32[F32, "rays 3"]]:
        hits = accelerator.intersect(origins, directions)
        return hits.triangles, hits.barycentrics

    return intersect
