"""Several environments that shine together, as one map: light adds up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.environment.environment import LUMINANCE, Environment
from prtbake_workers.environment.resampling import box_filter, resample

MOST_RADIANCE = float(np.finfo(np.float32).max)
"""Of a texel."""


@dataclass(frozen=True)
class AddedLight:
    """An environment, what its radiance is multiplied by, and its turn R: L'(d) = L(R^T d)."""

    environment: Environment
    scale: float = 1.0
    rotation: Float64[F64, "3 3"] | None = None

    @property
    def power(self) -> float:
        """Mean luminance over the sphere, scaled."""
        return self.scale * float(self.environment.mean_radiance @ LUMINANCE)


def sum_environments(lights: Sequence[AddedLight]) -> Environment:
    """Add lights on a map as high as the highest of them and as wide as the widest.

    A map that is neither turned nor smaller is added texel by texel; a smaller one is cut along the
    sum's texels, which keeps its integral over every texel exactly; one that is turned is resampled
    as at registration.  A lone light that is as it stands comes back bit for bit.

    Raises
    ------
    ValueError
        No lights.
    SettingsError
        The sum exceeds what a map of float32 holds; names the light that adds most there.
    """
    if not lights:
        raise ValueError("there are no lights to add")
    height = max(light.environment.height for light in lights)
    width = max(light.environment.width for light in lights)
    total = np.zeros((height, width, 3))
    for light in lights:
        total += light.scale * _on_map(light, height, width).astype(np.float64)
    if total.max() > MOST_RADIANCE:
        raise _too_bright(lights, total)
    return Environment(total.astype(np.float32))


def _too_bright(lights: Sequence[AddedLight], total: Float64[F64, "rows columns 3"]) -> Exception:
    """Name the light that adds most to the brightest texel, the first of a job being its own."""
    height, width, _ = total.shape
    place = np.unravel_index(int(total.argmax()), total.shape)
    adds = [light.scale * float(_on_map(light, height, width)[place]) for light in lights]
    light = int(np.argmax(adds))
    if light == 0:
        field, pointer = "the environment", "/environment"
    else:
        field = f"scale {lights[light].scale:g} of light {light - 1}"
        pointer = f"/lights/{light - 1}/scale"
    return SettingsError(
        f"{field} makes radiance {total[place]:.3g}: a map holds {MOST_RADIANCE:.3g} at most",
        pointer=pointer,
    )


def _on_map(light: AddedLight, height: int, width: int) -> Float32[F32, "rows columns 3"]:
    own = light.environment
    if light.rotation is not None:
        return resample(own.lookup, height, width, rotation=light.rotation)
    if (own.height, own.width) == (height, width):
        return own.radiance
    return box_filter(own.radiance, height, width)
