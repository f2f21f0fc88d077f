"""The planned scene as a file: what every tile of a bake reads."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.transfer_basis import SphericalHarmonics, TransferBasis, WhitenedSrbfs
from prtbake_storage.hdf5.bundle import read_bundle, write_bundle
from prtbake_workers.arrays import F32, Float32
from prtbake_workers.basis.incident import (
    IncidentBasis,
    OrthonormalFunctions,
    basis_of,
    functions_from_tables,
)
from prtbake_workers.basis.projection import LeastSquaresProjection
from prtbake_workers.basis.srbf import default_bandwidth
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.stored_factorisation import factorisation_from_tables
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.jobs.media import make_dipole
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.mirrored import Product, product_from_tables

SUBDIVISIONS = {12: 0, 42: 1, 162: 2, 642: 3, 2562: 4, 10242: 5}
_SCENE_ARRAYS = ("positions", "faces", "normals", "frames", "areas", "part_of_face")


@dataclass(frozen=True)
class PlannedScene:
    """Geometry, and by part factorised materials, albedo textures and colours; the plan's header.

    ``header`` holds ``bake`` (settings), ``parts`` (name, role, sides, material, medium,
    occluders),
    ``bounces`` (their channels, the parts that scatter and how; None where neither is simulated),
    ``provenance``.
    """

    scene: Scene
    factorisations: tuple[Factorisation, ...]
    textures: tuple[F32 | None, ...]
    colours: tuple[F32 | None, ...]
    header: Mapping[str, Any]

    def basis(self) -> IncidentBasis:
        """Make the basis of the bake settings."""
        return make_basis(self.header["bake"])

    def reflection(self) -> tuple[tuple[Factorisation, ...], Albedo]:
        """Give what light that surfaces send to each other is multiplied by, in its channels.

        Factorisations, and the albedo beside them: see `BounceGather`.  Without channels of their
        own colours share their mean.
        """
        factorisations, albedo = reflection_of(
            self.scene, self.factorisations, self.textures, self.colours
        )
        if self.header["bounces"]["coloured"]:
            return factorisations, albedo
        return tuple(own.greyed() for own in factorisations), albedo.greyed()

    def scattering(self, part: int) -> Dipole | None:
        """Make the dipole of a part whose scattering is simulated; None for any other."""
        if part not in self.header["bounces"]["scattering"]:
            return None
        return make_dipole(self.header["parts"][part]["subsurface"])

    def max_solid_angle(self, part: int) -> float:
        """Tell how large the clusters of a part that scatters may look."""
        bounces = self.header["bounces"]
        return float(bounces["solid_angles"][bounces["scattering"].index(part)])

    def occluders(self, part: int) -> Accelerator | None:
        """Make the accelerator of the triangles that may block light on its way to a part."""
        return occluder_accelerator(self.scene, self.header["parts"][part]["occluders"])


def reflection_of(
    scene: Scene,
    factorisations: Sequence[Factorisation],
    textures: Sequence[Float32[F32, "_ _ 3"] | None],
    colours: Sequence[Float32[F32, "_ 3"] | None],
) -> tuple[tuple[Factorisation, ...], Albedo]:
    """Pair factorisations with the albedo beside them."""
    albedo = Albedo.of_parts(
        scene, [own.albedo.astype(np.float64) for own in factorisations], textures, colours
    )
    return tuple(factorisations), albedo


def stored_basis(bake: Mapping[str, Any]) -> TransferBasis:
    """Tell the functions that bake settings name, without solving for their Gram matrix."""
    if bake["basis"] == "sh":
        return SphericalHarmonics(bake["sh_order"])
    centres = icosphere(SUBDIVISIONS[bake["n_centres"]])
    return WhitenedSrbfs(centres, bake["bandwidth"] or default_bandwidth(len(centres)))


def make_basis(bake: Mapping[str, Any]) -> IncidentBasis:
    """Make the basis that bake settings name."""
    return basis_of(stored_basis(bake))


_PROJECTION_ARRAYS = ("samples", "weights", "gram")


@dataclass(frozen=True)
class StoredProjection:
    """What every tile of a bake projects with, so that none solves for it again."""

    projection: LeastSquaresProjection
    product: Product
    functions: OrthonormalFunctions


def write_projection(path: Path, stored: StoredProjection) -> Path:
    """Write a projection, its product and the functions that it is for."""
    arrays: dict[str, NDArray[Any]]
    arrays, numbers = stored.functions.tables()
    product, product_numbers = stored.product.tables()
    arrays |= {name: getattr(stored.projection, name) for name in _PROJECTION_ARRAYS}
    arrays |= {f"product/{name}": array for name, array in product.items()}
    numbers |= {"ridge": stored.projection.ridge, "product": product_numbers}
    return write_bundle(path, arrays, numbers, gzip_level=0)


def read_projection(path: Path) -> StoredProjection:
    """Read what `write_projection` wrote."""
    arrays, header = read_bundle(path)
    own = {name: arrays[name] for name in _PROJECTION_ARRAYS}
    product = {
        name.removeprefix("product/"): array
        for name, array in arrays.items()
        if name.startswith("product/")
    }
    return StoredProjection(
        projection=LeastSquaresProjection(**own, ridge=header["ridge"]),
        product=product_from_tables(product, header["product"]),
        functions=functions_from_tables(arrays, header),
    )


def occluder_accelerator(scene: Scene, parts: list[int]) -> Accelerator | None:
    """Make an accelerator of some parts of a scene; None of none."""
    if not parts:
        return None
    part_of_face = scene.part_of_face
    if scene.traced is not None:
        part_of_face = part_of_face[scene.traced]
    return Accelerator(scene.positions, scene.traced_faces[np.isin(part_of_face, parts)])


def write_scene(path: Path, planned: PlannedScene) -> Path:
    """Write a planned scene."""
    scene = planned.scene
    arrays: dict[str, NDArray[Any]] = {name: getattr(scene, name) for name in _SCENE_ARRAYS}
    if scene.uv is not None:
        arrays["uv"] = scene.uv
    for name, of_parts in (
        ("albedo_texture", planned.textures),
        ("vertex_colours", planned.colours),
    ):
        for index, array in enumerate(of_parts):
            if array is not None:
                arrays[f"{name}{index}"] = array
    tables: list[dict[str, Any]] = []
    for index, factorisation in enumerate(planned.factorisations):
        plain = {}
        for name, value in factorisation.tables().items():
            if isinstance(value, np.ndarray):
                arrays[f"factorisation{index}/{name}"] = value
            else:
                plain[name] = value
        tables.append(plain)
    header = dict(planned.header) | {
        "tables": tables,
        "part_ranges": [list(pair) for pair in scene.part_ranges],
        "bodies": None if scene.bodies is None else list(scene.bodies),
        "two_sided": None if scene.two_sided is None else list(scene.two_sided),
    }
    return write_bundle(path, arrays, header)


def read_scene(path: Path) -> PlannedScene:
    """Read a planned scene."""
    arrays, header = read_bundle(path)
    scene = Scene(
        **{name: arrays[name] for name in _SCENE_ARRAYS},
        uv=arrays.get("uv"),
        part_ranges=tuple((int(a), int(b)) for a, b in header["part_ranges"]),
        bodies=None if header["bodies"] is None else tuple(header["bodies"]),
        two_sided=None if header["two_sided"] is None else tuple(header["two_sided"]),
    )
    factorisations = []
    for index, plain in enumerate(header["tables"]):
        prefix = f"factorisation{index}/"
        own = {n.removeprefix(prefix): v for n, v in arrays.items() if n.startswith(prefix)}
        factorisations.append(factorisation_from_tables(own | plain))
    textures, colours = (
        tuple(arrays.get(f"{name}{index}") for index in range(len(factorisations)))
        for name in ("albedo_texture", "vertex_colours")
    )
    return PlannedScene(scene, tuple(factorisations), textures, colours, header)
