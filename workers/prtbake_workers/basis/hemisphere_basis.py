"""Least-squares optimal hemispherical coefficients, without functions nearly redundant there."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from prtbake_storage.decode.sh import check_order, eval_sh, order_of
from prtbake_storage.decode.srbf import CONDITION_LIMIT
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.basis.hemisphere import column_space, functions_of, hemisphere_factors

DROP_TOLERANCE = 1e-4
"""Squared error over the hemisphere that dropping functions may cost a signal of unit power.

At order 5 it takes l = 1, m = 0 alone (1.477e-5), as [Sloan2003]_ does, and the condition number
falls from 1.5e5 to 3.2e3; at order 8 it takes 8 of 64 functions, and 3.5e9 becomes 3.0e4.
"""

HALF = 0.5
"""Least cost of dropping every function of one azimuthal order: no tolerance reaches it."""


@dataclass(frozen=True)
class SampleProjection:
    """Takes samples in fixed directions to hemispherical coefficients: c = samples @ matrix.

    Attributes
    ----------
    matrix
        ``W Y (Y^T W Y)^-1``: least squares over the samples, weighted by their solid angles.
    condition
        Condition number of Y^T W Y.
    """

    matrix: Float64[F64, "dirs functions"]
    condition: float


class HemisphereBasis:
    """Spherical harmonics restricted to z >= 0, without those that the others nearly give.

    A function is dropped, each time the one that those left represent best, as long as the
    largest squared error over the hemisphere, among signals of unit power in the dropped
    functions, stays within the tolerance.  The two functions of a pair +-m go together, so that
    turning the frame about its normal changes no picture.

    Parameters
    ----------
    order
        n >= 1.  A transfer matrix with fewer rows than columns takes two bases.
    tolerance
        See `DROP_TOLERANCE`; 0 drops nothing.

    Attributes
    ----------
    kept, dropped
        Indices l (l + 1) + m of the functions, rising.
    drop_error
        The squared error that bounded the dropping; 0 if nothing was dropped.
    condition
        Condition number of the Gram matrix of the functions kept.
    inverse_gram
        A^-1, its inverse.

    Raises
    ------
    SettingsError
        An order below 1, or a condition number above 1e12: the tolerance is too small.
    """

    def __init__(self, order: int, *, tolerance: float = DROP_TOLERANCE) -> None:
        check_order(order)
        if not 0.0 <= tolerance < HALF:
            raise SettingsError(f"tolerance must be at least 0 and below 0.5, got {tolerance}")
        self.order = order
        self.drop_error = 0.0
        self._columns: list[list[int]] = []
        extremes = []
        inverse = np.zeros((order**2, order**2))
        for m, samples in enumerate(hemisphere_factors(order)):
            columns, error = _independent(samples, tolerance)
            self._columns.append(columns)
            self.drop_error = max(self.drop_error, error)
            root = np.linalg.qr(samples[:, columns], mode="r")
            extremes += np.linalg.svd(root, compute_uv=False)[[0, -1]].tolist()
            inverse_root = solve_triangular(root, np.eye(len(columns)))
            for functions in self._kept_of(m):
                inverse[np.ix_(functions, functions)] = inverse_root @ inverse_root.T
        kept = [functions for m in range(order) for functions in self._kept_of(m)]
        self.kept: Int64[I64, " functions"] = np.sort(np.concatenate(kept))
        self.dropped: Int64[I64, " dropped"] = np.setdiff1d(np.arange(order**2), self.kept)
        self.inverse_gram = inverse[np.ix_(self.kept, self.kept)]
        self.condition = (max(extremes) / min(extremes)) ** 2
        if not self.condition <= CONDITION_LIMIT:
            raise SettingsError(
                f"the {self.n} functions of order {order} that a tolerance of {tolerance:g} keeps "
                f"have condition number {self.condition:.2g} over the hemisphere: take a larger "
                f"tolerance, such as {DROP_TOLERANCE:g}"
            )

    @property
    def n(self) -> int:
        """Number of functions kept."""
        return len(self.kept)

    def evaluate(self, directions: Float64[F64, "dirs 3"]) -> Float64[F64, "dirs functions"]:
        """Evaluate the functions kept; the directions are unit vectors with z >= 0."""
        below = np.flatnonzero(~(directions[:, 2] >= 0.0))
        if len(below):
            raise SettingsError(
                f"direction {below[0]} lies below the horizon: z = {directions[below[0], 2]}"
            )
        return eval_sh(self.order, directions)[:, self.kept]

    def from_zero_hemisphere(
        self, projections: Float64[F64, "... coeffs"]
    ) -> Float64[F64, "... functions"]:
        """Turn integrals over the hemisphere into optimal coefficients, ``c = A^-1 b``.

        Parameters
        ----------
        projections
            ``b_k = integral over z >= 0 of f(s) y_k(s) ds`` for all order^2 functions: what the
            projection on the sphere gives of an f that is 0 below the horizon.

        Returns
        -------
        ndarray
            c that minimises the squared error over the hemisphere, [Sloan2003]_ 9.1.  It
            amplifies an error of b up to as much as the condition number says.
        """
        return np.asarray(projections[..., self.kept] @ self.inverse_gram)

    def from_sphere(self, expansion: Float64[F64, "... coeffs"]) -> Float64[F64, "... functions"]:
        """Restrict functions on the sphere to the hemisphere.

        Parameters
        ----------
        expansion
            Their spherical-harmonic coefficients, of any order.

        Returns
        -------
        ndarray
            Optimal coefficients of what they are for z >= 0.  Of this order: exact, but for
            `drop_error`.
        """
        order = order_of(expansion.shape[-1])
        matrix = np.zeros((order**2, self.n))
        factors = hemisphere_factors(max(order, self.order))
        for m, columns in enumerate(self._columns[:order]):
            functions, signals = factors[m][:, columns], factors[m][:, : order - m]
            fit = np.linalg.lstsq(functions, signals, rcond=None)[0]
            for sign, kept in zip((m, -m), self._kept_of(m), strict=False):
                rows = functions_of(order, sign)
                matrix[np.ix_(rows, np.searchsorted(self.kept, kept))] = fit.T
        return np.asarray(expansion @ matrix)

    def sample_projection(
        self, directions: Float64[F64, "dirs 3"], solid_angles: Float64[F64, " dirs"]
    ) -> SampleProjection:
        """Prepare the fit to functions known in fixed directions.

        Parameters
        ----------
        directions
            Unit vectors with z >= 0.
        solid_angles
            Their weights, > 0, up to a common factor.

        Returns
        -------
        SampleProjection
            Exact for functions in the span, however coarse the directions.

        Raises
        ------
        SettingsError
            A direction below the horizon; a weight that is not positive; directions that do not
            tell the functions apart (condition above 1e12).
        """
        bad = np.flatnonzero(~(solid_angles > 0.0))
        if len(bad):
            raise SettingsError(f"solid angle {bad[0]} is not positive: {solid_angles[bad[0]]}")
        roots = np.sqrt(solid_angles)[:, None]
        left, values, right = np.linalg.svd(roots * self.evaluate(directions), full_matrices=False)
        condition = np.inf
        if len(directions) >= self.n and values[-1] > 0.0:
            condition = float((values[0] / values[-1]) ** 2)
        if not condition <= CONDITION_LIMIT:
            raise SettingsError(
                f"{len(directions)} directions do not determine {self.n} functions: "
                f"condition number {condition:.2g}"
            )
        return SampleProjection(roots * left @ (right / values[:, None]), condition)

    def complete(self, coeffs: Float64[F64, "... functions"]) -> Float64[F64, "... coeffs"]:
        """Put zeros for the functions dropped: order^2 coefficients."""
        whole = np.zeros((*coeffs.shape[:-1], self.order**2))
        whole[..., self.kept] = coeffs
        return whole

    def _kept_of(self, m: int) -> list[Int64[I64, " functions"]]:
        """Give the functions kept of azimuthal order m, then of -m where that is another."""
        signs = (m, -m) if m else (0,)
        return [functions_of(self.order, sign)[self._columns[m]] for sign in signs]


def _independent(
    samples: Float64[F64, "points degrees"], tolerance: float
) -> tuple[list[int], float]:
    """Give the columns kept, and the largest squared error of the others as fitted by them."""
    kept, error = list(range(samples.shape[1])), 0.0
    while True:
        root = np.linalg.qr(samples[:, kept], mode="r")
        # 1 / (A^-1)_kk is the squared error of function k as fitted by the rest
        own_error = 1.0 / np.sum(np.linalg.inv(root) ** 2, axis=1)
        fewer = [k for k in kept if k != kept[int(np.argmin(own_error))]]
        dropped = samples[:, [k for k in range(samples.shape[1]) if k not in fewer]]
        basis = column_space(samples[:, fewer])
        cost = float(np.linalg.norm(dropped - basis @ (basis.T @ dropped), 2)) ** 2
        if not cost <= tolerance:
            return kept, error
        kept, error = fewer, cost
