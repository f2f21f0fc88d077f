"""What transport and compression are measured on: a bunny of moderate gloss, at the papers' sizes.

The mesh is the bunny of the real-data folder where ``PRTBAKE_DATA`` names one, else a teapot of as
many vertices.
"""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from prtbake_workers.basis.projection import LeastSquaresProjection
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.teapot import teapot
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import CubeDirections, cube_directions
from prtbake_workers.transport.mirrored import product_of

TILE = 4096
THREADS = 2


def bunny_scene(quick: bool) -> Scene:
    """Return the mesh alone."""
    folder = os.environ.get("PRTBAKE_DATA")
    if folder:
        path = Path(folder) / "meshes" / "stanford-bunny.obj"
        mesh: Mesh = load_mesh(path.read_bytes(), "obj")[0]
    else:
        mesh = teapot(8 if quick else 33)
    return Scene.from_parts([mesh])


def glossy_terms() -> Factorisation:
    """Return sixteen terms of Cook-Torrance, m 0.5."""
    brdf = CookTorrance(np.array([0.3]), np.array([0.7]), 0.5, np.array([0.1]))
    return factorise(brdf, n_terms=16)


def srbf_projection() -> LeastSquaresProjection:
    """Return the projection of 6 x 32 x 32 directions on 642 Gaussian SRBFs."""
    cube: CubeDirections = cube_directions(32)
    return SrbfBasis(icosphere(3)).projection(cube.directions, cube.weights)


def baked_transfer() -> NDArray[np.float32]:
    """Bake it all: whitened coefficients (verts, 16, 642)."""
    scene, glossy, projection = bunny_scene(quick=False), glossy_terms(), srbf_projection()
    accelerator, cube = Accelerator(scene.positions, scene.faces), cube_directions(32)
    product = product_of(projection, cube.directions)
    coefficients = np.empty((scene.n_vertices, glossy.n_terms, projection.n_coeffs), np.float32)
    for start in range(0, scene.n_vertices, TILE):
        stop = min(start + TILE, scene.n_vertices)
        coefficients[start:stop] = bake_block(
            scene, accelerator, (start, stop),
            factorisation=glossy, projection=projection, directions=cube, product=product,
            threads=THREADS,
        ).coefficients  # fmt: skip
    return coefficients
