"""Both directions: a skipped effect changes nothing, a needed one is not skipped."""

import tracemalloc

import numpy as np
import pytest
import trimesh

from prtbake_storage.contract.settings import BakeSettings, Effects
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.checks import check_factorisation
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.mesh import Mesh, vertex_normals
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.receiver import receiver_plane
from prtbake_workers.geometry.repair import repair
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.teapot import teapot
from prtbake_workers.planning.convexity import convexity_defect, scattered_shadows
from prtbake_workers.planning.effects import decide_effects, probe_occlusion
from prtbake_workers.planning.plan import occluders_of
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import cube_directions

CUBE = cube_directions(12)


DIFFUSE = factorise(Lambert(np.array([0.5])))
GLOSSY = factorise(
    CookTorrance(np.array([0.0]), np.array([1.0]), 0.3, np.array([0.04])), n_terms=16
)


def decisions(meshes, *, watertight, requested=None, factorisation=DIFFUSE):
    scene = Scene.from_parts(meshes)
    found = decide_effects(
        meshes[0],
        scene,
        Accelerator(scene.positions, scene.faces),
        names=["object", "receiver"][: len(meshes)],
        roles=["object", "receiver"][: len(meshes)],
        factorisations=[factorisation, DIFFUSE][: len(meshes)],
        albedo=Albedo.constant(0.5),
        watertight=watertight,
        bake=BakeSettings(),
        requested=requested or Effects(),
        seed=0,
    )
    return {decision.effect: decision for decision in found}, found, scene


def dented_sphere():
    ball = sphere_mesh(3)
    positions = ball.positions.copy()
    positions[ball.positions[:, 1] > 1.8, 1] -= 0.7
    return Mesh(positions, ball.faces, vertex_normals(positions, ball.faces), None)


def test_a_closed_convex_mesh_needs_no_ray_and_loses_nothing_by_it():
    ball = sphere_mesh(3)
    by_name, found, scene = decisions([ball], watertight=True)
    assert not by_name["self_shadowing"].taken
    assert occluders_of(0, ["object"], found) == ()
    # the other direction: the rays that were saved would all have escaped
    ratio, blocked, rays = probe_occlusion(
        scene, Accelerator(scene.positions, scene.faces), 0, DIFFUSE, seed=7
    )
    assert rays > 10_000
    assert blocked == 0.0
    assert ratio == 0.0


def test_a_dent_calls_for_self_shadowing_and_says_what_it_would_cost():
    by_name, _, _ = decisions([dented_sphere()], watertight=True)
    decision = by_name["self_shadowing"]
    assert decision.taken
    assert decision.predicted_error_otherwise > 0.001
    assert decision.evidence["blocked_share"] > 0.0


def test_shadows_on_a_black_object_are_not_seen_but_fall_on_its_receiver():
    black = factorise(Lambert(np.array([0.0])))
    dented = dented_sphere()
    meshes = [dented, receiver_plane(dented.bounds, resolution=8, extent=2.0, gap=0.0)]
    by_name, found, _ = decisions(meshes, watertight=True, factorisation=black)
    decision = by_name["self_shadowing"]
    assert not decision.taken
    assert "black" in decision.reason
    assert decision.predicted_error_otherwise == 0.0
    assert by_name["receiver_shadows"].predicted_error_otherwise > 0.001
    assert 0 in occluders_of(1, ["object", "receiver"], found)
    # as soon as it reflects anything they are
    grey = factorise(Lambert(np.array([0.01])))
    assert decisions(meshes, watertight=True, factorisation=grey)[0]["self_shadowing"].taken


def extruded(outline):
    """A closed prism over a polygon given counter-clockwise from above, in the plane y = 0."""
    path = trimesh.creation.extrude_triangulation(
        np.asarray(outline[0], float), np.asarray(outline[1]), 1.0
    )
    positions, faces = np.asarray(path.vertices), np.asarray(path.faces, np.int32)
    return Mesh(positions, faces, vertex_normals(positions, faces), None)


