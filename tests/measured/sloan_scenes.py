"""The rows of [Sloan2003] table 1 with meshes at hand, and their transfer.

His bird and head are not to be had: the bunny, smooth like the bird, and the horse stand for them.
His scattering Buddha is left out.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.contract.brdf import LambertSpec, PhongSpec, WardSpec
from prtbake_workers.basis.hemisphere_basis import HemisphereBasis
from prtbake_workers.basis.sh_basis import ShBasis
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.factorise_harmonic import factorise_harmonic
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import cube_directions
from support.bounce_scenes import patch

PHONG = PhongSpec(kd=0.3, ks=0.7, exponent=10)
BRUSHED = WardSpec(kd=0.3, ks=0.4, alpha_x=0.25, alpha_y=0.6)
DIFFUSE = LambertSpec(albedo=0.7)


def file(name: str) -> Callable[[Path], Mesh]:
    """Load a file of the folder ``meshes``."""

    def load(data: Path) -> Mesh:
        path = data / "meshes" / name
        return load_mesh(path.read_bytes(), path.suffix[1:])[0]

    return load


def polygons(cells: int) -> Callable[[Path], Mesh]:
    """Make two squares, the smaller one above the larger one, of so many cells along each side."""

    def make(_data: Path) -> Mesh:
        floor = patch((-1.0, 0.0, 1.0), (2.0, 0.0, 0.0), (0.0, 0.0, -2.0), cells, cells)
        roof = patch((-0.5, 0.4, 0.5), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), cells, cells)
        return Mesh(
            np.concatenate([floor.positions, roof.positions]),
            np.concatenate([floor.faces, roof.faces + floor.n_vertices]),
            np.concatenate([floor.normals, roof.normals]),
        )

    return make


@dataclass(frozen=True)
class Row:
    """One row: what is baked and how it is compressed, and what the paper states of its like.

    ``view`` is the number of harmonics of the view, of the SVD's terms for an anisotropic BRDF, and
    1 for a diffuse one; ``light_order`` the bands of the light.  Every ``thin``-th vertex is
    compressed, in as many times fewer clusters, unless everything is asked for.
    """

    name: str
    mesh: Callable[[Path], Mesh]
    brdf: Any
    view: int
    light_order: int
    n_clusters: int
    n_components: int
    theirs: str
    their_static: float
    their_iterative: float
    resolution: int = 12
    thin: int = 1

    @property
    def matrix(self) -> str:
        """Rows and columns of a vertex's transfer."""
        return f"{self.view} x {self.light_order**2}"


BUDDHA, BUNNY = file("happy-buddha-50k.obj"), file("stanford-bunny.obj")

ROWS = (
    Row("buddha, isotropic", BUDDHA, PHONG, 16, 5, 256, 6, "Buddha, gloss-iso", 563, 451, thin=8),
    Row(
        "buddha, anisotropic", BUDDHA, BRUSHED, 24, 5, 256, 8,
        "Buddha, gloss-anis", 10996, 8524, thin=8,
    ),
    Row(
        "bunny, anisotropic", BUNNY, BRUSHED, 24, 5, 256, 8, "bird, gloss-anis", 898, 294, thin=8
    ),
    Row(
        "bunny, diffuse", BUNNY, DIFFUSE, 1, 10, 256, 8, "bird, diffuse", 3.14, 0.668,
        resolution=16, thin=2,
    ),
    Row(
        "horse, isotropic", file("horse.obj"), PHONG, 16, 5, 256, 6,
        "head, gloss-iso", 78.8, 43.7, thin=8,
    ),
    Row(
        "two squares, diffuse", polygons(170), DIFFUSE, 1, 10, 32, 4, "polys, diffuse",
        0.492, 0.432, resolution=16, thin=2,
    ),
)  # fmt: skip

FIGURE = Row(
    "bunny, diffuse, 25", BUNNY, DIFFUSE, 1, 5, 256, 3, "bird, 25-D diffuse", 0, 0, thin=2
)  # fmt: skip
"""The signal of figures 2 to 4."""


def transfer(row: Row, data: Path, thin: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Bake a row's shadowed transfer; give every ``thin``-th vertex's matrix, a row each, and areas.

    Light is projected on spherical harmonics by least squares, and the views' functions are
    orthonormal under their cosine, so that squared errors are squared errors of radiance.
    """
    scene = Scene.from_parts([row.mesh(data)])
    brdf = brdf_from_spec(row.brdf)
    order = round(row.view**0.5 + 0.1)
    if row.brdf is PHONG:
        factorisation = factorise_harmonic(brdf, order, HemisphereBasis(order).kept)
    else:
        factorisation = factorise(brdf, n_terms=row.view)
    if factorisation.n_terms != row.view:
        raise ValueError(f"{row.name}: {factorisation.n_terms} terms in place of {row.view}")
    directions = cube_directions(row.resolution)
    block = bake_block(
        scene,
        Accelerator(scene.positions, scene.faces),
        (0, scene.n_vertices),
        factorisation=factorisation,
        projection=ShBasis(row.light_order).projection(directions.directions, directions.weights),
        directions=directions,
        threads=2,
    )
    kept = block.coefficients[::thin]
    return kept.reshape(len(kept), -1), scene.areas[::thin]
