"""The same scene, light, camera, bounces and number of paths in Mitsuba 3 and in the path tracer.

Both are one-sided: a surface is black from behind.  Both pictures are means over the pixels' squares
(box filter), and both come in independent parts that give their variance.
"""

import mitsuba as mi
import numpy as np

from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.path_material import PathMaterial
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import trace_paths
from support.agreement import Picture
from support.bounce_scenes import opaque

mi.set_variant("scalar_rgb")

FINER = 16
"""Mitsuba interpolates the texels that we hold constant: ours are repeated this often, each way."""

N_PARTS = 4
"""Independent pictures that each picture is the mean of."""


def faceted(mesh):
    """The mesh with the normals of its faces."""
    positions = mesh.positions[mesh.faces].reshape(-1, 3)
    a, b, c = positions[::3], positions[1::3], positions[2::3]
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
    return Mesh(positions, faces, np.repeat(normals, 3, axis=0))


def by_mitsuba(meshes, brdfs, light, view, n_bounces, *, n_paths, n_parts=N_PARTS):
    """Render by Mitsuba's path integrator, ``n_paths`` a pixel, ``n_parts`` times a square number.

    Returns the picture and the camera's corner rays.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "emitter": {"type": "envmap", "bitmap": _bitmap(light)},
            # depth 1 is what the camera sees of the light itself, 2 is direct light
            "integrator": {
                "type": "path",
                "max_depth": n_bounces + 2,
                "rr_depth": 1000,
                "hide_emitters": True,
            },
            "sensor": {
                "type": "perspective",
                "fov": view.field_of_view_deg,
                "to_world": mi.ScalarTransform4f().look_at(
                    list(view.eye), list(view.target), [0, 1, 0]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": view.width,
                    "height": view.height,
                    "rfilter": {"type": "box"},
                    "component_format": "float32",
                },
                "sampler": {"type": "multijitter"},
            },
        }
        | {
            f"mesh{index}": _mesh(mesh, _bsdf(brdf))
            for index, (mesh, brdf) in enumerate(zip(meshes, brdfs, strict=True))
        }
    )
    parts = [
        np.array(mi.render(scene, spp=n_paths // n_parts, seed=seed))[..., :3]
        for seed in range(n_parts)
    ]
    return Picture(np.asarray(parts, np.float64)), _corner_rays(scene.sensors()[0], view)


def by_paths(meshes, brdfs, light, view, n_bounces, corners, *, n_paths, per_side):
    """Render by the path tracer, ``n_paths`` a pixel, shared by jittered cells of it.

    Each part of the picture has ``per_side`` x ``per_side`` of them.  Returns the picture, and the
    mean of the same paths without their last bounce.
    """
    scene = Scene.from_parts(meshes)
    surface, rng = opaque(scene), np.random.default_rng(7)
    materials = [PathMaterial(brdf) for brdf in brdfs]
    size, n_cells = (view.height, view.width), per_side**2
    rows, columns = (grid.ravel() for grid in np.indices(size))
    origin, across, down = corners
    eyes = np.tile(np.asarray(view.eye, np.float32), (len(rows), 1))
    parts, last = np.zeros((N_PARTS, len(rows), 3)), np.zeros((len(rows), 3))
    for index in range(N_PARTS * n_cells):
        part, cell = divmod(index, n_cells)
        u = (columns + (cell % per_side + rng.random(len(rows))) / per_side) / view.width
        v = (rows + (cell // per_side + rng.random(len(rows))) / per_side) / view.height
        rays = origin + u[:, None] * across + v[:, None] * down
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        hits = surface.intersect(eyes, rays.astype(np.float32))
        points, front = PathPoints.seen(
            scene, hits.triangles, hits.barycentrics, -rays[hits.rays],
            np.zeros(len(hits.rays), np.bool_),
        )  # fmt: skip
        found = trace_paths(
            surface, materials, points.pick(front), light, np.eye(3), n_bounces=n_bounces,
            n_passes=1, n_samples=n_paths // (N_PARTS * n_cells), seed=index,
        )  # fmt: skip
        seen = hits.rays[front]
        parts[part, seen] += found.mean / n_cells
        last[seen] += found.by_bounce[-1] / (N_PARTS * n_cells)
    parts = parts.reshape(N_PARTS, *size, 3)
    return Picture(parts), Picture(parts - last.reshape(*size, 3))


def _bitmap(light):
    """Our texels for Mitsuba, whose first and last rows lie on the poles, not beside them."""
    fine = np.repeat(light.radiance, FINER, axis=0)
    # a row on the edge between two texels is their mean
    rows = 0.5 * (np.concatenate([fine[:1], fine]) + np.concatenate([fine, fine[-1:]]))
    both = np.repeat(rows, FINER, axis=1)
    # Mitsuba's u has its zero at -z, ours half a turn away
    return mi.Bitmap(np.ascontiguousarray(np.roll(both, both.shape[1] // 2, axis=1)))


def _bsdf(brdf):
    def rgb(values):
        return {"type": "rgb", "value": np.broadcast_to(values, 3).tolist()}

    if isinstance(brdf, Lambert):
        return {"type": "diffuse", "reflectance": rgb(brdf.albedo)}
    return {
        "type": "blendbsdf",
        "weight": brdf.ks,
        "diffuse": {"type": "diffuse", "reflectance": rgb(brdf.kd / (1.0 - brdf.ks))},
        "metal": {
            "type": "roughconductor",
            "distribution": "ggx",
            "alpha": brdf.alpha,
            "material": "none",
        },
    }


def _mesh(mesh, bsdf):
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    result = mi.Mesh(
        "mesh", mesh.n_vertices, mesh.n_faces, has_vertex_normals=True, props=properties
    )
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = mesh.positions.astype(np.float32).ravel()
    parameters["vertex_normals"] = mesh.normals.astype(np.float32).ravel()
    parameters["faces"] = mesh.faces.astype(np.uint32).ravel()
    parameters.update()
    return result


def _corner_rays(sensor, view):
    """The ray through (0, 0) of the picture, and how it changes to the right and downwards."""
    forward = np.asarray(view.target, np.float64) - np.asarray(view.eye)

    def through(u, v):
        ray, _ = sensor.sample_ray(0.0, 0.0, mi.ScalarPoint2f(u, v), mi.ScalarPoint2f(0.5))
        direction = np.array(ray.d, np.float64)
        return direction / (direction @ forward)

    origin = through(0.0, 0.0)
    return origin, through(1.0, 0.0) - origin, through(0.0, 1.0) - origin
