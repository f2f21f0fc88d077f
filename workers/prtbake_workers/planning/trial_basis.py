"""How well a basis would hold transfer: a fit that is tried and thrown away."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from prtbake_storage.decode.srbf import gaussian, gram_matrix
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.basis.projection import RIDGE
from prtbake_workers.planning.sampled_transfer import ProbeDirections

DIRECTIONS_PER_BLOCK = 2048
"""Of a table of basis functions: 42 MB at 2562 centres."""


@dataclass(frozen=True, eq=False)
class TrialBasis:
    """Gaussian SRBFs without whitening: a fit only adds their Gram matrix, it inverts none.

    Attributes
    ----------
    centres
        Unit vectors.
    bandwidth
        Of all of them.
    gram
        Their product integrals G.
    """

    centres: Float64[F64, "coeffs 3"]
    bandwidth: float
    gram: Float64[F64, "coeffs coeffs"]

    @classmethod
    def of(cls, centres: Float64[F64, "coeffs 3"], bandwidth: float) -> "TrialBasis":
        """Integrate the products of the functions."""
        return cls(centres, bandwidth, gram_matrix(centres, bandwidth))

    def fit(
        self, at: ProbeDirections, samples: Float32[F32, "functions dirs"]
    ) -> Float64[F64, "coeffs functions"]:
        """Fit as `SrbfBasis.projection` does, in coefficients of the functions themselves.

        ``c = argmin sum_w W_w (T_w - (Y c)_w)^2 + ridge c^T G c``

        Parameters
        ----------
        at
            Directions w and the roots of their solid angles W.
        samples
            ``sqrt(W) T``, see `SampledTransfer.sample`.

        Notes
        -----
        Whitened coefficients are ``t = G^(1/2) c``, so that the penalty is ridge |t|^2.
        """
        system = RIDGE * self.gram
        right = np.zeros((len(self.centres), len(samples)))
        for start in range(0, at.n, DIRECTIONS_PER_BLOCK):
            some = slice(start, start + DIRECTIONS_PER_BLOCK)
            table = self._table(at, some)
            system += table.T @ table
            right += table.T @ samples[:, some].T.astype(np.float64)
        factor = cho_factor(system, lower=True, overwrite_a=True, check_finite=False)
        return np.asarray(cho_solve(factor, right, overwrite_b=True, check_finite=False))

    def missed(
        self,
        at: ProbeDirections,
        samples: Float32[F32, "functions dirs"],
        coefficients: Float64[F64, "coeffs functions"],
    ) -> Float64[F64, " functions"]:
        """Return ``sum_w W_w (T_w - (Y c)_w)^2``, in directions that need not be those of a fit."""
        missed = np.zeros(len(samples))
        for start in range(0, at.n, DIRECTIONS_PER_BLOCK):
            some = slice(start, start + DIRECTIONS_PER_BLOCK)
            difference = samples[:, some].T - self._table(at, some) @ coefficients
            missed += (difference**2).sum(axis=0)
        return missed

    def _table(self, at: ProbeDirections, some: slice) -> Float64[F64, "dirs coeffs"]:
        values = gaussian(at.directions[some] @ self.centres.T, self.bandwidth)
        return values * at.root_weights[some, None]
