"""The projection's product, of directions that a group of vertices sees and a matrix."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.basis.projection import LeastSquaresProjection, explained_energy
from prtbake_workers.transport.left_side import Workspace

PLAIN = "plain"


class PickedDirections(NamedTuple):
    """The directions that a group of vertices is sampled in, and their rows of a product."""

    directions: Int64[I64, " dirs"]
    """Two runs of pairs, each of as many firsts and seconds, then those by themselves."""
    n_pairs: tuple[int, int]
    """Pairs of each run, whose samples are folded: see `fold_pairs`."""
    matrices: tuple[F32, ...]
    """Rows of the matrix: for the firsts of each run, or for all where there are no pairs."""


@dataclass(frozen=True)
class PlainProduct:
    """A projection as one matrix, for directions or functions without the symmetry of the other.

    Attributes
    ----------
    matrix
        Of the projection, over root weights: takes weighted samples to whitened coefficients.
    rest
        See `LeastSquaresProjection.rest`.
    """

    matrix: Float32[F32, "dirs coeffs"]
    rest: Float32[F32, "coeffs coeffs"]

    @classmethod
    def of(cls, projection: LeastSquaresProjection) -> "PlainProduct":
        """Convert to float32 once."""
        matrix = projection.matrix / np.sqrt(projection.weights)[:, None]
        return cls(matrix.astype(np.float32), projection.rest.astype(np.float32))

    @classmethod
    def from_tables(
        cls, arrays: Mapping[str, NDArray[Any]], _: Mapping[str, Any]
    ) -> "PlainProduct":
        """Read back what `tables` gave."""
        return cls(arrays["matrix"], arrays["rest"])

    def tables(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Give arrays and numbers that `from_tables` makes the product of again."""
        return {"matrix": self.matrix, "rest": self.rest}, {"kind": PLAIN}

    def pick(self, directions: Int64[I64, " seen"]) -> PickedDirections:
        """Pick the rows of the directions that a group sees."""
        return PickedDirections(directions, (0, 0), (self.matrix.take(directions, axis=0),))

    def multiply(
        self, terms: Float32[F32, "terms verts dirs"], picked: PickedDirections, work: Workspace
    ) -> Float32[F32, "terms verts coeffs"]:
        """Project samples; the coefficients are kept in a buffer."""
        (matrix,) = picked.matrices
        product = work.array("product", (terms[..., 0].size, matrix.shape[1]))
        np.matmul(terms.reshape(len(product), -1), matrix, out=product)
        return product.reshape(*terms.shape[:2], -1)

    def unfold(
        self,
        product: Float32[F32, "terms verts coeffs"],
        out: Float32[F32, "block terms coeffs"],
        rows: Int64[I64, " verts"],
        work: Workspace,
    ) -> Float64[F64, " verts"]:
        """Write the coefficients to rows of ``out`` and return the energy that they explain."""
        coefficients = product.transpose(1, 0, 2).copy()
        out[rows] = coefficients
        return explained_energy(coefficients, self.rest)
