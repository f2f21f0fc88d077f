"""How far one picture is from another.

``mask`` says which pixels count; the others show nothing and would only flatter the figures.
"""

from dataclasses import asdict, dataclass

import flip_evaluator
import numpy as np

from prtbake_workers.arrays import B8, F32, Bool, Float32
from prtbake_workers.environment.environment import LUMINANCE
from prtbake_workers.render.images import to_srgb8

REL_MSE_FLOOR = 0.01
"""Added to the squared reference, in units of its mean: black pixels would divide by zero."""

FLIP_TONE = (0.9036, 0.018, 0.0, 0.8748, 0.354, 0.14)
"""ACES as FLIP takes it: y = (a x^2 + b x + c) / (d x^2 + e x + f), the fit to six tenths of x."""

FLIP_LEVEL = 0.85
"""Tone at which FLIP sets the ends of its exposures: the brightest pixel, and the median one."""

FLIP_STOPS = 12.0
"""Most stops between them.  A picture with much black has its median at nothing; FLIP would spend
its time on exposures in which everything seen is white."""


@dataclass(frozen=True)
class Metrics:
    """All figures of one comparison.

    ``relative_l2`` and ``rel_mse`` are ratios (None where only the reference is black: there is
    nothing to be relative to), ``psnr_db`` is of the exposed sRGB pictures (None where they are
    equal), ``flip`` the mean HDR-FLIP error in [0, 1], ``max_abs`` in radiance.
    """

    relative_l2: float | None
    rel_mse: float | None
    psnr_db: float | None
    flip: float
    max_abs: float
    pixels: int
    black_reference: bool
    """The pixels that count are all black in the reference."""

    def to_dict(self) -> dict[str, float | int | None]:
        """Return a JSON object."""
        return asdict(self)


def compare(
    test: Float32[F32, "height width 3"],
    reference: Float32[F32, "height width 3"],
    mask: Bool[B8, "height width"],
    exposure: float,
) -> Metrics:
    """Measure everything; ``exposure`` is for PSNR alone, FLIP chooses its own."""
    error, _ = flip(test, reference, mask)
    return Metrics(
        relative_l2=relative_l2(test, reference, mask),
        rel_mse=rel_mse(test, reference, mask),
        psnr_db=psnr(test, reference, mask, exposure),
        flip=error,
        max_abs=float(np.abs(_chosen(test, mask) - _chosen(reference, mask)).max(initial=0.0)),
        pixels=int(mask.sum()),
        black_reference=bool(mask.any()) and not reference[mask].any(),
    )


def relative_l2(
    test: Float32[F32, "height width 3"],
    reference: Float32[F32, "height width 3"],
    mask: Bool[B8, "height width"],
) -> float | None:
    """Return ||test - reference|| / ||reference||; 0 for two black pictures, None for one."""
    a, b = _chosen(test, mask), _chosen(reference, mask)
    return _ratio(float(np.linalg.norm(a - b)), float(np.linalg.norm(b)))


def rel_mse(
    test: Float32[F32, "height width 3"],
    reference: Float32[F32, "height width 3"],
    mask: Bool[B8, "height width"],
) -> float | None:
    """Return the mean of (t - r)^2 / (r^2 + 0.01 mean r^2) over pixels and channels.

    0 for two black pictures, None if only the reference is black.
    """
    a, b = _chosen(test, mask), _chosen(reference, mask)
    if b.size == 0:
        return 0.0
    mean_square = float((b**2).mean())
    if mean_square == 0.0:
        return _ratio(float(((a - b) ** 2).mean()), 0.0)
    return float(((a - b) ** 2 / (b**2 + REL_MSE_FLOOR * mean_square)).mean())


def psnr(
    test: Float32[F32, "height width 3"],
    reference: Float32[F32, "height width 3"],
    mask: Bool[B8, "height width"],
    exposure: float,
) -> float | None:
    """Return 10 log10(255^2 / MSE) of the exposed 8-bit sRGB pictures; None if they are equal."""
    a, b = _chosen(to_srgb8(test, exposure), mask), _chosen(to_srgb8(reference, exposure), mask)
    mse = float(((a - b) ** 2).mean()) if b.size else 0.0
    return None if mse == 0.0 else float(10.0 * np.log10(255.0**2 / mse))


def flip(
    test: Float32[F32, "height width 3"],
    reference: Float32[F32, "height width 3"],
    mask: Bool[B8, "height width"],
) -> tuple[float, Float32[F32, "height width"]]:
    """Return the mean HDR-FLIP error over the mask, and the error map.

    FLIP's range of exposures comes from the mask, so that the emptiness around an object neither
    costs time nor weighs.  A black reference has no such range and counts as error 1 where the
    test is not black.  About 10 us a pixel and exposure on one thread.
    """
    a = np.where(mask[:, :, None], np.maximum(test, 0.0), 0.0).astype(np.float32)
    b = np.where(mask[:, :, None], np.maximum(reference, 0.0), 0.0).astype(np.float32)
    if not b.any():
        errors: F32 = (a.max(axis=2) > 0).astype(np.float32)
    elif np.array_equal(a, b):
        errors = np.zeros(mask.shape, np.float32)
    else:
        found, _, _ = flip_evaluator.evaluate(
            b,
            a,
            "HDR",
            applyMagma=False,
            computeMeanError=False,
            parameters=_exposures(b[mask]),
        )
        errors = np.asarray(found, np.float32).reshape(mask.shape)
    return (float(errors[mask].mean(dtype=np.float64)) if mask.any() else 0.0), errors


def _exposures(reference: Float32[F32, "pixels 3"]) -> dict[str, float]:
    """Choose FLIP's exposures as it does, in log2, but from the pixels that count."""
    luminance = reference.astype(np.float64) @ LUMINANCE
    brightest = float(luminance.max())
    median = max(float(np.median(luminance)), brightest * 2.0**-FLIP_STOPS)
    a, b, c, d, e, f = FLIP_TONE
    quadratic = (a - FLIP_LEVEL * d, b - FLIP_LEVEL * e, c - FLIP_LEVEL * f)
    level = float(np.roots(quadratic).max())
    start, stop = np.log2(level / brightest), np.log2(level / median)
    return {"startExposure": float(start), "stopExposure": float(max(start, stop))}


def _chosen(picture: np.ndarray, mask: B8) -> np.ndarray:
    return np.asarray(picture[mask], np.float64)


def _ratio(error: float, norm: float) -> float | None:
    if norm == 0.0:
        return 0.0 if error == 0.0 else None
    return error / norm
