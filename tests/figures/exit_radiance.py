"""Exit radiance of points under every light of 25 coefficients: by transfer matrices, and directly.

Both ways are linear in the light, so each gives an operator a point: a row a view, a column a
coefficient of the light.  They share nothing but the scene: the matrices come from shadow rays in
the directions of a cube map and a BRDF matrix over both hemispheres; the reference integrates BRDF
x visibility x light x cosine over a product rule of its own about each normal.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from prtbake_workers.basis.sh import eval_sh
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.transport.visibility import padded_directions, visible_fraction


@dataclass(frozen=True)
class Points:
    """Where radiance leaves: ray origins (float32), frames, and the area that each stands for."""

    origins: np.ndarray
    frames: np.ndarray
    areas: np.ndarray

    def __len__(self):
        return len(self.origins)

    def blocks(self, size):
        """Cut into runs of at most ``size`` points."""
        for start in range(0, len(self), size):
            which = slice(start, start + size)
            yield Points(self.origins[which], self.frames[which], self.areas[which])


def vertex_points(scene, vertices):
    """Give vertices of a scene as points, their rays starting where those of a bake do."""
    origins = offset_origins(
        scene.ray_points[vertices], scene.ray_sides[vertices], ray_epsilon(scene.bounds)
    )
    return Points(origins, scene.frames[vertices], scene.areas[vertices])


def hemisphere_rule(n_rings, n_azimuths, *, turn=0.0, breaks=(0.0, 1.0)):
    """Gauss-Legendre in z between the breaks, even in phi.

    Parameters
    ----------
    n_rings
        Rings in each piece.
    n_azimuths
        Points on each ring.
    turn
        First azimuth in steps: two rules of different turns share no direction.
    breaks
        Where pieces begin and end, so that a share of the hemisphere has whole weights.

    Returns
    -------
    tuple of ndarray
        Local directions and solid angles that sum to 2 pi.
    """
    nodes, weights = np.polynomial.legendre.leggauss(n_rings)
    pieces = list(pairwise(breaks))
    z = np.concatenate([a + (b - a) * 0.5 * (nodes + 1.0) for a, b in pieces])
    w = np.concatenate([(b - a) * 0.5 * weights for a, b in pieces])
    phi = 2.0 * np.pi * (np.arange(n_azimuths) + turn) / n_azimuths
    z, phi = np.meshgrid(z, phi, indexing="ij")
    sine = np.sqrt(1.0 - z * z)
    directions = np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=-1).reshape(-1, 3)
    return directions, np.repeat(w * 2.0 * np.pi / n_azimuths, n_azimuths)


def brdf_matrix(brdf, order, n_rings, n_azimuths):
    """Integrate ``B_ij = y_i(v) rho(v, s) s_z y_j(s)`` over both hemispheres, channel 0.

    2 ``order`` azimuths of v are exact for an isotropic BRDF: over s it gives each y_j a function
    of v with the azimuth's own order.  Those of s have to resolve the lobe at grazing angles.
    """
    assert n_azimuths % (2 * order) == 0, "every v must meet the same azimuths of s"
    views, view_weights = hemisphere_rule(n_rings, 2 * order)
    directions, weights = hemisphere_rule(n_rings, n_azimuths, turn=0.5)
    inner = eval_sh(order, directions) * (weights * directions[:, 2])[:, None]
    reflected = np.concatenate(
        [
            brdf.eval_brdf(directions[None], part[:, None])[..., 0] @ inner
            for part in np.array_split(views, n_rings)
        ]
    )
    return (view_weights[:, None] * eval_sh(order, views)).T @ reflected


def transfer(points, accelerator, cube, order, light_order, supersample=1):
    """Trace the shadow rays of T: ``T_kj = sum_w y_k V y_j dw`` over the texels of a cube map."""
    visible = np.empty((len(points), cube.n), np.float32)
    normals = points.frames[:, 2]
    visible_fraction(
        accelerator,
        points.origins,
        normals.astype(np.float32),
        (normals @ cube.directions.T).astype(np.float32),
        padded_directions(cube.sub_directions(supersample)),
        visible,
    )
    values = eval_sh(max(order, light_order), cube.directions)
    light = cube.weights[:, None] * values[:, : light_order**2]
    seen = visible.astype(np.float64)
    rows = [seen @ (values[:, k, None] * light) for k in range(order**2)]
    return np.stack(rows, axis=1)


def incident_light(points, accelerator, rule, light_order):
    """Give V(s) y_j(s), (points, directions, light), in the local directions of a rule."""
    directions, _ = rule
    result = np.empty((len(points), len(directions), light_order**2), np.float32)
    for point, (origin, frame) in enumerate(zip(points.origins, points.frames, strict=True)):
        world = directions @ frame
        blocked = accelerator.occluded_from(origin, world.astype(np.float32))
        result[point] = np.where(blocked[:, None], 0.0, eval_sh(light_order, world))
    return result


def reflection_kernel(brdf, views, rule):
    """Give ``rho(v, s) s_z ds``, (views, directions), channel 0."""
    directions, weights = rule
    rho = brdf.eval_brdf(directions[None], views[:, None])[..., 0]
    return (rho * (weights * directions[:, 2])).astype(np.float32)
