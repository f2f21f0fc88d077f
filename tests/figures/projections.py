"""The hemispherical projections that figure 7 of [Sloan2003] compares, as transfer matrices."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.basis.sh import HemisphereBasis, eval_sh, rotate_sh


@dataclass(frozen=True)
class Projection:
    """How transferred and exit radiance are brought from the hemisphere to spherical harmonics.

    Attributes
    ----------
    name
        Stored rows x columns and the method, for the table.
    exitant, incident
        Orders of the exit radiance and of the transferred radiance between R T and B.
    outer, inner
        What is done on either side: ``zero``, ``odd``, ``even`` or ``least_squares``.
    """

    name: str
    exitant: int
    incident: int
    outer: str
    inner: str

    @property
    def kept(self):
        """Indices of the exit functions whose coefficients are stored: the others are 0."""
        return kept_functions(self.exitant, self.outer)

    def n_bytes(self, n_light):
        """Bytes of a vertex's matrix in float32."""
        return 4 * len(self.kept) * n_light


ZERO_25 = Projection("25 x 25 zero-hemisphere", 5, 5, "zero", "zero")
LEAST_16 = Projection("16 x 25 least squares", 4, 5, "least_squares", "least_squares")

COMPARED = (
    Projection("16 x 25 zero-hemisphere", 4, 5, "zero", "zero"),
    LEAST_16,
    ZERO_25,
    Projection("24 x 25 least squares", 5, 5, "least_squares", "least_squares"),
    Projection("28 x 25 odd reflection", 8, 8, "odd", "odd"),
    Projection("28 x 25 even reflection", 7, 7, "even", "even"),
    Projection("15 x 25 even reflection", 5, 5, "even", "even"),
    Projection("16 x 25 only A^-1 inside", 4, 5, "zero", "least_squares"),
    Projection("16 x 25 only A^-1 outside", 4, 5, "least_squares", "zero"),
    Projection("16 x 25 least squares, 64 inside", 4, 8, "least_squares", "least_squares"),
)
"""(a), (b), (c) of the figure, and what stands beside them in the paper's appendix."""


def kept_functions(order, method):
    """Give the indices of the functions that a method of projection uses."""
    if method == "least_squares":
        return HemisphereBasis(order).kept
    parity = _parity(order)
    used = {"zero": parity >= 0, "odd": parity == 1, "even": parity == 0}[method]
    return np.flatnonzero(used)


def project(order, method, integrals):
    """Turn integrals over the hemisphere, (..., order^2), into as many coefficients.

    A reflection doubles the integrals of the functions of its parity in z and loses the others.
    """
    if method == "least_squares":
        basis = HemisphereBasis(order)
        return basis.complete(basis.from_zero_hemisphere(integrals))
    scale = np.zeros(order**2)
    scale[kept_functions(order, method)] = 1.0 if method == "zero" else 2.0
    return integrals * scale


def transfer_matrices(projection, brdf, transfer, frames):
    """Compose ``M = P B P R T`` with the two projections P in the place of A^-1 of eq. (1).

    Parameters
    ----------
    projection
        Which of them.
    brdf
        B, rows and columns of any order not below those of the projection.
    transfer
        T in the world's axes, (verts, rows, light), of any order not below.
    frames
        R, (verts, 3, 3).

    Returns
    -------
    ndarray
        (verts, exitant^2, light), zero in the rows that are not kept.
    """
    n_out, n_in = projection.exitant**2, projection.incident**2
    local = rotate_sh(np.swapaxes(transfer[:, :n_in], -1, -2), frames[:, None])
    incident = project(projection.incident, projection.inner, local)
    exitant = project(projection.exitant, projection.outer, incident @ brdf[:n_out, :n_in].T)
    return np.swapaxes(exitant, -1, -2)


def exit_functions(projection, views):
    """Evaluate the exit functions in local directions: (views, exitant^2)."""
    return eval_sh(projection.exitant, views)


def _parity(order):
    degrees = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
    m = np.arange(order**2) - degrees * (degrees + 1)
    return (degrees + m) % 2
