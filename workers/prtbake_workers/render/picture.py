"""What a renderer gives, and the rule by which every backend decides what a pixel sees."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.render.camera import Pinhole


@dataclass(frozen=True)
class Visibility:
    """The triangle at every pixel centre (-1 for none) and where on it."""

    triangles: Int32[I32, "height width"]
    barycentrics: Float32[F32, "height width 3"]


@dataclass(frozen=True)
class Picture:
    """Linear radiance, pre-multiplied by ``coverage``: the share of a pixel the asset fills."""

    radiance: Float32[F32, "height width 3"]
    coverage: Float32[F32, "height width"]


@dataclass(frozen=True)
class RendererInfo:
    """Which backend draws, on what, and why that one."""

    backend: str
    device: str
    version: str
    reason: str


class Renderer(ABC):
    """Draws one asset; the light is set apart from the view, as it costs more."""

    @property
    @abstractmethod
    def info(self) -> RendererInfo:
        """What draws."""

    @abstractmethod
    def set_light(self, light: Float64[F64, "coeffs 3"]) -> None:
        """Relight with whitened coefficients: the only step that costs work a cluster."""

    @abstractmethod
    def visibility(self, view: Pinhole, width: int, height: int) -> Visibility:
        """Return the triangle behind every pixel centre."""

    @abstractmethod
    def render(self, view: Pinhole, width: int, height: int, samples: int = 1) -> Picture:
        """Draw with ``samples`` x ``samples`` points a pixel."""

    @abstractmethod
    def release(self) -> None:
        """Give everything back."""

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def reduce_samples(picture: Picture, samples: int) -> Picture:
    """Average blocks of ``samples`` x ``samples`` pixels."""
    if samples == 1:
        return picture
    height, width = (size // samples for size in picture.coverage.shape)
    blocks = (height, samples, width, samples)
    return Picture(
        picture.radiance.reshape(*blocks, 3).mean(axis=(1, 3), dtype=np.float32),
        picture.coverage.reshape(blocks).mean(axis=(1, 3), dtype=np.float32),
    )
