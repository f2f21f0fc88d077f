"""The scenes that planning is held to: where effects matter, and where they do not."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.settings import AssetSettings, BakeSettings
from prtbake_workers.planning.presets import resolve_stages
from prtbake_workers.render.images import png_bytes, to_srgb8
from support.bounce_scenes import ball
from support.coloured_box import SUZANNE, WALL_COLOURS, suzanne_in_a_box
from support.local_stages import registered
from support.obj_file import obj_bytes

SETTINGS: BakeSettings = resolve_stages(
    "medium", AssetSettings(bake={"cube_resolution": 12, "n_centres": 162})
).bake
ABOUT_SETTINGS = (
    "those of the quality `medium` but for light in 6 x 12 x 12 directions and 162 functions of the "
    f"basis: {SETTINGS.bounce_rays} bounce rays and {SETTINGS.max_bounces} bounces at most, "
    f"tolerance {SETTINGS.bounce_tolerance:g}"
)

Registration = Callable[[BlobStore, Path], dict[str, Any]]
"""From the blobs and the folder of the data to what registers a mesh."""


@dataclass(frozen=True)
class EffectScene:
    """A bake: ``request`` holds its fields beside mesh, texture, effects and settings."""

    name: str
    title: str
    mesh: Registration
    request: Mapping[str, Any] = field(default_factory=dict)
    texture: Callable[[Path], bytes] | None = None

    def registered(self, store: BlobStore, data: Path) -> tuple[dict[str, Any], dict[str, Any]]:
        """Register mesh and texture; the request's fields and the context that names them."""
        digest = None if self.texture is None else store.put_bytes(self.texture(data))
        context = {
            "mesh": registered(store, "mesh", **self.mesh(store, data)),
            "brdf": {"spec": self.request["brdf"]},
            "albedo_texture": digest,
            "materials": {
                name: {"spec": material["brdf"]}
                for name, material in self.request.get("materials", {}).items()
            },
            "artefacts": {},
        }
        return {**self.request, **({} if digest is None else {"albedo_texture": digest})}, context


def file(name: str) -> Registration:
    """Register a file of the folder ``meshes``."""

    def registration(store: BlobStore, data: Path) -> dict[str, Any]:
        blob = store.put_bytes((data / "meshes" / name).read_bytes())
        return {"blob": blob, "filename": Path(name).name}

    return registration


def builtin(name: str, tessellation: int) -> Registration:
    """Register a procedural mesh."""
    return lambda _store, _data: {"builtin": {"name": name, "tessellation": tessellation}}


def made(make: Callable[[Path], bytes]) -> Registration:
    """Register an OBJ file that is made on the spot, its winding as it is."""

    def registration(store: BlobStore, data: Path) -> dict[str, Any]:
        blob = store.put_bytes(make(data))
        return {"blob": blob, "filename": "made.obj", "orient_outward": False}

    return registration


def lambert(albedo: float | tuple[float, float, float]) -> dict[str, Any]:
    """Give the JSON of a diffuse BRDF."""
    return {"model": "lambert", "albedo": albedo}


def two_spheres(_data: Path) -> bytes:
    """Make two unit spheres, sixty radii from middle to middle."""
    return obj_bytes([ball(4), ball(4, centre=(60.0, 0.0, 0.0))])


def coloured_box(data: Path) -> bytes:
    """Make suzanne in her box, each of its colours one texel of `box_texture`."""
    meshes = suzanne_in_a_box(data, cells=24)
    places = (np.arange(len(meshes)) + 0.5) / len(meshes)
    return obj_bytes(
        [
            replace(mesh, uv=np.tile([place, 0.5], (mesh.n_vertices, 1)))
            for mesh, place in zip(meshes, places, strict=True)
        ],
        coordinates=True,
    )


def box_texture(_data: Path) -> bytes:
    """Make a row of texels: suzanne's colour, then the walls'."""
    row = np.array([[SUZANNE, *WALL_COLOURS]], np.float32)
    return png_bytes(to_srgb8(row, 1.0))


PLANE = {"resolution": 64, "albedo": 0.7}
GLOSSY = {"model": "ggx", "kd": 0.3, "ks": 0.6, "alpha": 0.45, "f0": 0.2}
BRUSHED = {"model": "ward", "kd": 0.4, "ks": 0.3, "alpha_x": 0.7, "alpha_y": 0.35}
METAL = {"model": "ggx", "kd": 0.1, "ks": 1.0, "alpha": 0.6, "f0": [0.9, 0.6, 0.3]}
WAX = {
    "mm_per_unit": 1.0,
    "scattering": [1.6, 1.5, 1.3],
    "absorption": [0.002, 0.006, 0.03],
}

SCENES = (
    EffectScene(
        "icosphere", "icosphere alone", builtin("icosphere", 5), {"brdf": lambert(0.7)}
    ),
    EffectScene(
        "icosphere-plane", "icosphere on a plane", builtin("icosphere", 4),
        {"brdf": lambert(0.7), "receiver": PLANE},
    ),
    EffectScene("teapot", "teapot", file("teapot.obj"), {"brdf": lambert(0.7)}),
    EffectScene("bunny-black", "bunny, black", file("stanford-bunny.obj"), {"brdf": lambert(0.0)}),
    EffectScene("bunny-grey", "bunny, grey", file("stanford-bunny.obj"), {"brdf": lambert(0.4)}),
    EffectScene("bunny-white", "bunny, white", file("stanford-bunny.obj"), {"brdf": lambert(0.9)}),
    EffectScene(
        "bunny-plane", "bunny on a coloured plane", file("stanford-bunny.obj"),
        {"brdf": lambert(0.7), "receiver": PLANE | {"albedo": [0.8, 0.2, 0.1]}},
    ),
    EffectScene(
        "suzanne-box", "suzanne in an open box with coloured walls", made(coloured_box),
        {"brdf": lambert(1.0)}, texture=box_texture,
    ),
    EffectScene(
        "spot", "spot, textured", file("spot/spot_triangulated.obj"), {"brdf": lambert(1.0)},
        texture=lambda data: (data / "meshes/spot/spot_texture.png").read_bytes(),
    ),
    EffectScene(
        "armadillo", "armadillo of wax", file("armadillo.off"),
        {"brdf": lambert(1.0), "subsurface": WAX},
    ),
    EffectScene("dragon", "dragon, glossy", file("dragon-50k.obj"), {"brdf": GLOSSY}),
    EffectScene("fandisk", "fandisk, anisotropic", file("fandisk.obj"), {"brdf": BRUSHED}),
    EffectScene(
        "shaderball", "shaderball, two materials", file("gltf/shaderball.glb"),
        {
            "brdf": lambert(0.6),
            "materials": {"Calibration_Mesh": {"brdf": METAL}},
        },
    ),
    EffectScene("two-spheres", "two spheres far apart", made(two_spheres), {"brdf": lambert(0.7)}),
)  # fmt: skip
WARM_UP = EffectScene(
    "warm-up", "a small glossy ball on a plane", builtin("icosphere", 2),
    {"brdf": GLOSSY, "receiver": {"resolution": 4}},
)  # fmt: skip
