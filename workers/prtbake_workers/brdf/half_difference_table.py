"""A BRDF tabulated over half and difference angles, as MERL's measurements are."""

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import distance_transform_edt

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import B8, F32, F64, Bool, Float32, Float64
from prtbake_workers.brdf.base import above_horizon
from prtbake_workers.brdf.half_difference import HalfDifference, directions_of, half_difference


def bin_angles(n_theta_h: int, n_theta_d: int, n_phi_d: int) -> HalfDifference:
    """Angles at the centres of the bins, as three axes that broadcast.

    Bins of theta_h are equal steps of its square root, as MERL has them: narrow where highlights
    are.  The others are equal steps of the angle.
    """
    steps = [(np.arange(n) + 0.5) / n for n in (n_theta_h, n_theta_d, n_phi_d)]
    quarter = 0.5 * np.pi
    return HalfDifference(
        (steps[0] ** 2 * quarter)[:, None, None],
        (steps[1] * quarter)[:, None],
        steps[2] * quarter,
    )


def bins_above_horizon(
    n_theta_h: int, n_theta_d: int, n_phi_d: int
) -> Bool[B8, "theta_h theta_d phi_d"]:
    """Tell which bins have both directions of their centre above the surface."""
    return above_horizon(*directions_of(*bin_angles(n_theta_h, n_theta_d, n_phi_d)))


def filled_from_nearest(
    values: Float64[F64, "channels theta_h theta_d phi_d"],
    valid: Bool[B8, "theta_h theta_d phi_d"],
) -> Float64[F64, "channels theta_h theta_d phi_d"]:
    """Give every bin that is not valid the values of the valid one fewest bins away."""
    nearest = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    filled: F64 = values[:, *nearest]
    return filled


@dataclass(frozen=True, eq=False)
class HalfDifferenceTable:
    """Trilinear between bin centres: isotropic, reciprocal and mirror-symmetric by construction.

    Attributes
    ----------
    values
        BRDF in 1/sr at the centres of `bin_angles`, all at least 0, those below the horizon filled
        from above it, so that the interpolation meets no edge there.

    Notes
    -----
    Where phi_d means nothing, at theta_h = 0 and theta_d = 0, the table is closed by the mean over
    phi_d of the first bins; beyond the last bin centres it is constant.
    """

    values: Float32[F32, "theta_h theta_d phi_d 3"]
    _closed: Float32[F32, "nodes 3"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.values).all() and (self.values >= 0.0).all()):
            raise BrdfError("the BRDF's table holds negative values or NaN")
        table = self.values
        table = np.concatenate([_round_mean(table[:1]), table, table[-1:]], axis=0)
        table = np.concatenate([_round_mean(table[:, :1]), table, table[:, -1:]], axis=1)
        table = np.concatenate([table[:, :, :1], table, table[:, :, -1:]], axis=2)
        object.__setattr__(self, "_closed", np.ascontiguousarray(table.reshape(-1, 3)))

    @property
    def n_channels(self) -> int:
        """Three: linear Rec.709."""
        return 3

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        angles = half_difference(wi, wo)
        share = [np.clip(angle / (0.5 * np.pi), 0.0, 1.0) for angle in angles]
        share[0] = np.sqrt(share[0])
        n_bins = self.values.shape[:3]
        cells, parts = zip(*(_cell(s, n) for s, n in zip(share, n_bins, strict=True)), strict=True)
        strides = ((n_bins[1] + 2) * (n_bins[2] + 2), n_bins[2] + 2, 1)
        first = sum(cell * stride for cell, stride in zip(cells, strides, strict=True))
        value = np.zeros((*first.shape, 3))
        for corner in np.ndindex(2, 2, 2):
            weight = np.ones(first.shape)
            for side, part in zip(corner, parts, strict=True):
                weight *= part if side else 1.0 - part
            offset = sum(side * stride for side, stride in zip(corner, strides, strict=True))
            value += weight[..., None] * self._closed[first + offset]
        value[~above_horizon(wi, wo)] = 0.0
        return value


def _round_mean(bins: Float32[F32, "a b phi_d 3"]) -> Float32[F32, "a b phi_d 3"]:
    """Give every phi_d the mean over all of them."""
    mean = bins.mean(axis=2, keepdims=True, dtype=np.float64).astype(np.float32)
    return np.broadcast_to(mean, bins.shape)


def _cell(share: Float64[F64, "..."], n_bins: int) -> tuple[np.ndarray, Float64[F64, "..."]]:
    """Cell and place within it, among nodes at 0, the bin centres and 1.

    The first and the last cell are half a bin wide.
    """
    scaled = share * n_bins
    cell = np.minimum(np.floor(scaled + 0.5), n_bins).astype(np.intp)
    part = scaled + 0.5 - cell
    first, last = cell == 0, cell == n_bins
    part[first] = 2.0 * scaled[first]
    part[last] = 2.0 * part[last]
    return cell, part
