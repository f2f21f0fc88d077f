"""Which directions of its hemisphere a vertex sees."""

import numpy as np

from prtbake_workers.arrays import F32, Float32
from prtbake_workers.geometry.accelerator import Accelerator


def padded_directions(samples: Float32[F32, "samples dirs 3"]) -> Float32[F32, "samples dirs 4"]:
    """Pad directions to 16 bytes: numpy picks rows of 16 bytes three times as fast as of 12."""
    padded = np.zeros((*samples.shape[:2], 4), np.float32)
    padded[:, :, :3] = samples
    return padded


def visible_fraction(
    accelerator: Accelerator,
    origins: Float32[F32, "verts 3"],
    normals: Float32[F32, "verts 3"],
    cosines: Float32[F32, "verts dirs"],
    samples: Float32[F32, "samples dirs 4"],
    out: Float32[F32, "verts dirs"],
) -> int:
    """Trace shadow rays over the hemisphere of each vertex.

    Parameters
    ----------
    accelerator
        The occluders.
    origins
        Where rays start: vertices moved off the surface.
    normals
        Unit normals.
    cosines
        n . w of the direction's centre; where it is not positive no ray is traced.
    samples
        Directions from `padded_directions`, one set a supersample.
    out
        Receives the visible share in [0, 1]: of the samples above the horizon, those that
        escape; 0 where no ray was traced.

    Returns
    -------
    int
        Rays traced.
    """
    out.fill(0.0)
    n_rays = 0
    for vertex, origin in enumerate(origins):
        above = np.flatnonzero(cosines[vertex] > 0.0)
        if len(above) == 0:
            continue
        if len(samples) == 1:
            rays = samples[0].take(above, axis=0)[:, :3]
            out[vertex][above] = ~accelerator.occluded_from(origin, rays)
        else:
            escaped = np.zeros(len(above), np.float32)
            counted = np.zeros(len(above), np.float32)
            for sample in samples:
                rays = sample.take(above, axis=0)[:, :3]
                risen = rays @ normals[vertex] > 0.0
                counted += risen
                escaped += risen & ~accelerator.occluded_from(origin, rays)
            # a centre above the horizon has a sample above it, rounding aside
            out[vertex][above] = escaped / np.maximum(counted, np.float32(1.0))
        n_rays += len(above) * len(samples)
    return n_rays