L_SHAPE = (
    [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]],
    [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]],
)


def two_cubes():
    cube = trimesh.creation.box()
    far = cube.copy()
    far.apply_translation([3.0, 0.0, 0.0])
    both = trimesh.util.concatenate([cube, far])
    positions, faces = np.asarray(both.vertices), np.asarray(both.faces, np.int32)
    return Mesh(positions, faces, vertex_normals(positions, faces), None)


@pytest.mark.parametrize("mesh", [extruded(L_SHAPE), two_cubes()], ids=["L", "two cubes"])
def test_vertices_on_the_hull_do_not_make_a_mesh_convex(mesh):
    """Every vertex of an L, and of two cubes, lies on the convex hull; both shadow themselves."""
    assert convexity_defect(mesh) > 0.1
    by_name, _, _ = decisions([mesh], watertight=True)
    assert by_name["self_shadowing"].taken


@pytest.mark.parametrize(
    "make", [trimesh.creation.box, lambda: extruded(L_SHAPE)], ids=["box", "L"]
)
def test_vertices_split_along_creases_change_no_decision(make):
    """Convexity and closedness are of the surface, however many vertices lie at a position."""
    shape = make()
    positions = np.asarray(getattr(shape, "vertices", getattr(shape, "positions", None)), float)
    raw = RawMesh(positions, np.asarray(shape.faces, np.int64))
    found = {}
    for angle in (180.0, 30.0):
        mesh, report = repair(raw, "test", orient_outward=True, crease_angle_deg=angle)
        assert (report.crease_vertices > 0) == (angle == 30.0)
        by_name, _, _ = decisions([mesh], watertight=report.watertight)
        found[angle] = (convexity_defect(mesh), by_name["self_shadowing"].taken)
    assert found[180.0] == found[30.0]
    assert found[30.0][1] == (found[30.0][0] > 1e-6)


def balls(distance, *, dented=False):
    one, other = sphere_mesh(3), dented_sphere() if dented else sphere_mesh(3)
    positions = np.concatenate([one.positions, other.positions + np.array([distance, 0.0, 0.0])])
    faces = np.concatenate([one.faces, other.faces + len(one.positions)]).astype(np.int32)
    return Mesh(positions, faces, np.concatenate([one.normals, other.normals]), None)


@pytest.mark.parametrize("factorisation", [DIFFUSE, GLOSSY], ids=["diffuse", "glossy"])
def test_the_bound_on_scattered_shadows_holds_at_the_worst_point(factorisation):
    """Against the disc that one ball is in the sky of the point of the other that faces it."""
    for distance in (6.0, 20.0):
        half = np.arcsin(1.0 / (distance - 1.0))
        # straight up, where the diffuse transfer is largest; the glossy one is not smooth there
        polar = np.linspace(0.0, half, 400)
        local = np.stack([np.sin(polar), np.zeros(400), np.cos(polar)], axis=1)
        density = (factorisation.eval_psi(local) ** 2).sum(axis=1) * local[:, 2] ** 2
        lost = 2.0 * np.pi * np.trapezoid(density * np.sin(polar), polar)
        polar = np.linspace(0.0, 0.5 * np.pi, 4000)
        local = np.stack([np.sin(polar), np.zeros(4000), np.cos(polar)], axis=1)
        density = (factorisation.eval_psi(local) ** 2).sum(axis=1) * local[:, 2] ** 2
        whole = 2.0 * np.pi * np.trapezoid(density * np.sin(polar), polar)
        bound = scattered_shadows(balls(distance), factorisation)
        assert bound > lost / (whole - lost)
        if factorisation is DIFFUSE:
            # the facing point is the worst, and there the bound is nearly tight
            assert bound == pytest.approx(lost / (whole - lost), rel=0.05)


