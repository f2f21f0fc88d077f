"""Suzanne in a box that is open at the top and in front, its side walls red and green."""

from pathlib import Path

import numpy as np

from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.mesh import Mesh
from support.bounce_scenes import patch

SUZANNE = (0.6, 0.55, 0.5)
WHITE, RED, GREEN = (0.75, 0.75, 0.75), (0.75, 0.15, 0.1), (0.1, 0.6, 0.15)
WALL_COLOURS = (WHITE, WHITE, RED, GREEN)
"""Floor, back, left, right."""


def suzanne_in_a_box(data: Path, cells: int) -> list[Mesh]:
    """Suzanne, then floor, back, left and right wall of ``cells`` x ``cells`` each."""
    mesh, _ = load_mesh((data / "meshes" / "suzanne.obj").read_bytes(), "obj")
    size = 1.1 / np.ptp(mesh.bounds, axis=0).max()
    suzanne = Mesh(
        (mesh.positions - mesh.bounds.mean(axis=0)) * size - [0.0, 0.35, 0.0],
        mesh.faces,
        mesh.normals,
    )
    return [
        suzanne,
        patch([-1, -1, 1], [2, 0, 0], [0, 0, -2], cells, cells),
        patch([-1, -1, -1], [2, 0, 0], [0, 2, 0], cells, cells),
        patch([-1, -1, 1], [0, 0, -2], [0, 2, 0], cells, cells),
        patch([1, -1, -1], [0, 0, 2], [0, 2, 0], cells, cells),
    ]
