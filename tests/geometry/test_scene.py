"""Joining parts to a scene."""

import numpy as np
import pytest

from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.geometry.scene import Scene


def test_parts_keep_their_arrays():
    sphere, grid = sphere_mesh(1), grid_mesh(2, 3)
    scene = Scene.from_parts([sphere, grid])
    assert scene.part_ranges == ((0, 42), (42, 54))
    assert (scene.n_vertices, scene.n_faces) == (54, 92)
    assert (scene.positions[:42] == sphere.positions).all()
    assert (scene.positions[scene.faces[80:]] == grid.positions[grid.faces]).all()
    assert (scene.normals[42:] == grid.normals).all()
    assert scene.areas == pytest.approx(np.concatenate([sphere.vertex_areas, grid.vertex_areas]))
    assert np.isnan(scene.uv[:42]).all()
    assert (scene.uv[42:] == grid.uv).all()
    assert scene.part_of_face.tolist() == [0] * 80 + [1] * 12
    assert (scene.bounds[0] == scene.positions.min(axis=0)).all()
    assert (scene.bounds[1] == scene.positions.max(axis=0)).all()
    assert scene.diagonal == pytest.approx(np.linalg.norm(scene.bounds[1] - scene.bounds[0]))


def test_frames_follow_the_seed():
    sphere = sphere_mesh(1)
    assert (Scene.from_parts([sphere]).frames == tangent_frames(sphere.normals)).all()
    turned = Scene.from_parts([sphere], frame_seed=3).frames
    assert (turned == tangent_frames(sphere.normals, seed=3)).all()


def test_no_part_has_texture_coordinates():
    assert Scene.from_parts([sphere_mesh(0), sphere_mesh(1)]).uv is None


def test_no_parts_are_refused():
    with pytest.raises(ValueError, match="at least one part"):
        Scene.from_parts([])


def test_shapes_are_checked_in_tests():
    sphere = sphere_mesh(0)
    with pytest.raises(TypeError):
        Mesh(sphere.positions, sphere.faces, sphere.normals[:-1])


def test_frames_that_are_given_are_not_turned():
    sphere, grid = sphere_mesh(1), grid_mesh(2, 3)
    given = tangent_frames(sphere.normals)[:, [1, 0, 2]] * [[[1.0], [-1.0], [1.0]]]
    scene = Scene.from_parts([sphere, grid], frame_seed=3, frames=[given, None])
    assert (scene.frames[:42] == given).all()
    free = tangent_frames(scene.normals, seed=3)
    assert (scene.frames[42:] == free[42:]).all()
    with pytest.raises(ValueError, match="shorter"):
        Scene.from_parts([sphere, grid], frames=[given])