def test_balls_far_apart_need_no_shadows_and_near_ones_do():
    for distance, taken in ((80.0, False), (6.0, True)):
        by_name, _, _ = decisions([balls(distance)], watertight=True)
        assert by_name["self_shadowing"].taken == taken
    assert "far apart" in decisions([balls(80.0)], watertight=True)[0]["self_shadowing"].reason
    # what proves nothing: a dent, pieces in each other, an open surface
    assert scattered_shadows(balls(80.0, dented=True), DIFFUSE) == float("inf")
    assert scattered_shadows(balls(0.5), DIFFUSE) == float("inf")
    assert decisions([balls(80.0)], watertight=False)[0]["self_shadowing"].taken


def test_a_small_object_on_a_wide_plane_keeps_its_shadows():
    """Probes from the plane may all miss the object, yet the plane takes half of its light."""
    ball = sphere_mesh(3)
    plane = receiver_plane(ball.bounds, resolution=64, extent=100.0, gap=0.0)
    for seed in range(4):
        scene = Scene.from_parts([ball, plane])
        found = decide_effects(
            ball, scene, Accelerator(scene.positions, scene.faces),
            names=["ball", "plane"], roles=["object", "receiver"],
            factorisations=[DIFFUSE, DIFFUSE], albedo=Albedo.constant(0.5), watertight=True,
            bake=BakeSettings(), requested=Effects(), seed=seed,
        )  # fmt: skip
        decision = next(d for d in found if d.effect == "receiver_shadows")
        assert decision.taken
        assert decision.predicted_error_otherwise > 0.3


@pytest.mark.parametrize("factorisation", [DIFFUSE, GLOSSY], ids=["diffuse", "glossy"])
def test_the_predicted_error_is_that_of_a_bake_without_shadows(factorisation):
    """Transport without shadows less transport with them is what is blocked: energies subtract."""
    pot = teapot(6)
    scene = Scene.from_parts([pot])
    accelerator = Accelerator(scene.positions, scene.faces)
    energies = []
    for shadows in (True, False):
        block = bake_block(
            scene, accelerator, (0, scene.n_vertices), factorisation=factorisation,
            projection=SrbfBasis(icosphere(1)).projection(CUBE.directions, CUBE.weights),
            directions=CUBE, shadows=shadows,
        )  # fmt: skip
        energies.append(float(scene.areas @ block.signal_energy))
    ratio, _, _ = probe_occlusion(scene, accelerator, 0, factorisation, seed=3)
    # 512 vertices and 64 rays each: up to 11 % over four seeds were measured
    assert ratio == pytest.approx(energies[1] / energies[0] - 1.0, rel=0.15)


def test_a_glossy_part_loses_another_share_to_shadows_than_a_diffuse_one():
    """Negative twin of the above: the diffuse figure would not do for the glossy part."""
    pot = teapot(6)
    scene = Scene.from_parts([pot])
    accelerator = Accelerator(scene.positions, scene.faces)
    diffuse, _, _ = probe_occlusion(scene, accelerator, 0, DIFFUSE, seed=3)
    glossy, _, _ = probe_occlusion(scene, accelerator, 0, GLOSSY, seed=3)
    assert glossy > 1.2 * diffuse


def test_an_open_mesh_is_never_called_convex():
    ball = sphere_mesh(2)
    by_name, _, _ = decisions([ball], watertight=False)
    assert by_name["self_shadowing"].taken


def test_a_receiver_brings_shadows_both_ways_even_to_a_convex_object():
    ball = sphere_mesh(3)
    plane = receiver_plane(ball.bounds, resolution=16, extent=2.0, gap=0.0)
    by_name, found, _ = decisions([ball, plane], watertight=True)
    assert by_name["receiver_shadows"].taken
    assert occluders_of(0, ["object", "receiver"], found) == (1,)
    assert occluders_of(1, ["object", "receiver"], found) == (0,)


