"""The Utah teapot, from Newell's 32 bicubic Bézier patches.

Newell 1975; the numbers are those of the usual list of 306 control points, written with its
symmetries: six rings are profiles turned about the axis, handle and spout are mirrored in their
middle plane.
"""

from math import comb

import numpy as np

from prtbake_workers.arrays import B8, F64, I64
from prtbake_workers.geometry.grouping import group_rows
from prtbake_workers.geometry.mesh import Mesh, vertex_normals

# profiles of the surfaces of revolution: (radius, height, tangent of the quarter circle), from the
# top down; the tangent is 0.56 radii (the best circle has 0.5523), 0.45 in one place
_RINGS = (
    ((1.4, 2.4, 0.784), (1.3375, 2.53125, 0.749), (1.4375, 2.53125, 0.805), (1.5, 2.4, 0.84)),
    ((1.5, 2.4, 0.84), (1.75, 1.875, 0.98), (2.0, 1.35, 1.12), (2.0, 0.9, 1.12)),
    ((2.0, 0.9, 1.12), (2.0, 0.45, 1.12), (1.5, 0.225, 0.84), (1.5, 0.15, 0.84)),
    ((1.5, 0.15, 0.84), (1.5, 0.075, 0.84), (1.425, 0.0, 0.798), (0.0, 0.0, 0.0)),
    ((0.0, 3.15, 0.0), (0.8, 3.15, 0.45), (0.0, 2.85, 0.0), (0.2, 2.7, 0.112)),
    ((0.2, 2.7, 0.112), (0.4, 2.55, 0.224), (1.3, 2.55, 0.728), (1.3, 2.4, 0.728)),
)

_FIRST_LID_RING = 4

# tubes, half of each: rows of (inner x, inner height, outer x, outer height, half width)
_HANDLE = (
    ((-1.6, 2.025, -1.5, 2.25, 0.3), (-2.3, 2.025, -2.5, 2.25, 0.3),
     (-2.7, 2.025, -3.0, 2.25, 0.3), (-2.7, 1.8, -3.0, 1.8, 0.3)),
    ((-2.7, 1.8, -3.0, 1.8, 0.3), (-2.7, 1.575, -3.0, 1.35, 0.3),
     (-2.5, 1.125, -2.65, 0.9375, 0.3), (-2.0, 0.9, -1.9, 0.6, 0.3)),
)  # fmt: skip
_SPOUT = (
    ((1.7, 1.425, 1.7, 0.6, 0.66), (2.6, 1.425, 3.1, 0.825, 0.66),
     (2.3, 2.1, 2.4, 2.025, 0.25), (2.7, 2.4, 3.3, 2.4, 0.25)),
    ((2.7, 2.4, 3.3, 2.4, 0.25), (2.8, 2.475, 3.525, 2.49375, 0.25),
     (2.9, 2.475, 3.45, 2.5125, 0.15), (2.8, 2.4, 3.2, 2.4, 0.15)),
)  # fmt: skip

_DECIMALS = 100_000
"""Every coordinate is a whole number of 1e-5."""

MAX_TESSELLATION = 64
"""The largest for which the exact coordinates fit in 64 bits."""


def teapot(tessellation: int) -> Mesh:
    """Make the teapot with ``tessellation`` quads along each side of a patch, cut into triangles.

    Returns
    -------
    Mesh
        y up, standing on y = 0, spout along +x, 6.43 x 3.15 x 4 units; the surface of revolution,
        the lid, the handle and the spout are not joined, as in the original (handle and spout
        pierce the body).  Each of the four is a group of faces.  No triangle is degenerate, and all
        face outwards.

    Notes
    -----
    The patches are evaluated in integers, so the points of two patches along their seam are equal
    to the last bit and can be welded by equality.  At the poles of knob and bottom a side of the
    patch is one point; the triangles that collapse there are left out.  Handle and spout have at
    least two quads a side.  Normals are those of the patches, from their derivatives.
    """
    if not 1 <= tessellation <= MAX_TESSELLATION:
        raise ValueError(f"tessellation must lie in 1..{MAX_TESSELLATION}, not {tessellation}")
    revolved = [patch for ring in _RINGS for patch in _revolve(ring)]
    handle, spout = (
        [patch for rows in tube for patch in _mirror(rows)] for tube in (_HANDLE, _SPOUT)
    )
    # half a tube that is one quad across would be flat
    across = max(tessellation, 2)
    parts: list[Mesh] = []
    groups: list[B8 | I64] = []
    # welding stops at these three: the handle touches the body in one point
    for patches, cells in ((revolved, tessellation), (handle, across), (spout, across)):
        points, sums, triangles, patch = _weld([_evaluate(patch, cells) for patch in patches])
        parts.append(_with_normals(points, sums, triangles))
        # four patches a ring, body and lid; then two tubes
        own = patch // 4 >= _FIRST_LID_RING
        groups.append(own if patches is revolved else np.full(len(patch), len(groups) + 1))
    starts = np.cumsum([0] + [part.n_vertices for part in parts[:-1]])
    return Mesh(
        positions=np.concatenate([part.positions for part in parts]),
        faces=np.concatenate(
            [part.faces + start for part, start in zip(parts, starts, strict=True)]
        ).astype(np.int32),
        normals=np.concatenate([part.normals for part in parts]),
        face_groups=np.concatenate(groups).astype(np.int32),
        group_names=("body", "lid", "handle", "spout"),
    )


