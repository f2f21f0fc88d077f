"""The squared error of a sum of scattered Gaussian SRBFs, with analytic gradients."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.environment.fit.cells import Cells, cell_of

RIDGE = 1e-6
"""Weight of the coefficients' squared norm (RLS) beside the squared error: bounds the coefficients
of lobes that nearly coincide, and moves the error of others in the sixth digit."""

_REGION_FACE_CELLS = 16
"""Regions along a cube's edge, 5.6 degrees each: about what 642 lobes of transfer tell apart."""

SOLVED_AT_A_TIME = 1 << 14


class Lobes(NamedTuple):
    """Scattered SRBFs: G(w . centre; bandwidth) = exp(bandwidth (w . centre - 1))."""

    centres: Float64[F64, "lobes 3"]
    bandwidths: Float64[F64, " lobes"]


class Gradient(NamedTuple):
    """Derivatives of the squared error."""

    centres: Float64[F64, "lobes 3"]
    log_bandwidths: Float64[F64, " lobes"]
    coefficients: Float64[F64, "lobes 3"]


class Projection(NamedTuple):
    """The best coefficients of given lobes: regularised error, coefficients, and its gradient."""

    error: float
    coefficients: Float64[F64, "lobes 3"]
    gradient: Gradient


@dataclass(frozen=True)
class SquaredError:
    """E = sum_i w_i |f_i - sum_j L_j exp(lam_j (xi_j . eta_i - 1))|^2, eq. (20) of [Tsai2006]_.

    ``cells`` hold directions eta, radiance f (three channels) and solid angles w.
    """

    cells: Cells

    def evaluate(
        self, lobes: Lobes, coefficients: Float64[F64, "lobes 3"]
    ) -> tuple[float, Gradient]:
        """Give the squared error and its gradient with every parameter free.

        With r = f - sum_j L_j G_j:  dE/dL_j = -2 sum w G_j r,
        dE/dxi_j = -2 lam_j sum w (r . L_j) G_j eta (before projection on the sphere's tangent),
        dE/d(log lam_j) = -2 lam_j sum w (r . L_j) G_j (xi_j . eta - 1).
        """
        kernel = self._weighted_kernel(lobes)
        residual = self._weighted_radiance - kernel @ coefficients
        return float((residual**2).sum()), self._gradient(lobes, coefficients, kernel, residual)

    def project(self, lobes: Lobes) -> Projection:
        """Give the least regularised error over the coefficients, those, and the gradient there.

        The derivative along the coefficients vanishes at the optimum, so that the gradient for
        centres and bandwidths is the one with the coefficients held (variable projection).
        """
        kernel = self._weighted_kernel(lobes)
        target = self._weighted_radiance
        coefficients = solve_coefficients(kernel.T @ kernel, kernel.T @ target, lobes.bandwidths)
        residual = target - kernel @ coefficients
        error = float((residual**2).sum())
        gradient = self._gradient(lobes, coefficients, kernel, residual)
        penalty = ridge_weights(lobes.bandwidths)[:, None] * coefficients**2
        # the weights of the ridge fall as 1 / bandwidth
        slope = gradient.log_bandwidths - penalty.sum(axis=1)
        return Projection(
            error + float(penalty.sum()), coefficients, gradient._replace(log_bandwidths=slope)
        )

    def gram(self, lobes: Lobes) -> Float64[F64, "lobes lobes"]:
        """Give the regularised Gram matrix of the lobes on the cells."""
        kernel = self._weighted_kernel(lobes)
        return np.asarray(kernel.T @ kernel + np.diag(ridge_weights(lobes.bandwidths)))

    @property
    def _weighted_radiance(self) -> Float64[F64, "cells 3"]:
        return np.asarray(np.sqrt(self.cells.solid_angles)[:, None] * self.cells.radiance)

    def _weighted_kernel(self, lobes: Lobes) -> Float64[F64, "cells lobes"]:
        return np.sqrt(self.cells.solid_angles)[:, None] * evaluate_lobes(
            lobes, self.cells.directions
        )

    def _gradient(
        self,
        lobes: Lobes,
        coefficients: Float64[F64, "lobes 3"],
        kernel: Float64[F64, "cells lobes"],
        residual: Float64[F64, "cells 3"],
    ) -> Gradient:
        pull = residual @ coefficients.T
        pull *= kernel
        along = pull.T @ self.cells.directions
        bandwidths = lobes.bandwidths
        towards = (along * lobes.centres).sum(axis=1) - pull.sum(axis=0)
        return Gradient(
            centres=-2 * bandwidths[:, None] * along,
            log_bandwidths=-2 * bandwidths * towards,
            coefficients=-2 * kernel.T @ residual,
        )


