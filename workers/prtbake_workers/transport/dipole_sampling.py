"""Where light entered a part that leaves it at given points: samples for the path tracer.

The integral of F R_d(|x - y|) over the part is estimated from one y a point, drawn by a mixture:

- along a line through the part that passes x at a distance drawn by R_d, parallel to the normal or
  to one of two tangents of x, [King2013]_; one of the line's N intersections is taken, N times;
- uniformly over the area, where lines seldom come: far away, and where R_d does not fall.

Each intersection of a line of axis a has the density p(r) |n_y . a|, r its distance from the axis
through x.  With the balance heuristic the weight is ``N F R_d / (sum over axes + uniform)``,
whichever of them drew y: bounded, since r is at most |x - y| and one of three axes is steep to any
triangle.
"""

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.mesh import face_area_vectors
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.surface import interpolate_surface

LINE_SHARE = 0.8
"""Of the samples that are drawn along lines."""

AXIS_SHARES = (0.2, 0.2, 0.6)
"""Of the lines along tangent, bitangent and normal."""

N_RADII = 256
FINEST_RADIUS = 0.02
"""Of the table of distances, in mean free paths; R_d is constant within."""

MOST_INTERSECTIONS = 256
"""Of a line."""

LOCAL_PATH = 1e-5
"""Mean free path, over the size of the part, below which light leaves where it falls: float32 rays
resolve no less."""


