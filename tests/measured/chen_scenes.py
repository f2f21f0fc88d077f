"""The scenes of [Chen2005]: his meshes as far as others can be them, and transfer as he had it.

His transfer holds 36 spherical harmonics of the light and 36 of the view at each vertex.  Ours holds
the same harmonics of the light, and of the view the orthonormal terms that keep the BRDF: distances
between vertices are those of the radiance either way.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh

from measured.effect_runs import Bakes
from measured.effect_scenes import EffectScene, file, made
from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.settings import AssetSettings, BakeSettings
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.arrays import F32, F64, I32
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.planning.presets import resolve_stages
from support.coarser_mesh import coarser
from support.obj_file import obj_bytes

HORSE_FACES, DINO_FACES = 39_698, 47_904
"""Of table 5.1."""

TERMS = 6
"""Of the BRDF, the strongest: distances between vertices need no more."""

SETTINGS: BakeSettings = resolve_stages(
    "medium",
    AssetSettings(bake={"cube_resolution": 12, "basis": "sh", "sh_order": 6, "n_terms": TERMS}),
).bake
SWITCHES = {"interreflection": "off", "colour_bleeding": "off"}

PHONG = {"model": "phong", "kd": 0.3, "ks": 0.7, "exponent": 10.0}
COOK_TORRANCE = {"model": "cook_torrance", "kd": 0.3, "ks": 0.7, "m": 0.5}


def horse(data: Path) -> bytes:
    """Draw the horse's short edges together until it has the thesis' triangles."""
    mesh = trimesh.load(data / "meshes/horse.obj", process=True)
    return _obj(*coarser(np.asarray(mesh.vertices), np.asarray(mesh.faces), HORSE_FACES))


def dino(data: Path) -> bytes:
    """Subdivide the dino twice, then draw short edges together as the horse's."""
    mesh = trimesh.load(data / "meshes/dino.off", process=True)
    finer = mesh.subdivide_loop(2)
    return _obj(*coarser(np.asarray(finer.vertices), np.asarray(finer.faces), DINO_FACES))


def _obj(positions: F64, faces: I32) -> bytes:
    mesh = trimesh.Trimesh(positions, faces, process=False)
    return obj_bytes([Mesh(positions, faces, np.asarray(mesh.vertex_normals))])


MESHES: dict[str, Callable[[Any, Path], dict[str, Any]]] = {
    "dino": made(dino),
    "horse": made(horse),
    "bunny": file("stanford-bunny.obj"),
}
SCENES = tuple(
    EffectScene(f"{mesh}-{name}", f"{mesh}, {title}", MESHES[mesh], {"brdf": brdf})
    for mesh, name, title, brdf in (
        ("dino", "phong", "Phong", PHONG),
        ("horse", "phong", "Phong", PHONG),
        ("horse", "cook-torrance", "Cook-Torrance", COOK_TORRANCE),
        ("bunny", "cook-torrance", "Cook-Torrance", COOK_TORRANCE),
    )
)


@dataclass(frozen=True)
class Baked:
    """Transfer of one part, each vertex's terms and coefficients one row, and its mesh."""

    signal: F32
    areas: F64
    positions: F64
    faces: I32
    n_terms: int


def bake(scene: EffectScene, data: Path, settings: BakeSettings = SETTINGS) -> Baked:
    """Bake a scene without bounces."""
    with TemporaryDirectory(prefix="prtbake-chen-") as folder:
        store = open_store((Path(folder) / "blobs").as_uri())
        run = Bakes(scene, store, data, settings).run(SWITCHES)
        with open_transfer(run.transfer) as transfer:
            part = transfer.header.parts[0]
            rows = transfer.read(0, 0, part.n_vertices)
            areas = part.areas / part.areas.sum()
            return Baked(
                signal=np.ascontiguousarray(rows.reshape(part.n_vertices, -1)),
                areas=areas,
                positions=transfer.header.positions,
                faces=transfer.header.faces,
                n_terms=part.n_terms,
            )
