"""A mesh and itself turned over: which copy is where, whatever the winding."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.decode.sides import opposite_faces
from prtbake_workers.geometry.mesh import Mesh, face_area_vectors, vertex_normals
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.repair import repair
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.sides import both_sides
from prtbake_workers.geometry.tangents import oriented_frames
from support.bounce_scenes import bowl, turned_inside_out


def scrambled(mesh, rng):
    """Half of the triangles turned over at random, and the normals that such a mesh has."""
    flip = rng.random(mesh.n_faces) < 0.5
    faces = np.where(flip[:, None], mesh.faces[:, ::-1], mesh.faces).astype(np.int32)
    return Mesh(mesh.positions, faces, vertex_normals(mesh.positions, faces))


def leaning(mesh):
    """Cosine between every triangle and the normals of its corners."""
    across = face_area_vectors(mesh.positions, mesh.faces)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.einsum("tj,tcj->tc", across, mesh.normals[mesh.faces])


@pytest.mark.parametrize("mesh", [grid_mesh(3, 2), sphere_mesh(1)], ids=["grid", "ball"])
def test_the_first_copy_is_the_mesh_and_the_second_its_reverse(mesh):
    both = both_sides(mesh)
    n, m = mesh.n_vertices, mesh.n_faces
    assert (both.n_vertices, both.n_faces) == (2 * n, 2 * m)
    for name in ("positions", "normals", "faces"):
        assert getattr(both, name)[: len(getattr(both, name)) // 2].tobytes() == (
            getattr(mesh, name).tobytes()
        )
    assert (both.positions[n:] == mesh.positions).all()
    assert (both.normals[n:] == -mesh.normals).all()
    assert (both.faces[m:] == mesh.faces[:, ::-1] + n).all()
    opposite = opposite_faces(both.faces, [(0, 2 * n)], [True])
    assert (opposite == np.roll(np.arange(2 * m), m)).all()
    if mesh.uv is not None:
        assert (both.uv == np.tile(mesh.uv, (2, 1))).all()


def test_any_winding_gives_the_same_two_surfaces(rng):
    whole = bowl(5, 12)
    mesh = scrambled(whole, rng)
    both = both_sides(mesh)
    # every triangle faces where its corners' normals stand, on both copies
    assert leaning(both).min() > 0.5
    # up to its sense, a mended normal is the mean that the mesh has where it is wound alike
    n = mesh.n_vertices
    expected = vertex_normals(whole.positions, whole.faces)
    assert np.abs((both.normals[:n] * expected).sum(axis=1)) == pytest.approx(1.0, abs=1e-12)
    assert (both.normals[n:] == -both.normals[:n]).all()
    # the negative twin: the normals of the mixed mesh are neither's
    assert np.abs((mesh.normals * expected).sum(axis=1)).min() < 0.9
    assert leaning(mesh).min() < -0.5


def moebius(n_along=48, n_across=3, half_width=0.3):
    """A strip with half a twist, and the normals of its surface up to their sense."""
    along = 2.0 * np.pi * np.arange(n_along) / n_along
    across = half_width * np.linspace(-1.0, 1.0, n_across)
    u, v = (grid.ravel() for grid in np.meshgrid(along, across, indexing="ij"))
    reach = 1.0 + v * np.cos(u / 2)
    positions = np.stack([reach * np.cos(u), v * np.sin(u / 2), -reach * np.sin(u)], axis=1)
    d_v = np.stack([np.cos(u / 2) * np.cos(u), np.sin(u / 2), -np.cos(u / 2) * np.sin(u)], axis=1)
    slope = -0.5 * v * np.sin(u / 2)
    d_u = np.stack(
        [
            slope * np.cos(u) - reach * np.sin(u),
            0.5 * v * np.cos(u / 2),
            -slope * np.sin(u) - reach * np.cos(u),
        ],
        axis=1,
    )
    normals = np.cross(d_u, d_v)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    at = np.arange(n_along * n_across).reshape(n_along, n_across)
    after = np.concatenate([at[1:], at[:1, ::-1]])
    a, b, c, d = at[:, :-1], after[:, :-1], after[:, 1:], at[:, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return positions, faces, normals


def test_a_strip_with_half_a_twist_has_no_seam():
    positions, faces, normals = moebius()
    mesh, report = repair(RawMesh(positions, faces), "test", orient_outward=True)
    assert not report.orientable
    order = np.lexsort(mesh.positions.T), np.lexsort(positions.T)
    expected = np.empty_like(normals)
    expected[order[0]] = normals[order[1]]
    both = both_sides(mesh)
    off = 1.0 - np.abs((both.normals[: mesh.n_vertices] * expected).sum(axis=1))
    # triangles of 7 degrees are flat where the strip is curved
    assert off.max() < 5e-3
    assert leaning(both).min() > 0.9
    # the negative twin: as repaired, the normals at one cross-section are means of opposites
    assert (1.0 - np.abs((mesh.normals * expected).sum(axis=1))).max() > 0.5


def test_a_crease_angle_splits_what_is_wound_both_ways_and_180_does_not():
    """As the documentation says of two-sided parts: repair does not know that they will be."""
    positions, faces, _ = moebius()
    found = {
        angle: repair(
            RawMesh(positions, faces), "test", orient_outward=True, crease_angle_deg=angle
        )
        for angle in (60.0, 180.0, None)
    }
    # the edges of one cross-section, and its vertices a second time
    assert found[60.0][1].crease_edges == 2
    assert found[60.0][0].n_vertices == len(positions) + 3
    for angle in (180.0, None):
        assert found[angle][1].crease_edges == 0
        assert found[angle][0].n_vertices == len(positions)


@pytest.mark.parametrize("inward", [False, True])
def test_rays_leave_both_sides_as_they_leave_a_sheet(inward):
    """A rim stays an open edge; the other side is no crease of the first."""
    sheet = bowl(4, 10)
    sheet = turned_inside_out(sheet) if inward else sheet
    n = sheet.n_vertices
    both = Scene.from_parts([both_sides(sheet)], two_sided=(True,))
    for part, mesh in ((slice(0, n), sheet), (slice(n, 2 * n), turned_inside_out(sheet))):
        alone = Scene.from_parts([mesh])
        for name in ("positions", "normals", "areas", "ray_points", "ray_sides"):
            assert (getattr(both, name)[part] == getattr(alone, name)).all(), name
    frames = both.frames
    assert np.einsum("vij,vkj->vik", frames, frames) == pytest.approx(
        np.tile(np.eye(3), (2 * n, 1, 1)), abs=1e-12
    )
    assert np.linalg.det(frames) == pytest.approx(1.0)
    # the negative twin: where the scene does not know, no edge is open
    blind = Scene.from_parts([both_sides(sheet)])
    assert (both.ray_points != both.positions).any()
    assert (blind.ray_points[:n] != both.ray_points[:n]).any()


@pytest.mark.parametrize("tangents", ["uv", (0.3, 0.1, -1.0)])
def test_both_sides_have_one_grain_in_right_handed_frames(tangents):
    sheet = bowl(4, 10)
    sheet = replace(sheet, uv=sheet.positions[:, [0, 2]] @ [[1.0, 0.5], [-0.2, 1.0]])
    frames, n = oriented_frames(both_sides(sheet), tangents).frames, sheet.n_vertices
    # a tangent and its opposite are one
    along = (frames[:n, 0] * frames[n:, 0]).sum(axis=1)
    assert np.abs(along) == pytest.approx(1.0, abs=1e-12)
    assert (frames[:n, 2] == -frames[n:, 2]).all()
    assert np.linalg.det(frames) == pytest.approx(1.0)


def test_one_copy_is_traced_beside_parts_with_one_side():
    scene = Scene.from_parts(
        [grid_mesh(1, 1), both_sides(grid_mesh(2, 2)), grid_mesh(1, 2)],
        bodies=(0, 0, 3),
        two_sided=(False, True, False),
    )
    assert scene.traced.tolist() == [*range(10), *range(18, 22)]
    assert (scene.traced_faces == scene.faces[scene.traced]).all()
    assert scene.opposite.tolist() == [-1] * 2 + [*range(10, 18), *range(2, 10)] + [-1] * 4
    part = scene.part(1)
    assert part.opposite.tolist() == [*range(8, 16), *range(8)]
    assert scene.part(2).opposite is None
    # no vertex of the other side is one with a vertex of another body
    n = len(grid_mesh(2, 2).positions)
    back = slice(4 + n, 4 + 2 * n)
    assert (scene.twins[back] == np.arange(back.start, back.stop)).all()


@pytest.mark.parametrize("broken", ["winding", "odd", "pairs"])
def test_what_is_not_there_twice_is_refused(broken):
    mesh = both_sides(grid_mesh(2, 2))
    faces, stop = mesh.faces.copy(), mesh.n_vertices
    if broken == "winding":
        faces[-1] = faces[-1][::-1]
    elif broken == "odd":
        faces = faces[:-1]
    else:
        stop -= 2
    with pytest.raises(ValueError, match="parts/0/two_sided"):
        opposite_faces(faces, [(0, stop)], [True])
