"""Triangulation of planar polygons with few corners."""

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64


def triangulate(
    positions: Float64[F64, "verts 3"],
    corners: Int64[I64, " corners"],
    counts: Int64[I64, " polys"],
) -> tuple[Int64[I64, "tris 3"], Int64[I64, " tris"]]:
    """Cut polygons into triangles of the same winding.

    Parameters
    ----------
    positions
        Vertex positions.
    corners
        Vertex indices of all polygons, one polygon after the other.
    counts
        Number of corners of each, at least 3.

    Returns
    -------
    triangles, polygon
        Places in ``corners`` (so that other indices of the same corners, as those of the
        texture coordinates, can follow), and the polygon each triangle came from; in the order
        of the polygons.

    Notes
    -----
    A convex polygon is cut as a fan about its first corner.  Where a triangle of that fan would
    face backwards the polygon is concave there, and its ears are cut one by one.  A polygon that
    crosses itself has no right answer and is left as the fan.
    """
    starts = np.cumsum(counts) - counts
    triangles = []
    sources = []
    for n in np.unique(counts):
        polygons = np.flatnonzero(counts == n)
        rings = starts[polygons][:, None] + np.arange(n)[None, :]
        fans = np.stack(
            [np.broadcast_to(rings[:, :1], (len(rings), n - 2)), rings[:, 1:-1], rings[:, 2:]],
            axis=2,
        )
        if n > 3:
            points = positions[corners[rings]]
            for row in np.flatnonzero(_fan_is_wrong(points)):
                fans[row] = rings[row][_cut_ears(points[row])]
        triangles.append(fans.reshape(-1, 3))
        sources.append(np.repeat(polygons, n - 2))
    if not triangles:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    order = np.argsort(np.concatenate(sources), kind="stable")
    return np.concatenate(triangles)[order], np.concatenate(sources)[order]


def _newell_normals(points: F64) -> F64:
    """Area vectors of rings (polys, corners, 3) by Newell's sum, for any planar ring."""
    following = np.roll(points, -1, axis=1)
    sums: F64 = 0.5 * np.cross(points, following).sum(axis=1)
    return sums


def _fan_is_wrong(points: F64) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether some triangle of the fan about corner 0 faces backwards."""
    centred = points - points.mean(axis=1, keepdims=True)
    normals = _newell_normals(centred)
    spokes = centred[:, 1:] - centred[:, :1]
    facing = np.einsum("pci,pi->pc", np.cross(spokes[:, :-1], spokes[:, 1:]), normals)
    # a corner on a straight line gives rounding noise of either sign: not concave
    wrong: np.ndarray[tuple[int], np.dtype[np.bool_]] = np.any(
        facing < -1e-9 * np.einsum("pi,pi->p", normals, normals)[:, None], axis=1
    )
    return wrong


def _cut_ears(points: F64) -> I64:
    """Ear clipping in the plane of the polygon: (corners - 2, 3) places on the ring."""
    normal = _newell_normals((points - points.mean(axis=0))[None])[0]
    drop = int(np.argmax(np.abs(normal)))
    flat = np.delete(points, drop, axis=1)
    # deleting y mirrors the plane; so does looking at it from behind
    sign = np.sign(normal[drop]) * (-1.0 if drop == 1 else 1.0)

    def turn(a: int, b: int, c: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = flat[a], flat[b], flat[c]
        return float(sign * ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)))

    ring = list(range(len(points)))
    triangles = []
    while len(ring) > 3:
        for place in range(len(ring)):
            a, b, c = ring[place - 1], ring[place], ring[(place + 1) % len(ring)]
            if turn(a, b, c) <= 0.0:
                continue
            inside = any(
                turn(a, b, p) >= 0.0 and turn(b, c, p) >= 0.0 and turn(c, a, p) >= 0.0
                for p in ring
                if p not in (a, b, c)
            )
            if not inside:
                break
        else:
            # no ear: the ring touches or crosses itself; go on with a fan of what is left
            place, (a, b, c) = 1, ring[:3]
        triangles.append((a, b, c))
        del ring[place]
    triangles.append((ring[0], ring[1], ring[2]))
    return np.array(triangles, np.int64)
