"""The plain twin of the accelerator: every ray against every triangle, in float64."""

import numpy as np

from prtbake_workers.arrays import B8, F32, F64, I32, Bool, Float32, Float64, Int32
from prtbake_workers.geometry.accelerator import Hits

_TRIANGLES_TIMES_RAYS = 1 << 22


class BruteForce:
    """Answers the queries of `Accelerator` with the test of Möller and Trumbore (1997).

    For tests on small scenes: it takes time and memory in proportion to rays times triangles.
    """

    def __init__(self, positions: Float64[F64, "verts 3"], faces: Int32[I32, "tris 3"]) -> None:
        self._corner, b, c = np.moveaxis(positions[faces], 1, 0)
        self._edge_1, self._edge_2 = b - self._corner, c - self._corner

    def occluded(
        self,
        origins: Float32[F32, "rays 3"],
        directions: Float32[F32, "rays 3"],
    ) -> Bool[B8, " rays"]:
        """Tell which rays hit something."""
        return self.intersect(origins, directions).triangles >= 0

    def intersect(
        self, origins: Float32[F32, "rays 3"], directions: Float32[F32, "rays 3"]
    ) -> Hits:
        """Find the first triangle along each ray; of equal distances the lowest index."""
        n = len(origins)
        hits = Hits(
            np.full(n, -1, np.int32), np.zeros((n, 3), np.float32), np.full(n, np.inf, np.float32)
        )  # fmt: skip
        step = max(1, _TRIANGLES_TIMES_RAYS // max(len(self._corner), 1))
        for start in range(0, n, step):
            block = slice(start, start + step)
            distance, u, v = self._meet(
                origins[block].astype(np.float64), directions[block].astype(np.float64)
            )
            nearest = np.argmin(distance, axis=1)
            row = np.arange(len(nearest))
            hit = np.isfinite(distance[row, nearest])
            hits.triangles[block] = np.where(hit, nearest, -1)
            hits.distance[block] = distance[row, nearest]
            u, v = u[row, nearest], v[row, nearest]
            weights = np.stack([1.0 - u - v, u, v], axis=1)
            hits.barycentrics[block] = np.where(hit[:, None], weights, 0.0)
        return hits

    def _meet(self, origins: F64, directions: F64) -> tuple[F64, F64, F64]:
        """Distance (rays, tris), infinite where the ray passes by, and barycentrics u, v."""
        p = np.cross(directions[:, None], self._edge_2[None])
        determinant = np.einsum("ti,rti->rt", self._edge_1, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / determinant
            away = origins[:, None] - self._corner[None]
            u = np.einsum("rti,rti->rt", away, p) * inverse
            q = np.cross(away, self._edge_1[None])
            v = np.einsum("ri,rti->rt", directions, q) * inverse
            distance = np.einsum("ti,rti->rt", self._edge_2, q) * inverse
            inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance >= 0.0)
        return np.where(inside & (determinant != 0.0), distance, np.inf), u, v
