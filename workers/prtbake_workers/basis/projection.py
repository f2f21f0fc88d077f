"""Regularised least-squares projection of sampled functions on an orthonormal basis."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float32, Float64

RIDGE = 1e-4
"""Weight of the fit's own energy against the squared error at the samples.

It takes 1e-4 of the amplitude (1e-8 of the energy) from what the samples resolve and bounds by
50 what they can add of functions that they hardly see.
"""


@dataclass(frozen=True)
class LeastSquaresProjection:
    """Takes samples in fixed directions to coefficients of an orthonormal basis B.

    ``t = argmin sum_w W_w (T_w - (B t)_w)^2 + ridge |t|^2``

    Attributes
    ----------
    samples
        B, the basis in the directions.
    weights
        W, solid angles in steradians, sum 4 pi.
    gram
        ``M = B^T W B``: the metric as the directions see it; the identity if they resolve B.
    ridge
        See `RIDGE`.
    """

    samples: Float64[F64, "dirs coeffs"]
    weights: Float64[F64, " dirs"]
    gram: Float64[F64, "coeffs coeffs"]
    ridge: float

    @property
    def n_coeffs(self) -> int:
        """Number of coefficients."""
        return int(self.samples.shape[1])

    @cached_property
    def matrix(self) -> Float64[F64, "dirs coeffs"]:
        """``W B (B^T W B + ridge I)^-1``: t = samples @ matrix; solved for when first asked for."""
        system = self.gram.copy()
        system[np.diag_indices(len(system))] += self.ridge
        factor = cho_factor(system, lower=True, overwrite_a=True, check_finite=False)
        weighted = self.samples * self.weights[:, None]
        matrix = cho_solve(factor, weighted.T, overwrite_b=True, check_finite=False).T
        return np.ascontiguousarray(matrix)

    @property
    def rest(self) -> Float64[F64, "coeffs coeffs"]:
        """M + 2 ridge I without its identity: what `explained_energy` takes."""
        return self.gram - (1.0 - 2.0 * self.ridge) * np.eye(self.n_coeffs)

    @property
    def gram_defect(self) -> float:
        """RMS over the basis of what the directions fail to resolve: |M - I|_F / sqrt(n)."""
        deviation = self.gram - np.eye(self.n_coeffs)
        return float(np.linalg.norm(deviation) / np.sqrt(self.n_coeffs))

    def residual_energy_direct(
        self,
        samples: Float64[F64, "verts terms dirs"],
        coefficients: Float32[F32, "verts terms coeffs"],
    ) -> Float64[F64, " verts"]:
        """Squared radiance error by reconstruction at the samples, without cancellation."""
        difference = samples - coefficients.astype(np.float64) @ self.samples.T
        return np.asarray(np.einsum("vkd,vkd,d->v", difference, difference, self.weights))


def explained_energy(
    coefficients: Float32[F32, "verts terms coeffs"], rest: Float32[F32, "coeffs coeffs"]
) -> Float64[F64, " verts"]:
    """Give what a fit explains of the signal's energy, summed over the terms.

    ``|T - B t|_W^2 = |T|_W^2 - t^T (M + 2 ridge I) t`` at the minimum: the latter.

    Parameters
    ----------
    coefficients
        Whitened coefficients t.
    rest
        See `LeastSquaresProjection.rest`.

    Notes
    -----
    ``M = I + (M - I)``: apart, the large part and the small one lose less to float32.  What is left
    of cancellation is the rounding of t, about 1e-7 of the energy; see `residual_energy_direct` for
    vertices where that matters.
    """
    flat = coefficients.reshape(-1, len(rest))
    own = np.vecdot(flat, flat).astype(np.float64) + np.vecdot(flat @ rest, flat)
    return np.asarray(own.reshape(coefficients.shape[:2]).sum(axis=1))


def project(
    samples: Float64[F64, "dirs coeffs"],
    weights: Float64[F64, " dirs"],
    *,
    ridge: float = RIDGE,
) -> LeastSquaresProjection:
    """Prepare the projection on an orthonormal basis known at weighted directions.

    Parameters
    ----------
    samples
        B, the basis in the directions.
    weights
        Solid angles in steradians; their sum must be 4 pi.
    ridge
        Weight of the fit's own energy, > 0, relative to 1.

    Returns
    -------
    LeastSquaresProjection
        Also with fewer directions than coefficients: then the fit of least energy.

    Raises
    ------
    SettingsError
        Weights that do not cover the sphere, or a ridge that is not positive.

    Notes
    -----
    [Tsai2006]_ 5.1 leaves the norm of its regularised least squares open.  Here the penalty is
    the fit's radiance norm, so it means the same at every bandwidth; the system is solved by
    Cholesky in float64 and its condition is at most about 1 / ridge.
    """
    total = float(weights.sum())
    if not abs(total / (4.0 * np.pi) - 1.0) < 1e-6:
        raise SettingsError(f"solid angles must sum to 4 pi, got {total:.6g}")
    if not ridge > 0.0:
        raise SettingsError(f"ridge must be positive, got {ridge}")
    gram = samples.T @ (samples * weights[:, None])
    gram = 0.5 * (gram + gram.T)
    return LeastSquaresProjection(samples=samples, weights=weights, gram=gram, ridge=ridge)


class Projecting(ABC):
    """An orthonormal basis on which samples are projected by least squares."""

    @abstractmethod
    def reconstruction_matrix(
        self, directions: Float64[F64, "dirs 3"]
    ) -> Float64[F64, "dirs coeffs"]:
        """Tabulate the functions in unit directions."""

    def projection(
        self,
        directions: Float64[F64, "dirs 3"],
        weights: Float64[F64, " dirs"],
        *,
        ridge: float = RIDGE,
    ) -> LeastSquaresProjection:
        """Prepare the projection of samples in directions with solid angles, see `project`."""
        return project(self.reconstruction_matrix(directions), weights, ridge=ridge)
