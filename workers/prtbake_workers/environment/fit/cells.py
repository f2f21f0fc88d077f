"""Texels merged into the cells of a cube, finer where the light varies: the fit's quadrature."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from prtbake_workers.arrays import B8, F64, I64, Bool, Float64, Int64
from prtbake_workers.environment.environment import Environment, directions_from_angles

MAX_FACE_CELLS = 1 << 12
"""Cells along a cube's edge at the finest: smaller than the texels of any map that is kept."""

_NEGLIGIBLE = 1e-4
"""Share of the whole squared radiance that all unsplit cells may hide in all."""

PEAK = 20.0
"""What is brighter than this many times the mean of the rest is a peak: a sun, a lamp."""

_ALWAYS = 0.05
"""Share of a cell's squared radiance that counts as varying even where it is even: a lobe on a sun
varies inside the sun."""

SPLIT_ROWS = 7
"""Of parts of a bright texel while lobes move.  Lobes are as narrow as the parts can show, and what
they do between the parts is not seen: with 3 rows 24 lobes on a sun of one texel were said to leave
0.03 of the light, and left 0.20; with 7 they leave 0.10."""

_HOT_PARTS = 1 << 19
"""Parts that texels are split into at most: as many as a map of 1024 x 512 has texels."""


class Cells(NamedTuple):
    """Merged texels: mean direction (unit), mean radiance, and the sum of their solid angles."""

    directions: Float64[F64, "cells 3"]
    radiance: Float64[F64, "cells 3"]
    solid_angles: Float64[F64, " cells"]

    @property
    def energy(self) -> float:
        """Squared radiance integrated over the sphere and summed over the channels."""
        return float(self.solid_angles @ (self.radiance**2).sum(axis=1))


class FitSamples(NamedTuple):
    """The same light in three samplings.

    ``moving`` while lobes move; ``solving``, finer, in which their coefficients are solved, or
    narrow lobes of opposite sign would oscillate between samples; ``judging``, finer still, in
    which the error is taken.
    """

    moving: Cells
    solving: Cells
    judging: Cells


def fit_samples(environment: Environment, rows: int = SPLIT_ROWS) -> FitSamples:
    """Sample a map with ``rows`` rows of parts of a bright texel, and with two and three times."""
    return FitSamples(*(environment_texels(environment, own) for own in _row_counts(rows)))


def count_samples(environment: Environment, rows: int = SPLIT_ROWS) -> tuple[int, int, int]:
    """Count what `fit_samples` gives, without making it."""
    height, width = environment.height, environment.width
    counts = []
    for own in _row_counts(rows):
        hot = _hot_texels(environment, own).reshape(height, width).sum(axis=1)
        columns = np.array([_split_columns(row, height, width, own) for row in range(height)])
        counts.append(int(height * width + hot @ (own * columns - 1)))
    return counts[0], counts[1], counts[2]


def _row_counts(rows: int) -> tuple[int, int, int]:
    return rows, 2 * rows + 1, 3 * rows + 2


