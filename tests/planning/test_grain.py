"""What a plan says of the frames of anisotropic parts."""

import numpy as np

from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.planning.grain import Grain, decide_frames, grain_notes


def test_singular_vertices_are_counted_and_the_first_is_named():
    mesh = sphere_mesh(2)
    grain = Grain.of("object", mesh, (1.0, 0.0, 0.0))
    poles = np.flatnonzero(np.abs(mesh.normals[:, 0]) > 1.0 - 1e-9)
    assert (grain.n_singular, grain.first_singular) == (2, poles[0])
    assert grain.at == tuple(mesh.positions[poles[0]])
    (note,) = grain_notes([grain], [])
    assert f"2 of {mesh.n_vertices} vertices of object" in note
    assert f"vertex {poles[0]} at (" in note
    decision = decide_frames([16], [grain])
    assert note in decision.reason
    assert decision.evidence["tangents"][0]["singular"] == 2


def test_a_plane_along_u_has_nothing_to_say():
    grain = Grain.of("object", grid_mesh(2, 2), "uv")
    assert grain_notes([grain, None], []) == []
    decision = decide_frames([1, 1], [grain, None])
    # one term of an anisotropic part turns with its frame, too
    assert decision.taken
    assert decision.reason == (
        "object is anisotropic, its tangents point along u of the texture coordinates"
    )


def test_isotropic_parts_follow_nothing():
    assert grain_notes([None], []) == []
    assert grain_notes([None, None], ["lid"]) == [
        "the BRDF of lid is isotropic: its tangents were not read"
    ]
    assert not decide_frames([1], [None]).taken
    many = decide_frames([16, 1], [None, None])
    assert many.taken
    assert many.evidence == {"terms": [16, 1]}
