"""Scenes whose interreflection is known, and the closed forms and quadratures that know it."""

import numpy as np

from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere, icosphere_faces
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import grid_mesh
from prtbake_workers.transport.surface import OpaqueSurface


def opaque(scene):
    """The scene ready for rays, with closed rooms closed."""
    return OpaqueSurface(scene, Accelerator(scene.positions, scene.traced_faces, robust=True))


def patch(corner, edge_u, edge_v, n_u, n_v):
    """A rectangle of n_u x n_v cells whose normal is edge_u x edge_v."""
    corner, edge_u, edge_v = (np.asarray(v, np.float64) for v in (corner, edge_u, edge_v))
    grid = grid_mesh(n_u, n_v)
    # the grid's x runs along u; its z runs against v, since x cross -z is up
    u, v = grid.positions[:, 0] + 0.5, 0.5 - grid.positions[:, 2]
    normal = np.cross(edge_u, edge_v)
    normal /= np.linalg.norm(normal)
    positions = corner + u[:, None] * edge_u + v[:, None] * edge_v
    return Mesh(positions, grid.faces, np.tile(normal, (len(u), 1)), grid.uv)


def disc(radius, height, n_rings, n_sectors, *, up):
    """A disc about the y axis; its rim is moved out so that the polygon has the disc's area."""
    angles = 2.0 * np.pi * np.arange(n_sectors) / n_sectors
    radii = radius * np.arange(1, n_rings + 1) / n_rings
    radii *= np.sqrt(np.pi / (0.5 * n_sectors * np.sin(2.0 * np.pi / n_sectors)))
    ring = np.stack([np.cos(angles), np.zeros(n_sectors), -np.sin(angles)], axis=1)
    positions = np.concatenate([[np.zeros(3)], (radii[:, None, None] * ring).reshape(-1, 3)])
    return _about_axis(
        positions + np.array([0.0, height, 0.0]), n_rings, n_sectors, 1.0 if up else -1.0
    )


def bowl(n_rings, n_sectors, *, depth_rad=0.5 * np.pi):
    """The lower part of the unit sphere seen from inside, open at the top."""
    angles = 2.0 * np.pi * np.arange(n_sectors) / n_sectors
    polar = depth_rad * np.arange(1, n_rings + 1) / n_rings
    sine, cosine = np.sin(polar)[:, None], np.cos(polar)[:, None]
    rings = np.stack(
        [
            sine * np.cos(angles),
            np.broadcast_to(-cosine, (n_rings, n_sectors)),
            -sine * np.sin(angles),
        ],
        axis=-1,
    )
    positions = np.concatenate([[[0.0, -1.0, 0.0]], rings.reshape(-1, 3)])
    flat = _about_axis(positions, n_rings, n_sectors, 1.0)
    return Mesh(positions, flat.faces, -positions)


def _about_axis(positions, n_rings, n_sectors, sign):
    """Join a centre and rings, counter-clockwise seen from +y where the sign is positive."""
    here = np.arange(n_sectors)
    after = (here + 1) % n_sectors
    faces = [np.stack([np.zeros_like(here), 1 + here, 1 + after], axis=1)]
    for ring in range(n_rings - 1):
        inner, outer = 1 + ring * n_sectors, 1 + (ring + 1) * n_sectors
        faces += [
            np.stack([inner + here, outer + here, outer + after], axis=1),
            np.stack([inner + here, outer + after, inner + after], axis=1),
        ]
    faces = np.concatenate(faces).astype(np.int32)
    if sign < 0.0:
        faces = faces[:, ::-1].copy()
    return Mesh(positions, faces, np.tile([0.0, sign, 0.0], (len(positions), 1)))


def ball(subdivisions, centre=(0.0, 0.0, 0.0), radius=1.0, *, inward=False):
    """An icosphere, or its inside."""
    normals, faces = icosphere(subdivisions), icosphere_faces(subdivisions)
    positions = radius * normals + np.asarray(centre)
    if inward:
        return Mesh(positions, faces[:, ::-1].copy(), -normals)
    return Mesh(positions, faces, normals)