def test_forcing_an_effect_off_reports_the_error_it_was_predicted_to_cost():
    pot = teapot(6)
    by_name, found, _ = decisions([pot], watertight=False, requested=Effects(self_shadowing="off"))
    decision = by_name["self_shadowing"]
    assert (decision.taken, decision.forced) == (False, True)
    assert decision.predicted_error_otherwise > 0.01
    assert occluders_of(0, ["object"], found) == ()


def test_glossy_parts_need_frames_and_view_dependence():
    by_name, _, _ = decisions([sphere_mesh(2)], watertight=True, factorisation=GLOSSY)
    assert by_name["view_dependence"].taken
    assert by_name["tangent_frames"].taken


def test_one_term_costs_the_energy_outside_the_first_unit():
    """Against the quadrature of a true one-term sum on another grid; the grids differ by 1 %."""
    single = factorise(GLOSSY.brdf, n_terms=1)
    expected = check_factorisation(GLOSSY.brdf, single).relative_error
    for switch, factorisation in (("auto", GLOSSY), ("on", GLOSSY), ("off", single)):
        by_name, _, _ = decisions(
            [sphere_mesh(2)], watertight=True, factorisation=factorisation,
            requested=Effects(view_dependence=switch),
        )  # fmt: skip
        decision = by_name["view_dependence"]
        assert (decision.taken, decision.forced) == (switch != "off", switch != "auto")
        assert decision.predicted_error_otherwise == pytest.approx(expected, rel=0.02)
    # negative twin: what the kept terms lose is another figure
    assert pytest.approx(expected, rel=0.02) != GLOSSY.energy_lost


def test_view_dependence_forced_on_has_nothing_to_take_of_a_lambertian():
    by_name, _, _ = decisions(
        [sphere_mesh(2)], watertight=True, requested=Effects(view_dependence="on")
    )
    decision = by_name["view_dependence"]
    assert (decision.taken, decision.forced) == (False, True)
    assert "nothing to take" in decision.reason
    assert decision.predicted_error_otherwise == 0.0


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_convexity_does_not_depend_on_scale(scale):
    ball, dent = sphere_mesh(3), dented_sphere()
    assert convexity_defect(Mesh(ball.positions * scale, ball.faces, ball.normals, None)) < 1e-6
    assert convexity_defect(Mesh(dent.positions * scale, dent.faces, dent.normals, None)) > 1e-3


def test_a_flat_mesh_has_no_hull_and_is_not_called_convex():
    plane = receiver_plane(np.array([[-1.0, 0, -1], [1, 0, 1]]), resolution=4, extent=1.0, gap=0.0)
    assert convexity_defect(plane) == float("inf")


def test_convexity_agrees_with_the_hull_on_random_solids():
    """A convex hull has no defect; pushing one of its vertices in makes one."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        hull = trimesh.convex.convex_hull(rng.standard_normal((40, 3)))
        positions, faces = np.asarray(hull.vertices), np.asarray(hull.faces, np.int32)
        solid = Mesh(positions, faces, vertex_normals(positions, faces), None)
        assert convexity_defect(solid) < 1e-12
        dented = positions.copy()
        dented[0] = 0.3 * positions[0] + 0.7 * positions.mean(axis=0)
        assert convexity_defect(Mesh(dented, faces, vertex_normals(dented, faces), None)) > 1e-3


def test_seams_do_not_open_a_mesh():
    """A sphere whose every face has vertices of its own is still closed and convex."""
    ball = sphere_mesh(2)
    positions = ball.positions[ball.faces].reshape(-1, 3)
    faces = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
    assert convexity_defect(Mesh(positions, faces, positions.copy(), None)) < 1e-12


def test_convexity_takes_linear_time():
    """Counted in numpy's own work: 16 times the faces, no more than 40 times the memory's peak."""
    peaks = []
    for level in (3, 5):
        ball = sphere_mesh(level)
        tracemalloc.start()
        convexity_defect(ball)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 40 * peaks[0]
