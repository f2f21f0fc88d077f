"""The grid on which a BRDF is sampled, and its azimuthal orders there.

An isotropic BRDF depends on the azimuths through their difference alone.  Sampled on rings of
``n_phi`` equal steps, its matrix is block-circulant, and a Fourier transform over the difference
turns it into one small block for each azimuthal order.
"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import dct

from prtbake_storage.errors import BrdfError, SettingsError
from prtbake_workers.arrays import F64, I32, Float64, Int32
from prtbake_workers.brdf.base import Brdf

VALUES_A_PASS = 500_000
"""BRDF values evaluated at once: bounds the memory of fine grids to some tens of MiB."""


@dataclass(frozen=True)
class HemisphereGrid:
    """Midpoints uniform in cos theta, times azimuths uniform in phi: all solid angles equal.

    Attributes
    ----------
    n_theta
        Rings, at least 2.
    n_phi
        Azimuths a ring, even and at least 4; orders up to n_phi / 2 are told apart.
    """

    n_theta: int
    n_phi: int

    def __post_init__(self) -> None:
        if self.n_theta < 2:
            raise SettingsError(f"n_theta must be at least 2, got {self.n_theta}")
        if self.n_phi < 4 or self.n_phi % 2:
            raise SettingsError(f"n_phi must be even and at least 4, got {self.n_phi}")

    @property
    def cosines(self) -> Float64[F64, " theta"]:
        """Cosines of the rings, rising from the horizon to the normal."""
        return (np.arange(self.n_theta) + 0.5) / self.n_theta

    @property
    def ring_weight(self) -> float:
        """Step in cos theta: the weight of a ring in an integral over cos theta."""
        return 1.0 / self.n_theta


def norm_of_order(order: Int32[I32, " n"]) -> Float64[F64, " n"]:
    """Integral of cos^2(m phi), or of 1 for m = 0, over the circle: pi, or 2 pi."""
    norm: F64 = np.where(order == 0, 2.0 * np.pi, np.pi)
    return norm


def azimuthal_blocks(
    brdf: Brdf,
    cos_i: Float64[F64, " n_i"],
    cos_o: Float64[F64, " n_o"],
    n_phi: int,
    *,
    n_orders: int | None = None,
) -> Float64[F64, "orders n_i n_o channels"]:
    """Give the Fourier coefficients of the BRDF over the difference of azimuths.

    ``block_m(i, o) = integral over d of rho(i, o, d) cos(m d)``, by the ``n_phi``-point rule, for
    the orders m = 0 ... n_phi / 2, or the first ``n_orders`` of them.  Then
    ``rho = sum_m block_m cos(m d) / norm_of_order(m)``; the sine coefficients are 0 by mirror
    symmetry.

    Raises
    ------
    BrdfError
        A value is negative or not finite; the message gives the angles.
    """
    n_half = n_phi // 2 + 1
    n_orders = n_half if n_orders is None else n_orders
    wi = _meridian(cos_i)[:, None, None, :]
    wo = _ring(cos_o, np.pi * np.arange(n_half) / (n_half - 1))[None]
    blocks = np.zeros((n_orders, len(cos_i), len(cos_o), brdf.n_channels))
    step = max(1, VALUES_A_PASS // (len(cos_o) * n_half))
    for start in range(0, len(cos_i), step):
        rows = slice(start, start + step)
        value = brdf.eval_brdf(wi[rows], wo)
        _check_values(value, cos_i[rows], cos_o)
        # DCT-I of the half circle is the transform of the whole even circle
        waves = dct(value, type=1, axis=2)[:, :, :n_orders]
        blocks[:, rows] = np.moveaxis(waves, 2, 0) * (2.0 * np.pi / n_phi)
    return blocks


def _check_values(
    value: Float64[F64, "n_i n_o phi channels"],
    cos_i: Float64[F64, " n_i"],
    cos_o: Float64[F64, " n_o"],
) -> None:
    if value.min() >= 0.0 and np.isfinite(value.max()):  # a NaN fails the first comparison
        return
    i, o, step, _ = np.argwhere(~(np.isfinite(value) & (value >= 0.0)))[0]
    raise BrdfError(
        f"the BRDF is {value[i, o, step].tolist()} at cos_i = {cos_i[i]:.6g}, "
        f"cos_o = {cos_o[o]:.6g}, azimuth step {step} of {value.shape[2] - 1} to pi"
    )


def _meridian(cosines: Float64[F64, " n"]) -> Float64[F64, "n 3"]:
    sines = np.sqrt(1.0 - cosines * cosines)
    return np.stack([sines, np.zeros_like(sines), cosines], axis=-1)


def _ring(cosines: Float64[F64, " n"], phi: Float64[F64, " phi"]) -> Float64[F64, "n phi 3"]:
    sines = np.sqrt(1.0 - cosines * cosines)[:, None]
    parts = np.broadcast_arrays(sines * np.cos(phi), sines * np.sin(phi), cosines[:, None])
    return np.stack(parts, axis=-1)
