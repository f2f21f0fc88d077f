"""The same scene, light, camera and number of bounces in Mitsuba 3 and in the path tracer.

Both are one-sided: a surface is black from behind.  Both pictures are means over the pixels' squares
(box filter), and both come in independent parts that give their variance.
"""

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from prtbake_workers.brdf.base import above_horizon, clamped_cosines, half_vector
from prtbake_workers.brdf.ggx import smith_g1, trowbridge_reitz
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import PathMaterial, trace_paths
from support.bounce_scenes import opaque

mi.set_variant("scalar_rgb")

FINER = 8
"""Mitsuba interpolates the texels that we hold constant: ours are repeated this often, each way."""


@dataclass(frozen=True, eq=False)
class DiffuseAndMetal:
    """``kd / pi + ks D G1 G1 / (4 cos cos)``: Mitsuba's blend of diffuse and a perfect conductor."""

    kd: Any
    ks: float
    alpha: float

    @property
    def n_channels(self):
        return len(self.kd)

    def eval_brdf(self, wi, wo):
        half = half_vector(wi, wo)
        cos_i, cos_o = clamped_cosines(wi, wo)
        shadows = smith_g1(cos_i, self.alpha) * smith_g1(cos_o, self.alpha)
        lobe = trowbridge_reitz(half.cos_h, half.sin2_h, self.alpha) * shadows
        value = self.kd / np.pi + (self.ks * lobe / (4.0 * cos_i * cos_o))[..., None]
        return np.where(above_horizon(wi, wo)[..., None], value, 0.0)


@dataclass(frozen=True)
class View:
    eye: Any
    target: Any
    field_of_view_deg: float
    width: int = 32
    height: int = 24


@dataclass(frozen=True)
class Picture:
    """Mean and variance of the mean, (height, width, 3)."""

    mean: Any
    variance: Any

    @classmethod
    def of(cls, parts):
        parts = np.asarray(parts, np.float64)
        return cls(parts.mean(axis=0), parts.var(axis=0, ddof=1) / len(parts))


def faceted(mesh):
    """The mesh with the normals of its faces."""
    positions = mesh.positions[mesh.faces].reshape(-1, 3)
    a, b, c = positions[::3], positions[1::3], positions[2::3]
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
    return Mesh(positions, faces, np.repeat(normals, 3, axis=0))


def by_mitsuba(meshes, brdfs, light, view, n_bounces, *, n_samples, n_parts=4):
    """Render by Mitsuba's path integrator; returns the picture and the camera's ray function."""
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
                "sampler": {"type": "independent"},
            },
        }
        | {
            f"mesh{index}": _mesh(mesh, _bsdf(brdf))
            for index, (mesh, brdf) in enumerate(zip(meshes, brdfs, strict=True))
        }
    )
    parts = [
        np.array(mi.render(scene, spp=n_samples // n_parts, seed=seed))[..., :3]
        for seed in range(n_parts)
    ]
    return Picture.of(parts), _corner_rays(scene.sensors()[0], view)


def by_paths(meshes, brdfs, light, view, n_bounces, corners, *, n_rays, n_samples):
    """Render by the path tracer: ``n_rays`` through each pixel, ``n_samples`` paths each."""
    scene = Scene.from_parts(meshes)
    surface, rng = opaque(scene), np.random.default_rng(7)
    materials = [PathMaterial(brdf) for brdf in brdfs]
    n_pixels = view.width * view.height
    origin, across, down = corners
    parts = np.zeros((n_rays, n_pixels, 3))
    for index in range(n_rays):
        u = (np.tile(np.arange(view.width), view.height) + rng.random(n_pixels)) / view.width
        v = (np.repeat(np.arange(view.height), view.width) + rng.random(n_pixels)) / view.height
        rays = origin + u[:, None] * across + v[:, None] * down
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        hits = surface.intersect(
            np.tile(np.asarray(view.eye, np.float32), (n_pixels, 1)), rays.astype(np.float32)
        )
        points, front = PathPoints.seen(
            scene, hits.triangles, hits.barycentrics, -rays[hits.rays],
            np.zeros(len(hits.rays), np.bool_),
        )  # fmt: skip
        found = trace_paths(
            surface, materials, points.pick(front), light, np.eye(3),
            n_bounces=n_bounces, n_passes=1, n_samples=n_samples, seed=index,
        )  # fmt: skip
        parts[index, hits.rays[front]] = found.passes[0]
    return Picture.of(parts.reshape(n_rays, view.height, view.width, 3))


def relative_mse(ours, theirs):
    """Mean of (a - b)^2 / (b^2 + (mean / 10)^2), and the part of it that is noise of the two."""
    scale = theirs.mean**2 + (0.1 * theirs.mean.mean()) ** 2
    whole = ((ours.mean - theirs.mean) ** 2 / scale).mean()
    return whole, ((ours.variance + theirs.variance) / scale).mean()


def _bitmap(light):
    fine = np.repeat(np.repeat(light.radiance, FINER, axis=0), FINER, axis=1)
    # Mitsuba's u has its zero at -z, ours half a turn away
    return mi.Bitmap(np.ascontiguousarray(np.roll(fine, fine.shape[1] // 2, axis=1)))


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