def evaluate_lobes(lobes: Lobes, directions: Float64[F64, "dirs 3"]) -> Float64[F64, "dirs lobes"]:
    """Evaluate every lobe in every direction."""
    values = directions @ lobes.centres.T
    values -= 1.0
    values *= lobes.bandwidths
    return np.asarray(np.exp(values, out=values))


def ridge_weights(bandwidths: Float64[F64, " lobes"]) -> Float64[F64, " lobes"]:
    """Give RIDGE times the squared norm of each lobe, pi / lam for all but the widest."""
    return np.asarray(RIDGE * np.pi / bandwidths)


def solve_coefficients(
    gram: Float64[F64, "lobes lobes"],
    moments: Float64[F64, "lobes 3"],
    bandwidths: Float64[F64, " lobes"],
) -> Float64[F64, "lobes 3"]:
    """Solve the regularised normal equations (RLS), scaled to lobes of unit norm."""
    scale = np.sqrt(bandwidths / np.pi)
    scaled = gram * scale * scale[:, None]
    scaled[np.diag_indices_from(scaled)] += RIDGE
    return np.asarray(scale[:, None] * cho_solve(cho_factor(scaled), scale[:, None] * moments))


def solve_over(
    lobes: Lobes, texels: Cells, *, region_weight: float = 0.0
) -> Float64[F64, "lobes 3"]:
    """Solve the coefficients over all texels, in blocks.

    With a ``region_weight`` W, the squared error of the means over regions of 5.6 degrees counts
    W times more: minimises E + W E_regions.
    """
    n = len(lobes.bandwidths)
    gram, moments = np.zeros((n, n)), np.zeros((n, 3))
    region = cell_of(texels.directions, _REGION_FACE_CELLS)
    n_regions = 6 * _REGION_FACE_CELLS**2
    sums, wanted, areas = np.zeros((n_regions, n)), np.zeros((n_regions, 3)), np.zeros(n_regions)
    for rows in _rows(texels):
        block = Cells(*(part[rows] for part in texels))
        kernel = evaluate_lobes(lobes, block.directions)
        weighted = kernel * block.solid_angles[:, None]
        gram += weighted.T @ kernel
        moments += weighted.T @ block.radiance
        if region_weight:
            count = len(block.solid_angles)
            gather = csr_array(
                (np.ones(count), (region[rows], np.arange(count))), shape=(n_regions, count)
            )
            sums += gather @ weighted
            wanted += gather @ (block.solid_angles[:, None] * block.radiance)
            areas += gather @ block.solid_angles
    if region_weight:
        seen = areas > 0
        weight = region_weight / areas[seen, None]
        gram += sums[seen].T @ (weight * sums[seen])
        moments += sums[seen].T @ (weight * wanted[seen])
    return solve_coefficients(gram, moments, lobes.bandwidths)


def residual(
    lobes: Lobes, coefficients: Float64[F64, "lobes 3"], texels: Cells
) -> Float64[F64, "texels 3"]:
    """Give the radiance that the lobes leave, texel by texel."""
    return np.concatenate(
        [
            texels.radiance[rows] - evaluate_lobes(lobes, texels.directions[rows]) @ coefficients
            for rows in _rows(texels)
        ]
    )


def squared_error(lobes: Lobes, coefficients: Float64[F64, "lobes 3"], texels: Cells) -> float:
    """Give the squared error itself over all texels, as a sum of squares: nothing cancels."""
    left = residual(lobes, coefficients, texels)
    return float(texels.solid_angles @ (left**2).sum(axis=1))


def _rows(texels: Cells) -> list[slice]:
    """Cut the texels into blocks that fit the cache."""
    n = len(texels.solid_angles)
    return [slice(i, min(i + SOLVED_AT_A_TIME, n)) for i in range(0, n, SOLVED_AT_A_TIME)]
