"""Meshes whose triangles are cut, all or those that a picture shows: the surface stays what it was."""

import numpy as np

from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.render.camera import camera_rays
from support.baked_scene import camera_of


def finer(mesh, rounds, where=None):
    """Cut every triangle in four, so many times; the surface and its shading stay what they were.

    But for normals between a corner and the middle of an edge, by a tenth of a degree where the
    corners' are thirty apart.  With ``where``, (tris,) bool, only those are cut: beside the others
    middles of edges are corners on one side alone, where what is interpolated has a step.
    """
    chosen = np.ones(mesh.n_faces, np.bool_) if where is None else where
    for _ in range(rounds):
        own = mesh.faces[chosen]
        pairs = np.sort(own[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, middles = np.unique(pairs, axis=0, return_inverse=True)
        middle = (mesh.n_vertices + middles.reshape(-1, 3)).astype(np.int32)
        a, b, c = own.T
        ab, bc, ca = middle.T
        faces = np.concatenate(
            [mesh.faces[~chosen]]
            + [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        normals = mesh.normals[edges].sum(axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        mesh = Mesh(
            np.concatenate([mesh.positions, mesh.positions[edges].mean(axis=1)]),
            faces,
            np.concatenate([mesh.normals, normals]),
        )
        chosen = np.arange(len(faces)) >= len(faces) - 4 * len(own)
    return mesh


def shown(meshes, view, per_side):
    """Tell which triangles of each mesh a point of the picture shows, of ``per_side`` squared a pixel."""
    scene = Scene.from_parts(meshes)
    origins, directions = camera_rays(
        camera_of(view), view.width * per_side, view.height * per_side, scene.bounds
    )
    hits = Accelerator(scene.positions, scene.faces, robust=True).intersect(
        np.asarray(origins, np.float32), np.asarray(directions, np.float32)
    )
    seen = np.zeros(scene.n_faces, np.bool_)
    seen[hits.triangles[hits.triangles >= 0]] = True
    return [seen[scene.part_of_face == part] for part in range(len(meshes))]