class DipoleSampler:
    """Moves points of one part to where their light entered.

    Parameters
    ----------
    scene
        All parts.
    part
        Which scatters: light passes inside one body.
    dipole
        Of its medium, in units of the scene.
    """

    def __init__(self, scene: Scene, part: int, dipole: Dipole) -> None:
        self.scene, self.dipole = scene, dipole
        self._triangles = np.flatnonzero(scene.part_of_face == part)
        own = scene.part(part)
        across = face_area_vectors(own.positions, own.faces)
        areas = np.linalg.norm(across, axis=1)
        self._normals = across / np.where(areas > 0.0, areas, 1.0)[:, None]
        self._area = float(areas.sum())
        self._up_to = np.cumsum(areas) / self._area
        self._size = own.diagonal
        self._epsilon = ray_epsilon(own.bounds)
        self._accelerator = Accelerator(own.positions, own.faces, robust=True)
        self._radii, self._mass = _radial_table(dipole, 1.001 * self._size)

    def enter(
        self, at: PathPoints, u: Float64[F64, "points 5"]
    ) -> tuple[PathPoints, Float64[F64, "points 3"]]:
        """Draw where the light of points entered.

        Parameters
        ----------
        at
            Points of the part.
        u
            Uniform numbers in [0, 1): two for the place, one to choose how, two more for the place.

        Returns
        -------
        points, weights
            Seen along their normals, where all light is gathered that a Lambert BRDF of albedo 1
            sends; and what that is multiplied by, in expectation over y the operator S of
            `subsurface`.  0 where a line met nothing.
        """
        if float(self.dipole.mean_free_path.max()) < LOCAL_PATH * self._size:
            albedo = np.broadcast_to(self.dipole.diffuse_albedo, 3)
            return self._seen(at.triangles, at.barycentrics), np.tile(albedo, (len(at), 1))
        frames = tangent_frames(at.surface.side)
        triangles, barycentrics, count = self._uniform(u)
        lined = np.flatnonzero(u[:, 2] < LINE_SHARE)
        found = self._along_lines(at.surface.positions[lined], frames[lined], u[lined])
        triangles[lined], barycentrics[lined], count[lined] = found
        points = self._seen(self._triangles[triangles], barycentrics)
        away = points.surface.positions - at.surface.positions
        profile = self.dipole.entering_transmittance * self.dipole.profile(
            np.linalg.norm(away, axis=1)
        )
        density = LINE_SHARE * self._line_density(away, frames, self._normals[triangles])
        density += (1.0 - LINE_SHARE) / self._area
        return points, np.broadcast_to((profile * count / density).T, (len(at), 3)).copy()

    def _seen(self, triangles: I64, barycentrics: F64) -> PathPoints:
        side = interpolate_surface(self.scene, triangles, barycentrics).side
        one_sided = np.zeros(len(triangles), np.bool_)
        return PathPoints.seen(self.scene, triangles, barycentrics, side, one_sided)[0]

    def _uniform(self, u: F64) -> tuple[I64, F64, F64]:
        """Draw by area: triangles of the part, barycentrics, and one intersection each."""
        triangles = np.searchsorted(self._up_to, u[:, 0], side="right")
        triangles = np.minimum(triangles, len(self._up_to) - 1)
        root = np.sqrt(u[:, 3])
        barycentrics = np.stack([1.0 - root, root * (1.0 - u[:, 4]), root * u[:, 4]], axis=1)
        return triangles, barycentrics, np.ones(len(u))

    def _along_lines(
        self, positions: Float64[F64, "points 3"], frames: Float64[F64, "points 3 3"], u: F64
    ) -> tuple[Int64[I64, " points"], Float64[F64, "points 3"], Float64[F64, " points"]]:
        """Take one of all intersections of a line a point; the count is 0 where there is none."""
        rows = np.arange(len(u))
        axis = np.searchsorted(np.cumsum(AXIS_SHARES), u[:, 2] / LINE_SHARE, side="right")
        axis = np.minimum(axis, 2)
        along, first, second = (frames[rows, (axis + turn) % 3] for turn in range(3))
        radius = self._radius(u[:, 0])
        angle = 2.0 * np.pi * u[:, 1]
        across = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
        origins = positions + radius[:, None] * across - 1.01 * self._size * along
        triangles, count = np.zeros(len(u), np.int64), np.zeros(len(u))
        barycentrics = np.full((len(u), 3), 1.0 / 3.0)
        last, choice = np.full(len(u), -1), u[:, 3].copy()
        for _ in range(MOST_INTERSECTIONS):
            hits = self._accelerator.intersect(
                origins[rows].astype(np.float32), along[rows].astype(np.float32)
            )
            hit = np.flatnonzero(hits.triangles >= 0)
            if len(hit) == 0:
                break
            rows, met = rows[hit], hits.triangles[hit].astype(np.int64)
            origins[rows] += (hits.distance[hit] + self._epsilon)[:, None] * along[rows]
            # a plane is met once: grazing rays meet theirs again beyond the offset
            new = met != last[rows]
            last[rows] = met
            count[rows[new]] += 1.0
            # a reservoir of one, by one number: what is left of it after a choice is uniform again
            share = 1.0 / np.maximum(count[rows], 1.0)
            taken = new & (choice[rows] < share)
            kept = new & ~taken
            choice[rows[taken]] /= share[taken]
            choice[rows[kept]] = (choice[rows[kept]] - share[kept]) / (1.0 - share[kept])
            triangles[rows[taken]] = met[taken]
            weights = np.maximum(hits.barycentrics[hit[taken]].astype(np.float64), 0.0)
            barycentrics[rows[taken]] = weights / weights.sum(axis=1, keepdims=True)
        return triangles, barycentrics, count

    def _radius(self, u: Float64[F64, " points"]) -> Float64[F64, " points"]:
        """Invert the table: uniform in the area of a ring."""
        up_to = np.concatenate([[0.0], np.cumsum(self._mass)])
        ring = np.searchsorted(up_to, u * up_to[-1], side="right") - 1
        ring = np.minimum(ring, len(self._mass) - 1)
        share = (u * up_to[-1] - up_to[ring]) / np.where(self._mass > 0.0, self._mass, 1.0)[ring]
        low, high = self._radii[ring] ** 2, self._radii[ring + 1] ** 2
        return np.asarray(np.sqrt(low + np.clip(share, 0.0, 1.0) * (high - low)))

    def _line_density(
        self,
        away: Float64[F64, "points 3"],
        frames: Float64[F64, "points 3 3"],
        normals: Float64[F64, "points 3"],
    ) -> Float64[F64, " points"]:
        """Give the intersections to be expected in a unit of area, over all axes."""
        rings = np.pi * np.diff(self._radii**2)
        density = self._mass / self._mass.sum() / rings
        total = np.zeros(len(away))
        squared = np.einsum("pi,pi->p", away, away)
        for axis, share in enumerate(AXIS_SHARES):
            along = np.einsum("pi,pi->p", away, frames[:, axis])
            radius = np.sqrt(np.maximum(squared - along * along, 0.0))
            ring = np.searchsorted(self._radii, radius, side="right") - 1
            within = ring < len(density)
            steep = np.abs(np.einsum("pi,pi->p", normals, frames[:, axis]))
            total += (
                share * steep * np.where(within, density[np.minimum(ring, len(density) - 1)], 0)
            )
        return total


def _radial_table(
    dipole: Dipole, furthest: float
) -> tuple[Float64[F64, " edges"], Float64[F64, " rings"]]:
    """Cut the plane into rings and give the share of R_d in each, the mean over channels."""
    finest = FINEST_RADIUS * float(dipole.mean_free_path.min())
    radii = np.geomspace(min(finest, 0.01 * furthest), furthest, N_RADII)
    radii = np.concatenate([[0.0], radii])
    within = dipole.disc_reflectance(radii)
    lit = within[within[:, -1] > 0.0]
    if len(lit) == 0:
        return radii, np.diff(radii**2)
    return radii, np.maximum(np.diff(lit, axis=1) / lit[:, -1:], 0.0).mean(axis=0)