def turned_inside_out(mesh):
    """The same surface with its winding and its normals turned over."""
    return Mesh(mesh.positions, mesh.faces[:, ::-1].copy(), -mesh.normals, mesh.uv)


def point_to_disc(offset, height, radius):
    """Form factor of a point facing a parallel disc, ``offset`` off its axis.

    Contour integral; Howell, A Catalog of Radiation Heat Transfer Configuration Factors, B-13.
    """
    h2, r2 = (height / radius) ** 2, (np.asarray(offset) / radius) ** 2
    z = 1.0 + h2 + r2
    return 0.5 * (1.0 - (z - 2.0) / np.sqrt(z * z - 4.0 * r2))


def disc_to_disc(height, radius):
    """Form factor between equal parallel coaxial discs; Howell, C-41."""
    x = 2.0 + (height / radius) ** 2
    return 0.5 * (x - np.sqrt(x * x - 4.0))


def point_to_wall(distance, height, half_width):
    """Form factor of a floor point facing a perpendicular wall that stands on the floor.

    The point lies ``distance`` before the middle of the wall; twice Howell, B-3.
    """
    x, y = height / half_width, np.asarray(distance) / half_width
    reach = np.sqrt(x * x + y * y)
    return (np.arctan(1.0 / y) - y / reach * np.arctan(1.0 / reach)) / np.pi


def discs_by_quadrature(height, albedo, n_bounces, n_nodes=60):
    """Bounces between two equal coaxial discs of radius 1 under light of radiance 1 all around.

    The kernel between a point at radius a and the ring at radius r is, integrated over the ring,
    ``2 h^2 A r / (A^2 - B^2)^(3/2)`` with A = h^2 + a^2 + r^2 and B = 2 a r, so that each bounce
    is a smooth integral over r, done by Gauss and Legendre.  Returns the nodes and the radiosity
    over the albedo after every bounce, (n_bounces + 1, nodes).
    """
    node, weight = np.polynomial.legendre.leggauss(n_nodes)
    r, weight = 0.5 * (node + 1.0), 0.5 * weight
    a = r[:, None]
    big, small = height**2 + a**2 + r**2, 2.0 * a * r
    kernel = 2.0 * height**2 * big * r * weight / (big**2 - small**2) ** 1.5
    direct = 1.0 - point_to_disc(r, height, 1.0)
    states = [direct]
    for _ in range(n_bounces):
        states.append(direct + albedo * kernel @ states[-1])
    return r, np.array(states)


def ball_lights_plane(offset, sent, n=400):
    """Irradiance over pi that a ball of radius 1 standing on a plane sends to a point of it.

    ``sent(n_y)`` is the radiance that the ball sends from where its normal has height n_y.
    Midpoint rule over the cone of directions that meet the ball.
    """
    centre = np.array([-offset, 1.0, 0.0])
    distance = np.linalg.norm(centre)
    axis = centre / distance
    least = np.sqrt(1.0 - 1.0 / distance**2)
    cosine = least + (1.0 - least) * (np.arange(n) + 0.5) / n
    azimuth = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    cosine, azimuth = (grid.ravel() for grid in np.meshgrid(cosine, azimuth))
    side = np.array([axis[1], -axis[0], 0.0])
    up = np.cross(axis, side)
    sine = np.sqrt(1.0 - cosine**2)
    directions = (
        cosine[:, None] * axis
        + (sine * np.cos(azimuth))[:, None] * side
        + (sine * np.sin(azimuth))[:, None] * up
    )
    along = distance * cosine
    reach = along - np.sqrt(np.maximum(0.0, along**2 - distance**2 + 1.0))
    normal = reach[:, None] * directions - centre
    solid_angle = 2.0 * np.pi * (1.0 - least) / len(cosine)
    return float(
        (sent(normal[:, 1]) * np.maximum(directions[:, 1], 0.0)).sum() * solid_angle / np.pi
    )