def control_points() -> F64:
    """Give the control points of the 32 patches, (patches, 4, 4, 3), y up."""
    patches = [patch for ring in _RINGS for patch in _revolve(ring)]
    patches += [patch for rows in (*_HANDLE, *_SPOUT) for patch in _mirror(rows)]
    return np.stack(patches)


def _revolve(profile: tuple[tuple[float, float, float], ...]) -> list[F64]:
    """Make four patches of a surface of revolution: profile downwards, then counter-clockwise."""
    radius, height, tangent = np.array(profile).T
    zero = np.zeros(4)
    patches = []
    # cosine and sine of the quarter's start
    for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        columns = [
            np.stack([u * c - v * s, height, -(u * s + v * c)], axis=1)
            for u, v in ((radius, zero), (radius, tangent), (tangent, radius), (zero, radius))
        ]
        patches.append(np.stack(columns, axis=1))
    return patches


def _mirror(rows: tuple[tuple[float, ...], ...]) -> list[F64]:
    """Make both halves of a tube, each with its outside up."""
    half = np.array(
        [
            [(xi, hi, 0.0), (xi, hi, width), (xo, ho, width), (xo, ho, 0.0)]
            for xi, hi, xo, ho, width in rows
        ]
    )
    # the order of the columns decides which side is outside
    return [half[:, ::-1], half * [1.0, 1.0, -1.0]]


def _evaluate(control: F64, tessellation: int) -> tuple[F64, F64]:
    """Compute points and unit normals of a patch on a regular grid, (t + 1, t + 1, 3) each.

    The points are exact and rounded once.  The normal is 0 where the patch collapses.
    """
    t = tessellation
    steps = np.arange(t + 1, dtype=np.int64)
    cubic, quadratic = (
        np.stack([comb(n, i) * steps**i * (t - steps) ** (n - i) for i in range(n + 1)], 1)
        for n in (3, 2)
    )
    whole = np.rint(control * _DECIMALS).astype(np.int64)
    exact = np.einsum("si,tj,ijx->stx", cubic, cubic, whole)
    along = np.einsum("si,tj,ijx->stx", quadratic, cubic, np.diff(whole, axis=0))
    across = np.einsum("si,tj,ijx->stx", cubic, quadratic, np.diff(whole, axis=1))
    normals = np.cross(along.astype(np.float64), across.astype(np.float64))
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    normals /= np.where(lengths > 0.0, lengths, 1.0)
    return exact / float(_DECIMALS * t**6), normals


def _weld(grids: list[tuple[F64, F64]]) -> tuple[F64, F64, I64, I64]:
    """Join the grids at equal points: points, sums of normals, two triangles a cell, their grids.

    Triangles that collapse are left out.
    """
    n = len(grids[0][0])
    points = np.concatenate([grid.reshape(-1, 3) for grid, _ in grids])
    normals = np.concatenate([normal.reshape(-1, 3) for _, normal in grids])
    vertex, first = group_rows(points)
    sums = np.zeros((len(first), 3))
    np.add.at(sums, vertex, normals)
    index = vertex.reshape(len(grids), n, n)
    a, b = index[:, :-1, :-1].ravel(), index[:, 1:, :-1].ravel()
    c, d = index[:, 1:, 1:].ravel(), index[:, :-1, 1:].ravel()
    triangles = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], axis=1).reshape(-1, 3)
    collapsed = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    grid_of = np.repeat(np.arange(len(grids)), 2 * (n - 1) ** 2)
    return points[first], sums, triangles[~collapsed], grid_of[~collapsed]


def _with_normals(points: F64, sums: F64, triangles: I64) -> Mesh:
    """Take the mean normal of the patches at each point.

    At the poles, and where triangles are so coarse that they lie 60 degrees off the surface (the
    rim, below tessellation 4), that of the triangles.
    """
    normals = vertex_normals(points, triangles)
    lengths = np.linalg.norm(sums, axis=1)
    close = np.einsum("ij,ij->i", normals, sums) > 0.5 * lengths
    normals[close] = sums[close] / lengths[close, None]
    return Mesh(points, triangles.astype(np.int32), normals)
