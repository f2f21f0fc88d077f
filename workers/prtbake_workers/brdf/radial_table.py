"""Fast evaluation of terms ``f(theta) cos(m phi)`` and ``f(theta) sin(m phi)``.

The radial functions are tabulated over ``r = sqrt(1 - cos theta)`` (the radius of the equal-area
map): they are smooth in r both at the pole, where they go like r^m, and at the horizon, where
neither theta nor cos theta spares an arc cosine or keeps them smooth.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32

CHUNK = 16_384
"""Directions a pass: its dozen float32 rows fit a 1 MiB cache."""

POLE_FLOOR = 1e-18
"""Smallest sine of a division; at the pole itself the radial functions of m > 0 are 0."""


def radii_of_nodes(n_nodes: int) -> Float64[F64, " nodes"]:
    """Nodes of the table: r from 0 (normal) to 1 (horizon)."""
    return np.linspace(0.0, 1.0, n_nodes)


def cosines_of_nodes(n_nodes: int) -> Float64[F64, " nodes"]:
    """Cosines of the nodes."""
    return 1.0 - radii_of_nodes(n_nodes) ** 2


@dataclass(frozen=True, eq=False)
class RadialTable:
    """Radial functions, linear between nodes, and the terms made of them.

    Attributes
    ----------
    values
        Radial functions at the nodes.
    unit_of_term, orders, parity
        For each term: which radial function, azimuthal order m, and 0 for cosine or 1 for sine.
    """

    values: Float32[F32, "nodes units columns"]
    unit_of_term: Int32[I32, " terms"]
    orders: Int32[I32, " terms"]
    parity: Int32[I32, " terms"]
    _rows: Float32[F32, "rows nodes"] = field(init=False, repr=False)
    _steps: Float32[F32, "rows nodes"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # one more cell behind the horizon holds zeros: what lies below lands there
        rows = self.values.reshape(len(self.values), -1).T.copy()
        steps = np.diff(rows, axis=1, append=rows[:, -1:])
        rows[:, -1] = 0.0
        object.__setattr__(self, "_rows", rows)
        object.__setattr__(self, "_steps", steps)

    def evaluate(self, directions: Float64[F64, "n 3"]) -> Float64[F64, "n terms columns"]:
        """Evaluate in float64; 0 below the horizon.

        Memory beside the result: a chunk's, some tens of MiB at a hundred terms.
        """
        value = np.empty((len(self.orders), self.values.shape[2], len(directions)))
        for start in range(0, len(directions), CHUNK):
            part = slice(start, start + CHUNK)
            value[..., part] = self._evaluate_chunk(directions[part])
        return np.moveaxis(value, -1, 0)

    def _evaluate_chunk(self, directions: Float64[F64, "n 3"]) -> Float64[F64, "terms columns n"]:
        x, y, z = directions.T
        sine = np.hypot(x, y)
        cell, part = self._cells(sine, z)
        rows = self._rows.astype(np.float64)[:, cell] + self._steps[:, cell] * part
        radial: F64 = rows.reshape(*self.values.shape[1:], -1)[self.unit_of_term]
        scale = np.maximum(sine, POLE_FLOOR)
        distinct, which = np.unique(self.orders, return_inverse=True)
        waves = ((x + 1j * y) / scale) ** distinct[:, None]
        wave = np.where(self.parity[:, None] == 0, waves.real[which], waves.imag[which])
        radial *= wave[:, None, :]
        return radial

    def look_up(
        self,
        x: Float32[F32, " n"],
        y: Float32[F32, " n"],
        z: Float32[F32, " n"],
        out: Float32[F32, "terms n"] | None = None,
    ) -> Float32[F32, "terms n"]:
        """Evaluate the first column in float32, one contiguous row a term; 0 below the horizon.

        Parameters
        ----------
        x, y, z
            Components of unit directions in the local frame.
        out
            Where to write; made if not given.
        """
        if out is None:
            out = np.empty((len(self.orders), len(x)), np.float32)  # every element is written below
        for start in range(0, len(x), CHUNK):
            part = slice(start, start + CHUNK)
            self._look_up_chunk(x[part], y[part], z[part], out[:, part])
        return out

    def _look_up_chunk(self, x: F32, y: F32, z: F32, out: F32) -> None:
        sine: F32 = np.sqrt(x * x + y * y)
        cell, part = self._cells(sine, z)
        inverse = np.float32(1.0) / np.maximum(sine, np.float32(POLE_FLOOR))
        cosine_1, sine_1 = x * inverse, y * inverse
        # cos and sin of m phi by the addition theorem, orders in rising sequence
        cosine_m, sine_m, order = cosine_1, sine_1, 1
        for m, row, cosine_term, sine_term in self._plan:
            while order < m:
                turned = cosine_m * cosine_1
                turned -= sine_m * sine_1
                sine_m = sine_m * cosine_1
                sine_m += cosine_m * sine_1
                cosine_m, order = turned, order + 1
            radial = self._steps[row].take(cell, mode="clip")
            radial *= part
            radial += self._rows[row].take(cell, mode="clip")
            if m == 0:
                out[cosine_term] = radial
            else:
                np.multiply(radial, cosine_m, out=out[cosine_term])
                np.multiply(radial, sine_m, out=out[sine_term])

    @cached_property
    def _plan(self) -> list[tuple[int, int, int, int]]:
        """Order, table row, cosine's and sine's term of each unit, by rising order."""
        n_columns = self.values.shape[2]
        plan = []
        for unit in range(self.values.shape[1]):
            terms = np.flatnonzero(self.unit_of_term == unit)
            plan.append(
                (int(self.orders[terms[0]]), unit * n_columns, int(terms[0]), int(terms[-1]))
            )
        return sorted(plan)

    def _cells(self, sine: F32 | F64, z: F32 | F64) -> tuple[np.ndarray, np.ndarray]:
        """Cell and place within it; r = sine / sqrt(1 + z) keeps its digits near the pole."""
        n_cells = len(self.values) - 1
        scaled = sine / np.sqrt(1.0 + np.maximum(z, 0.0))
        scaled *= n_cells
        scaled[z <= 0.0] = n_cells
        cell = np.minimum(scaled, n_cells).astype(np.intp)
        scaled -= cell
        return cell, scaled