def environment_texels(environment: Environment, rows: int = SPLIT_ROWS) -> Cells:
    """Give the texels of a map, the brightest and their neighbours split into nearly square parts.

    A split texel has ``rows`` rows of them.  A lobe as narrow as a texel changes inside it, so one
    sample at its centre would neither give the true error nor keep the lobe's integral to what the
    sun in that texel sends out.
    """
    height, width = environment.height, environment.width
    solid_angles = environment.solid_angles()
    hot = _hot_texels(environment, rows)
    radiance = environment.radiance.reshape(-1, 3).astype(np.float64)
    parts = [Cells(environment.directions()[~hot], radiance[~hot], solid_angles[~hot])]
    for texel in np.flatnonzero(hot):
        directions, areas = _split_texel(int(texel), height, width, rows)
        parts.append(Cells(directions, np.repeat(radiance[[texel]], len(areas), axis=0), areas))
    return Cells(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _hot_texels(environment: Environment, rows: int) -> Bool[B8, " texels"]:
    """Mark the texels that are split: the brightest and their neighbours, while there is room."""
    luminance = environment.luminance
    solid_angles = environment.solid_angles()
    hot = luminance > clip_level(luminance.ravel(), solid_angles)
    hot = maximum_filter(hot, 5, mode=("nearest", "wrap")).ravel()
    most = _HOT_PARTS // rows**2
    if hot.sum() > most:
        power = np.where(hot, luminance.ravel() * solid_angles, 0.0)
        hot = np.zeros_like(hot)
        hot[np.argsort(power, kind="stable")[::-1][:most]] = True
    return hot


def clip_level(luminance: Float64[F64, " texels"], solid_angles: Float64[F64, " texels"]) -> float:
    """Give the level that is ``PEAK`` times the mean of the luminance clipped at it.

    Infinite for a black map.  At most 1 / PEAK of the sphere is brighter than it.
    """
    share = solid_angles / solid_angles.sum()
    level = float(luminance.max())
    for _ in range(100):
        lower = PEAK * float(share @ np.minimum(luminance, level))
        if lower >= level * (1 - 1e-6):
            break
        level = lower
    return level if level > 0 else np.inf


def even_cells(texels: Cells, face_cells: int) -> Cells:
    """Merge texels into the cells of a cube map of ``face_cells``^2 cells a face.

    The integral of the radiance is kept; texels larger than a cell stay as they are.
    """
    return _merge(texels, cell_of(texels.directions, face_cells))


def adaptive_cells(texels: Cells, face_cells: int, max_cells: int) -> Cells:
    """Merge texels into cells, splitting those in which the squared radiance varies most.

    Starts from ``face_cells`` along a cube's edge and splits the worst cells in four, a level at a
    time and their neighbours with them, down to single texels, until about ``max_cells`` are used.
    A sun of a few texels is so kept texel by texel while an even sky costs little.
    """
    key = cell_of(texels.directions, face_cells)
    squared = texels.solid_angles * (texels.radiance**2).sum(axis=1)
    total = float(squared.sum())
    level, open_texels = face_cells, np.arange(len(key))
    offset = 6 * face_cells**2
    while level < MAX_FACE_CELLS and len(open_texels):
        _, index, counts = np.unique(key[open_texels], return_inverse=True, return_counts=True)
        merged = _sums(texels, open_texels, index)
        whole = np.bincount(index, squared[open_texels])
        varies = whole - (1 - _ALWAYS) * _squared_of_sums(merged)
        # a share of the room for each level to come, or many lamps use it up before any is fine
        room = (max_cells - len(np.unique(key))) // (MAX_FACE_CELLS // level).bit_length()
        worst = np.argsort(varies, kind="stable")[::-1][: max(room // 3, 0)]
        worst = worst[(varies[worst] > total * _NEGLIGIBLE / max_cells) & (counts[worst] > 1)]
        if not len(worst):
            break
        worst = _with_neighbours(worst, merged.directions, 1.6 * (np.pi / 2) / level)
        chosen = np.isin(index, worst) & (counts > 1)[index]
        open_texels = open_texels[chosen]
        level *= 2
        key[open_texels] = offset + cell_of(texels.directions[open_texels], level)
        offset += 6 * level**2
    return _merge(texels, key)


def _with_neighbours(
    chosen: Int64[I64, " chosen"], sums: Float64[F64, "cells 3"], distance: float
) -> Int64[I64, " more"]:
    """Add the cells close to the chosen ones: what a lobe spills beside a sun has to be seen."""
    directions = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    near = cKDTree(directions).query_ball_point(directions[chosen], distance)
    return np.unique(np.concatenate([np.asarray(n, dtype=np.int64) for n in near]))


def cell_of(directions: Float64[F64, "texels 3"], face_cells: int) -> Int64[I64, " texels"]:
    """Give the cell of a cube map of equal angles, whose cells differ little in size."""
    rows = np.arange(len(directions))
    axis = np.argmax(np.abs(directions), axis=1)
    along = directions[rows, axis]
    u, v = (
        (np.arctan2(directions[rows, (axis + i) % 3], np.abs(along)) * (4 / np.pi) + 1) / 2
        for i in (1, 2)
    )
    column, row = (np.clip((t * face_cells).astype(np.int64), 0, face_cells - 1) for t in (u, v))
    return np.asarray(((2 * axis + (along < 0)) * face_cells + row) * face_cells + column)


def _merge(texels: Cells, key: Int64[I64, " texels"]) -> Cells:
    """Merge the texels of equal key."""
    _, index = np.unique(key, return_inverse=True)
    index = index.astype(np.int64)
    sums = _sums(texels, np.arange(len(key)), index)
    directions = sums.directions / np.linalg.norm(sums.directions, axis=1, keepdims=True)
    return Cells(directions, sums.radiance / sums.solid_angles[:, None], sums.solid_angles)


def _sums(texels: Cells, chosen: Int64[I64, " chosen"], index: Int64[I64, " chosen"]) -> Cells:
    """Sum direction and radiance, weighted, and the weights over texels of equal index."""
    weights = texels.solid_angles[chosen]

    def total(values: F64) -> F64:
        return np.stack([np.bincount(index, weights * column) for column in values.T], axis=1)

    return Cells(
        total(texels.directions[chosen]),
        total(texels.radiance[chosen]),
        np.bincount(index, weights).astype(np.float64),
    )


def _squared_of_sums(sums: Cells) -> Float64[F64, " cells"]:
    """Give the squared radiance of the cells if each had its mean radiance all over."""
    return np.asarray((sums.radiance**2).sum(axis=1) / sums.solid_angles)


def _split_columns(row: int, height: int, width: int, rows: int) -> int:
    """Count the columns of parts of a texel in a row of the map."""
    middle = np.sin((row + 0.5) / height * np.pi)
    return max(1, round(rows * float(middle) * 2 * height / width))


def _split_texel(
    texel: int, height: int, width: int, rows: int
) -> tuple[Float64[F64, "parts 3"], Float64[F64, " parts"]]:
    """Split a lat-long texel into rows and as many columns as make the parts nearly square."""
    row, column = divmod(texel, width)
    n_columns = _split_columns(row, height, width, rows)
    edges = np.cos((row + np.arange(rows + 1) / rows) / height * np.pi)
    azimuth = (column + (np.arange(n_columns) + 0.5) / n_columns) * (2 * np.pi / width) - np.pi
    directions = directions_from_angles(
        np.tile(azimuth, rows), np.repeat((edges[:-1] + edges[1:]) / 2, n_columns)
    )
    areas = np.repeat(edges[:-1] - edges[1:], n_columns) * (2 * np.pi / width / n_columns)
    return directions, areas
