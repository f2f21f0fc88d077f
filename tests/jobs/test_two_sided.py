"""Two-sided materials through the stages of a job."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.scene_file import occluder_accelerator, read_scene
from prtbake_workers.jobs.validate import scene_of
from prtbake_workers.validation.chain import validate_camera
from support.bounce_scenes import bowl, disc, patch
from support.scenes import asset_request, context_of, relative_difference, run_until, validation_of

LAMBERT = {"model": "lambert", "albedo": 0.8}
SKY = {"builtin": {"name": "sun_sky", "width": 64}}
BAKE = {"n_centres": 42, "bounce_rays": 32, "max_bounces": 2, "bounce_tolerance": 0.0}
COMPRESS = {"n_clusters": 1, "n_components": 42}
FROM_BELOW = Camera(name="below", elevation_deg=-35.0)
SETTINGS = ValidateSettings(width=40, height=30, passes=4, samples=64, bounce_samples=64, bounces=2)
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
"""Brings the sun and the sky below the horizon."""


def obj(groups, flip=()):
    """An OBJ file of meshes by the name of their group; triangles in ``flip`` are turned over."""
    lines, start, count = [], 1, 0
    for name, mesh in groups.items():
        lines += ["v {:.9g} {:.9g} {:.9g}".format(*row) for row in mesh.positions]
        lines.append(f"usemtl {name}")
        for face in mesh.faces + start:
            corners = face[::-1] if count in flip else face
            lines.append("f {} {} {}".format(*corners))
            count += 1
        start += mesh.n_vertices
    return "\n".join(lines).encode()


def run(store, mesh, last, *, flip=(), settings=None, **changes):
    """Run an asset job on an OBJ file: request, context and results."""
    request = asset_request(**{
        "brdf": LAMBERT, "receiver": None,
        "settings": {"bake": BAKE, "compress": COMPRESS} | (settings or {}),
    } | changes)  # fmt: skip
    source = {"blob": store.put_bytes(obj(mesh, flip)), "format": "obj"}
    context = context_of(store, request, source, SKY)
    return request, context, run_until(store, request, context, last)


def stored(store, results):
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        count = len(transfer.header.parts)
        return transfer.header, [transfer.read(part) for part in range(count)]


def dip():
    """A bowl of half the depth of a hemisphere: smooth, open, and no plane."""
    return {"dip": bowl(5, 16, depth_rad=0.8)}


@pytest.fixture(scope="module")
def both(store):
    return run(store, dip(), "render", two_sided=True, effects={"interreflection": "off"})


@pytest.fixture(scope="module")
def alone(store):
    return run(store, dip(), "render", effects={"interreflection": "off"})


def test_the_flag_is_in_transfer_asset_and_provenance(store, both, alone):
    for (_, _, results), two_sided in ((both, True), (alone, False)):
        header, _ = stored(store, results)
        assert [part.two_sided for part in header.parts] == [two_sided]
        assert header.provenance["inputs"]["two_sided"] is two_sided
        for name in ("asset", "exact"):
            asset = read_asset(store.local_path(results["quantise"][0][name]))
            assert asset.parts[0].two_sided is two_sided
            assert (asset.opposite is None) is not two_sided
        planned = read_scene(store.local_path(results["plan"][0]["scene"]))
        assert planned.scene.two_sided == (two_sided,)


def test_the_front_is_that_of_one_side_and_the_back_is_its_own(store, both, alone):
    header, (found,) = stored(store, both[2])
    _, (front,) = stored(store, alone[2])
    n = len(front)
    assert len(found) == 2 * n == header.parts[0].n_vertices
    # products of twice as many vertices are rounded otherwise, and then to 16 bits
    step = np.abs(front).max(axis=2, keepdims=True) / 32767
    assert (np.abs(found[:n] - front) <= 1.1 * step).all()
    assert (np.abs(found[n:] - front).max(axis=(1, 2)) > 100.0 * step[:, 0, 0]).all()
    # one copy of the triangles is in the way of light
    scene = scene_of(header)
    assert len(scene.traced_faces) == scene.n_faces // 2
    origin = np.array([[0.0, -5.0, 0.1]], np.float32)
    hit = occluder_accelerator(scene, [0]).intersect(origin, np.array([[0, 1, 0]], np.float32))
    assert 0 <= hit.triangles[0] < scene.n_faces // 2


def shown(store, of_job, camera, rotation, settings=SETTINGS):
    """Reference and delivered picture of a view under turned light, and its budget."""
    _, context, results = of_job
    validation = validation_of(store, results, context["environment"]["canonical"])
    (view,) = validate_camera(validation, camera, [rotation], settings, seed=1)
    return view


@pytest.fixture(scope="module")
def gap(store):
    """A floor, and a sheet above it that faces up; light bounces twice between the two."""
    mesh = {
        "floor": patch([-1, 0, 1], [2, 0, 0], [0, 0, -2], 8, 8),
        "sheet": disc(0.9, 0.5, 5, 16, up=True),
    }
    material = {"brdf": LAMBERT | {"albedo": 0.9}}
    effects = {"interreflection": "on", "colour_bleeding": "off"}
    return run(
        store, mesh, "fit_light", effects=effects,
        materials={"sheet": material | {"two_sided": True}},
        settings={"bake": BAKE | {"n_centres": 162, "bounce_rays": 128}},
    )  # fmt: skip


def test_one_material_of_several_has_two_sides(store, gap):
    header, _ = stored(store, gap[2])
    assert {part.name: part.two_sided for part in header.parts} == {"floor": False, "sheet": True}
    inputs = header.provenance["inputs"]
    assert (inputs["two_sided"], inputs["materials"]["sheet"]["two_sided"]) == (False, True)


def test_an_underside_lit_by_bounces_is_that_of_paths(store, gap):
    """Seen from below the floor, which has one side, is not there, and the sheet sees it alone."""
    camera = Camera(name="low", elevation_deg=-10.0)
    lit = shown(store, gap, camera, np.eye(3))
    assert lit.n_hits > 80
    assert lit.delivered.max() > 0.0
    # 3 % were measured: cells of a quarter blur the sheet's shadow, and 6 % of noise are taken off
    assert lit.budget.total < 0.1
    assert lit.delivered.sum() == pytest.approx(lit.reference.sum(), rel=0.05)
    # the negative twin: light that comes by one bounce alone is too little
    settings = SETTINGS.model_copy(update={"bounces": 1})
    one = shown(store, gap, camera, np.eye(3), settings)
    assert one.budget.total > 2.0 * lit.budget.total
    assert lit.delivered.sum() > 1.07 * one.reference.sum()


def test_a_sheet_lit_from_below_is_seen_from_below(store, both, alone):
    lit, black = (shown(store, job, FROM_BELOW, UPSIDE_DOWN) for job in (both, alone))
    assert lit.n_hits > 200
    # 1.3 % were measured, most of it noise of the reference
    assert relative_difference(lit.delivered, lit.reference) < 0.03
    assert lit.reference.mean() > 0.1
    assert not black.delivered.any()
    assert black.n_hits == 0
    # light from above does not pass through: what comes from below then is the ground's
    assert shown(store, both, FROM_BELOW, np.eye(3)).delivered.sum() < 0.3 * lit.delivered.sum()


def pixels(store, results, name):
    found = {one["name"]: one["digest"] for one in results["render"][0]["pictures"]}
    data = np.asarray(Image.open(io.BytesIO(store.read_bytes(found[name]))), np.float64)
    return data[..., :3] * data[..., 3:] / 255.0


def test_mixed_winding_is_right_whatever_it_is(store, both, alone):
    """Half of the triangles turned over in the file: the same two surfaces and pictures."""
    count = dip()["dip"].n_faces
    flip = set(np.flatnonzero(np.random.default_rng(4).random(count) < 0.5).tolist())
    effects = {"interreflection": "off"}
    _, _, mixed = run(store, dip(), "render", flip=flip, two_sided=True, effects=effects)
    front = pixels(store, both[2], "preview-front.png")
    assert front.max() > 100
    assert np.abs(pixels(store, mixed, "preview-front.png") - front).max() < 2.0
    # all turned over: inside out, and with two sides still the same
    _, _, turned = run(
        store, dip(), "render", flip=set(range(count)), two_sided=True, effects=effects
    )
    assert np.abs(pixels(store, turned, "preview-front.png") - front).max() < 2.0
    # the negative twin: with one side the outside is black
    assert np.abs(pixels(store, alone[2], "preview-front.png") - front).max() > 50


def test_a_closed_mesh_is_told_that_its_inside_is_for_nothing(store):
    ball = {"ball": sphere_mesh(1)}
    _, _, results = run(store, ball, "join", two_sided=True)
    plan = results["plan"][0]["plan"]
    assert any("two_sided bakes its 42 vertices for nothing" in note for note in plan["notes"])
    effects = {one["effect"]: one for one in plan["effects"]}
    # a convex mesh needs no ray for its outside; its inside does
    assert effects["self_shadowing"]["taken"]
    assert "two-sided and dark inside" in effects["self_shadowing"]["reason"]
    _, (found,) = stored(store, results)
    energy = (found.astype(np.float64) ** 2).sum(axis=(1, 2))
    # the fast test of rays lets some through that are aimed exactly at an edge
    assert energy[42:].sum() < 1e-2 * energy[:42].sum()
    _, _, one = run(store, ball, "plan")
    plan = one["plan"][0]["plan"]
    assert not any("two_sided" in note for note in plan["notes"])
    assert not plan["effects"][0]["taken"]
    _, _, sheet = run(store, {"sheet": grid_mesh(2, 2)}, "plan", two_sided=True)
    notes = sheet["plan"][0]["plan"]["notes"]
    assert "object has two sides: its 9 vertices are baked twice" in notes
    assert not any("for nothing" in note for note in notes)


def test_frames_of_both_sides_are_right_handed(store):
    """An anisotropic BRDF along x: the tangents of both sides point along it."""
    brdf = {"model": "ward", "alpha_x": 0.2, "alpha_y": 0.5}
    _, _, results = run(
        store, dip(), "join", brdf=brdf, two_sided=True, tangents=[1.0, 0.0, 0.0],
        effects={"interreflection": "off"},
        settings={"bake": BAKE | {"n_terms": 4}},
    )  # fmt: skip
    header, _ = stored(store, results)
    (part,) = header.parts
    assert np.linalg.det(part.frames) == pytest.approx(1.0)
    n = part.n_vertices // 2
    np.testing.assert_allclose(part.frames[:n, 0], part.frames[n:, 0], atol=1e-12)
    np.testing.assert_allclose(part.frames[:n, 1:], -part.frames[n:, 1:], atol=1e-12)


@pytest.mark.parametrize("pointer", ["", "/materials/dip"])
def test_a_medium_between_two_sides_is_refused(store, pointer):
    wax = {"subsurface": {"mm_per_unit": 10.0, "medium": "marble"}, "two_sided": True}
    changes = {"materials": {"dip": {"brdf": LAMBERT} | wax}} if pointer else wax
    request = asset_request(brdf=LAMBERT, receiver=None, **changes)
    source = {"blob": store.put_bytes(obj(dip())), "format": "obj"}
    context = context_of(store, json.loads(json.dumps(request)), source, SKY)
    stages = REGISTRY.stages("asset", request, context)
    with pytest.raises(SettingsError, match="needs an inside") as caught:
        run_until(store, request, context, stages[0].name)
    assert caught.value.pointer == f"{pointer}/two_sided"
