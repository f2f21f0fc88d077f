"""Bilinear tables on the unit square, and the cumulative distributions of bilinear densities."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F32, F64, Float32, Float64


class Cells(NamedTuple):
    """Between which two nodes of an axis each lookup falls: the first, and the second's share."""

    first: np.ndarray
    share: Float64[F64, " n"]


class Blend(NamedTuple):
    """Which slices of a table each lookup mixes, and the share of each; a row each."""

    slices: np.ndarray
    shares: Float64[F64, "mixed n"]


def slices_at(nodes: Float64[F64, " nodes"], values: Float64[F64, " n"]) -> Blend:
    """Mix the slices around some values of the parameter; held at the ends of its nodes."""
    if len(nodes) == 1:
        return Blend(np.zeros((1, *values.shape), np.intp), np.ones((1, *values.shape)))
    first = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, len(nodes) - 2)
    share = np.clip((values - nodes[first]) / (nodes[first + 1] - nodes[first]), 0.0, 1.0)
    return Blend(np.stack([first, first + 1]), np.stack([1.0 - share, share]))


def slices_around(
    nodes: Float64[F64, " nodes"], values: Float64[F64, " n"], period: float
) -> Blend:
    """Mix the slices around some values of a periodic parameter; the nodes span less than it."""
    wrapped = np.concatenate([nodes[-1:] - period, nodes, nodes[:1] + period])
    slices, shares = slices_at(wrapped, values)
    return Blend((slices - 1) % len(nodes), shares)


def slices_of_both(outer: Blend, inner: Blend, n_inner: int) -> Blend:
    """Mix slices over two parameters; ``n_inner`` of the second stand together."""
    n = outer.slices.shape[1]
    slices = outer.slices[:, None] * n_inner + inner.slices
    return Blend(slices.reshape(-1, n), (outer.shares[:, None] * inner.shares).reshape(-1, n))


def cells_of(n_nodes: int, place: Float64[F64, " n"]) -> Cells:
    """Find the cells of places in [0, 1] among equidistant nodes that include both ends."""
    scaled = np.clip(place, 0.0, 1.0) * (n_nodes - 1)
    cell = np.minimum(scaled.astype(np.intp), n_nodes - 2)
    return Cells(cell, scaled - cell)


def look_up(
    table: Float32[F32, "slices rows columns channels"],
    slices: Blend,
    x: Float64[F64, " n"],
    y: Float64[F64, " n"],
) -> Float64[F64, "n channels"]:
    """Interpolate a table, bilinear in its square (x along columns) and linear between slices."""
    _, n_rows, n_columns, n_channels = table.shape
    flat = table.reshape(-1, n_channels)
    column, row = cells_of(n_columns, x), cells_of(n_rows, y)
    value = np.zeros((len(x), n_channels))
    for one, share in zip(*slices, strict=True):
        for step_y in range(2):
            for step_x in range(2):
                weight = share * _share(row, step_y) * _share(column, step_x)
                at = one * n_rows + row.first + step_y
                value += weight[:, None] * flat[at * n_columns + column.first + step_x]
    return value


def _share(cell: Cells, step: int) -> Float64[F64, " n"]:
    return cell.share if step else 1.0 - cell.share


@dataclass(frozen=True, eq=False)
class BilinearWarp:
    """Maps places in the unit square to cumulative probabilities, for densities by slice.

    The marginal runs over y, the conditional over x.

    Attributes
    ----------
    density
        At equidistant nodes that include the borders; at least 0; need not be normalised.
    """

    density: Float32[F32, "slices rows columns"]
    _normalised: Float64[F64, "slices rows columns"] = field(init=False, repr=False)
    _conditional: Float64[F64, "slices rows columns"] = field(init=False, repr=False)
    _marginal: Float64[F64, "slices rows"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        density = self.density.astype(np.float64)
        _, n_rows, n_columns = density.shape
        mean = 0.5 * (density[:, :, 1:] + density[:, :, :-1]) / (n_columns - 1)
        conditional = np.zeros_like(density)
        np.cumsum(mean, axis=2, out=conditional[:, :, 1:])
        rows = conditional[:, :, -1]
        marginal = np.zeros(rows.shape)
        np.cumsum(0.5 * (rows[:, 1:] + rows[:, :-1]) / (n_rows - 1), axis=1, out=marginal[:, 1:])
        total = marginal[:, -1]
        if not (total > 0.0).all():
            raise BrdfError(f"slice {int((total <= 0.0).argmax())} of the density is zero")
        object.__setattr__(self, "_normalised", density / total[:, None, None])
        object.__setattr__(self, "_conditional", conditional / total[:, None, None])
        object.__setattr__(self, "_marginal", marginal / total[:, None])

    def invert(
        self, slices: Blend, x: Float64[F64, " n"], y: Float64[F64, " n"]
    ) -> tuple[Float64[F64, " n"], Float64[F64, " n"]]:
        """Give the conditional cumulative probability at x and the marginal one at y.

        Densities and their integrals are interpolated between slices, each slice normalised.
        """
        _, n_rows, n_columns = self.density.shape
        column, row = cells_of(n_columns, x), cells_of(n_rows, y)
        corners = np.zeros((2, 2, len(x)))
        before, total = np.zeros((2, len(x))), np.zeros((2, len(x)))
        below = np.zeros(len(x))
        for at, weight in zip(*slices, strict=True):
            below += weight * self._marginal[at, row.first]
            for step_y in range(2):
                line = row.first + step_y
                before[step_y] += weight * self._conditional[at, line, column.first]
                total[step_y] += weight * self._conditional[at, line, -1]
                for step_x in range(2):
                    corners[step_y, step_x] += (
                        weight * self._normalised[at, line, column.first + step_x]
                    )
        left, right = (_mix(row.share, *corners[:, side]) for side in range(2))
        within = column.share * (left + 0.5 * column.share * (right - left)) / (n_columns - 1)
        whole = _mix(row.share, *total)
        along = (_mix(row.share, *before) + within) / np.where(whole > 0.0, whole, 1.0)
        up = row.share * (total[0] + 0.5 * row.share * (total[1] - total[0])) / (n_rows - 1)
        return np.clip(along, 0.0, 1.0), np.clip(below + up, 0.0, 1.0)


def _mix(
    share: Float64[F64, " n"], first: Float64[F64, " n"], second: Float64[F64, " n"]
) -> Float64[F64, " n"]:
    return (1.0 - share) * first + share * second
