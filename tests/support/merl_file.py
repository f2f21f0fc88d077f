"""MERL tables tabulated from a BRDF by the format's description."""

from functools import cache

import numpy as np

from prtbake_storage.contract.brdf import GgxSpec
from prtbake_workers.brdf.registry import brdf_from_spec

SHAPE = (90, 90, 180)
SCALES = (1 / 1500, 1.15 / 1500, 1.66 / 1500)
COLOURED = GgxSpec(kd=(0.2, 0.1, 0.0), ks=0.8, alpha=0.3, f0=(0.5, 0.3, 0.9))


def directions(h, d, p):
    """Both directions of theta_h, theta_d and phi_d, by rotating d about y: the definition itself."""
    x, y, z = np.sin(d) * np.cos(p), np.sin(d) * np.sin(p), np.cos(d)

    def turned(x, y):
        return np.stack(
            np.broadcast_arrays(x * np.cos(h) + z * np.sin(h), y, z * np.cos(h) - x * np.sin(h)),
            axis=-1,
        )

    return turned(x, y), turned(-x, -y)


def bin_directions():
    h, d, p = ((np.arange(n) + 0.5) / n for n in SHAPE)
    return directions((h**2 * np.pi / 2)[:, None, None], (d * np.pi / 2)[:, None], p * np.pi)


def merl_samples(brdf):
    """Samples (3, theta_h, theta_d, phi_d) in 1/sr; -1 below the horizon, as the real files have."""
    wi, wo = bin_directions()
    value = np.moveaxis(brdf.eval_brdf(wi, wo), -1, 0)
    return np.where((wi[..., 2] > 0) & (wo[..., 2] > 0), value, -1.0)


def merl_bytes(samples, counts=SHAPE):
    """Encode samples, negative ones as the -1 of the format."""
    stored = samples / np.array(SCALES)[:, None, None, None]
    stored[samples < 0] = -1.0
    return np.array(counts, "<i4").tobytes() + stored.astype("<f8").tobytes()


@cache
def coloured_samples():
    """Samples of `COLOURED`; copy before changing them."""
    return merl_samples(brdf_from_spec(COLOURED))
