"""Spherical harmonics: rotation beside re-projection, evaluation beside scipy, light.

Re-projection is the leanest that is exact: the points of the smallest product rule, the functions
there tabulated beforehand, so that a rotation costs one evaluation at the turned points and two
products.  Both ways turn the same 1,000 vectors of coefficients, each by its own rotation.
"""

from functools import partial

import numpy as np
from harness import Row, best_time
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from prtbake_workers.basis.sh import eval_sh, rotate_sh, sh_light

ORDER = 10
LEAST_GAIN = 20.0
SEED = 0


def rows(quick: bool) -> list[Row]:
    """Return the table of this benchmark; limits on times at full size only."""
    return [*_rotation_rows(quick), *_evaluation_rows(quick), _light_row(quick)]


def _rotation_rows(quick: bool) -> list[Row]:
    rng = np.random.default_rng(SEED)
    n = 100 if quick else 1000
    rotations = Rotation.random(n, rng=rng).as_matrix()
    coeffs = rng.normal(size=(n, ORDER**2))
    directions, weights = _smallest_rule(ORDER)
    project = weights[:, None] * eval_sh(ORDER, directions)

    def reproject(part: slice) -> np.ndarray:
        turned = directions @ rotations[part]
        values = eval_sh(ORDER, turned.reshape(-1, 3)).reshape(*turned.shape[:2], -1)
        return (values @ coeffs[part, :, None])[..., 0] @ project

    # in blocks, so that the tables of the turned points stay small
    blocks = [slice(start, start + 10) for start in range(0, n, 10)]
    singles = [slice(start, start + 1) for start in range(n)]
    repeats = 3 if quick else 10
    slow = best_time(lambda: [reproject(block) for block in blocks], repeats)
    fast = best_time(lambda: rotate_sh(coeffs, rotations), repeats)
    slow_each = best_time(lambda: [reproject(single) for single in singles], repeats)
    fast_each = best_time(
        lambda: [rotate_sh(c, r) for c, r in zip(coeffs, rotations, strict=True)], repeats
    )
    difference = rotate_sh(coeffs, rotations) - np.concatenate([reproject(b) for b in blocks])
    error = float(np.linalg.norm(difference) / np.linalg.norm(coeffs)) ** 2
    return [
        Row(f"re-projection of {n} vectors, order 10", seconds=slow),
        Row(
            f"rotate_sh of {n} vectors, order 10",
            seconds=fast,
            measured=slow / fast,
            unit="x faster",
            limit=None if quick else LEAST_GAIN,
            limit_is="at least",
            limit_description="re-projection in blocks, same run",
            error=error,
        ),
        Row(
            "rotate_sh, one vector a call",
            seconds=fast_each,
            measured=slow_each / fast_each,
            unit="x faster",
            limit_description="re-projection, one vector a call, same run",
        ),
    ]


def _evaluation_rows(quick: bool) -> list[Row]:
    rng = np.random.default_rng(SEED)
    directions = rng.normal(size=(1000 if quick else 20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    degrees = np.repeat(np.arange(ORDER), 2 * np.arange(ORDER) + 1)
    m = np.abs(np.arange(ORDER**2) - degrees * (degrees + 1))
    polar, azimuth = np.arccos(directions[:, 2:]), np.arctan2(directions[:, 1:2], directions[:, :1])
    ours = best_time(partial(eval_sh, ORDER, directions))
    scipy = best_time(partial(sph_harm_y, degrees, m, polar, azimuth), 1)
    return [
        Row(
            "eval_sh, order 10",
            seconds=ours,
            measured=1e9 * ours / (len(directions) * ORDER**2),
            unit="ns a value",
            limit_description=f"{len(directions)} directions; scipy takes {scipy / ours:.0f} times",
        )
    ]


def _light_row(quick: bool) -> Row:
    height = 64 if quick else 512
    directions, weights = _smallest_rule(height // 2)
    radiance = np.ones((len(directions), 3))
    seconds = best_time(lambda: sh_light(ORDER, directions, weights, radiance))
    return Row(
        "sh_light, order 10",
        seconds=seconds,
        measured=1e-6 * len(directions) / seconds,
        unit="Mtexel/s",
        limit_description=f"{len(directions)} texels, three channels",
    )


def _smallest_rule(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre in z, even in phi: exact for products of functions below the order."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    n_phi = 2 * order - 1
    phi = 2 * np.pi * np.arange(n_phi) / n_phi
    z, phi = np.meshgrid(nodes, phi, indexing="ij")
    sine = np.sqrt(1 - z**2)
    directions = np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=-1).reshape(-1, 3)
    return directions, np.repeat(weights * 2 * np.pi / n_phi, n_phi)
