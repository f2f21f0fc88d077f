"""Fast evaluation of functions that are even or odd in x and in y, from a table of one quadrant.

The table is over ``r = sqrt(1 - cos theta)``, as that of `RadialTable`, and the azimuth; bilinear.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.brdf.parity import interpolation, terms_of_parity
from prtbake_workers.brdf.radial_table import radii_of_nodes

CHUNK = 16_384
"""Directions a pass: weights, cells and a term's values fit the cache."""

FINE = 257
"""Nodes along r and along the azimuth of what is made of stored tables."""


@dataclass(frozen=True, eq=False)
class QuadrantTable:
    """Functions of given parities at nodes, r from 0 to 1 times the azimuth from 0 to pi / 2.

    Attributes
    ----------
    values
        A contiguous table a term and column.
    parity
        1 where a term is odd in x, and 1 where it is odd in y.
    """

    values: Float32[F32, "terms columns radii azimuths"]
    parity: Int32[I32, "terms 2"]
    _terms: list[tuple[tuple[int, int], np.ndarray]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        found = [(parity, terms) for _, parity, terms in terms_of_parity(self.parity)]
        object.__setattr__(self, "_terms", found)

    @classmethod
    def of_rings(
        cls,
        rings: Float64[F64, "nodes quad terms columns"],
        parity: Int32[I32, "terms 2"],
        n_phi: int,
        fine: int = FINE,
    ) -> "QuadrantTable":
        """Make a fine table of a coarse one: cubic along r, by waves along the azimuth.

        Parameters
        ----------
        rings
            Values at equal steps of r and at the quadrant's azimuths of a grid of ``n_phi`` a ring.
        fine
            Nodes along either side.
        """
        nodes, _, n_terms, n_columns = rings.shape
        radii, azimuths = radii_of_nodes(fine), np.linspace(0.0, 0.5 * np.pi, fine)
        values = np.empty((n_terms, n_columns, fine, fine), np.float32)
        for _, own, terms in terms_of_parity(parity):
            along = interpolation(own, azimuths, n_phi)
            # a few terms at a time: the float64 copy stays small
            for part in np.array_split(terms, -(-len(terms) // 8)):
                radial = CubicSpline(radii_of_nodes(nodes), rings[:, :, part])(radii)
                values[part] = np.einsum("pq,rqkc->kcrp", along, radial, optimize=True)
        return cls(values, parity)

    def evaluate(self, directions: Float64[F64, "n 3"]) -> Float64[F64, "n terms columns"]:
        """Evaluate in float64; 0 below the horizon."""
        n_terms, n_columns = self.values.shape[:2]
        value = np.empty((n_terms, n_columns, len(directions)))
        for start in range(0, len(directions), CHUNK):
            part = slice(start, start + CHUNK)
            x, y, z = directions[part].T
            self._look_up_chunk(x, y, z, value[:, :, part])
        return np.moveaxis(value, -1, 0)

    def look_up(
        self,
        x: Float32[F32, " n"],
        y: Float32[F32, " n"],
        z: Float32[F32, " n"],
        out: Float32[F32, "terms n"] | None = None,
    ) -> Float32[F32, "terms n"]:
        """Evaluate the first column in float32, one contiguous row a term; 0 below the horizon."""
        if out is None:
            out = np.empty((len(self.parity), len(x)), np.float32)
        for start in range(0, len(x), CHUNK):
            part = slice(start, start + CHUNK)
            self._look_up_chunk(x[part], y[part], z[part], out[:, None, part])
        return out

    def _look_up_chunk(self, x: F32 | F64, y: F32 | F64, z: F32 | F64, out: F32 | F64) -> None:
        corners = self._corners(x, y, z)
        flat = self.values.reshape(*self.values.shape[:2], -1)
        signs = (
            np.where(x < 0.0, -1.0, 1.0).astype(x.dtype),
            np.where(y < 0.0, -1.0, 1.0).astype(x.dtype),
        )
        for (odd_x, odd_y), terms in self._terms:
            weights = corners.weights
            if odd_x:
                weights = weights * signs[0]
            if odd_y:
                weights = weights * signs[1]
            for term in terms:
                for column in range(out.shape[1]):
                    row, into = flat[term, column], out[term, column]
                    np.multiply(row.take(corners.cells[0], mode="clip"), weights[0], out=into)
                    for cell, weight in zip(corners.cells[1:], weights[1:], strict=True):
                        into += row.take(cell, mode="clip") * weight

    def _corners(self, x: F32 | F64, y: F32 | F64, z: F32 | F64) -> "_Corners":
        n_radii, n_azimuths = self.values.shape[2:]
        # r = sine / sqrt(1 + z) keeps its digits near the pole
        radius = np.sqrt(x * x + y * y) / np.sqrt(1.0 + np.maximum(z, 0.0)) * (n_radii - 1)
        azimuth = np.arctan2(np.abs(y), np.abs(x)) * ((n_azimuths - 1) / (0.5 * np.pi))
        row = np.minimum(radius, n_radii - 2).astype(np.intp)
        column = np.minimum(azimuth, n_azimuths - 2).astype(np.intp)
        down, right = np.minimum(radius - row, 1.0), azimuth - column
        above = (z > 0.0).astype(x.dtype)
        down_weights = (1.0 - down) * above, down * above
        cell = row * n_azimuths + column
        return _Corners(
            (cell, cell + 1, cell + n_azimuths, cell + n_azimuths + 1),
            np.stack([own * side for own in down_weights for side in (1.0 - right, right)]).astype(
                x.dtype
            ),
        )


class _Corners(NamedTuple):
    """The four nodes about each direction, and what each counts."""

    cells: tuple[np.ndarray, ...]
    weights: np.ndarray
