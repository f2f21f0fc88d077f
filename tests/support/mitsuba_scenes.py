"""Scenes that Mitsuba 3 renders as well: real meshes, materials that both have, a real overcast sky."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from prtbake_workers.brdf.base import above_horizon, clamped_cosines, half_vector
from prtbake_workers.brdf.ggx import smith_g1, trowbridge_reitz
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.reading import read_environment
from prtbake_workers.environment.resampling import box_filter
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.receiver import receiver_plane
from support import coloured_box
from support.coloured_box import SUZANNE, WALL_COLOURS


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


def overcast_sky(data_dir):
    """Of 16 x 32 texels, which the path tracer and Mitsuba both hold constant."""
    read, _ = read_environment((data_dir / "environments" / "uffizi.hdr").read_bytes())
    return Environment(box_filter(read.radiance, 16, 32))


def suzanne_in_a_box(data_dir, metal=0.0):
    """Diffuse, or in part rough metal, in a box that is open at the top and in front."""
    kd = np.array(SUZANNE)
    own = DiffuseAndMetal((1.0 - metal) * kd, metal, 0.2) if metal else Lambert(kd)
    brdfs = [own, *(Lambert(np.array(colour)) for colour in WALL_COLOURS)]
    return (
        coloured_box.suzanne_in_a_box(data_dir, 4),
        brdfs,
        View((0.0, 0.4, 3.4), (0.0, -0.1, 0.0), 38.0, 24, 18),
    )


def bunny_on_a_plane(data_dir):
    """Diffuse and rough metal on a diffuse plane."""
    mesh, _ = load_mesh((data_dir / "meshes" / "stanford-bunny.obj").read_bytes(), "obj")
    plane = receiver_plane(mesh.bounds, resolution=16, extent=3.0, gap=0.0)
    middle = mesh.bounds.mean(axis=0)
    eye = middle + mesh.diagonal * np.array([0.3, 0.5, 1.8])
    brdfs = [
        DiffuseAndMetal(np.array([0.5, 0.4, 0.3]), 0.3, 0.3),
        Lambert(np.array([0.2, 0.5, 0.7])),
    ]
    return [mesh, plane], brdfs, View(tuple(eye), tuple(middle), 32.0, 32, 24)


def shaderball(data_dir):
    """Diffuse and rough metal, lit by itself in its hollows."""
    mesh, _ = load_mesh((data_dir / "meshes" / "gltf" / "shaderball.glb").read_bytes(), "glb")
    middle = mesh.bounds.mean(axis=0)
    eye = middle + mesh.diagonal * np.array([0.3, 0.4, 1.5])
    return (
        [mesh],
        [DiffuseAndMetal(np.array([0.45, 0.3, 0.2]), 0.4, 0.3)],
        View(tuple(eye), tuple(middle), 30.0, 28, 21),
    )
