"""Anisotropic BRDFs through every stage of a job: frames, terms, pictures."""

import functools

import numpy as np
import pytest

from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.brdf.oriented_factorisation import OrientedFactorisation
from prtbake_workers.brdf.stored_factorisation import factorisation_from_tables
from prtbake_workers.geometry.tangents import oriented_frames
from prtbake_workers.jobs import part_factorisations
from prtbake_workers.jobs.inputs import load_mesh
from prtbake_workers.validation.chain import LINES, validate_camera
from support.scenes import (
    asset_request,
    context_of,
    relative_difference,
    run_asset,
    run_until,
    validation_of,
)

ALONG = {"model": "ward", "kd": 0.2, "ks": 0.7, "alpha_x": 0.2, "alpha_y": 0.5}
ACROSS = ALONG | {"alpha_x": 0.5, "alpha_y": 0.2}
SKY = {"builtin": {"name": "sun_sky", "width": 64}}
SETTINGS = ValidateSettings(width=32, height=24, passes=2, samples=48)
TERMS = 24


@pytest.fixture(scope="module", autouse=True)
def coarse_grid():
    """A third of the directions on either side of a BRDF: 6 degrees apart, slopes of 11 and more."""
    coarse = functools.partial(part_factorisations.factorise, n_theta=16, n_phi=64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(part_factorisations, "factorise", coarse)
        yield


def cylinder_obj(around=24, along=6):
    """A tube about y with texture coordinates, u around it; the seam has its own."""
    lines = []
    for j in range(along + 1):
        for i in range(around + 1):
            angle = 2 * np.pi * i / around
            lines += [f"v {np.sin(angle):.9f} {2 * j / along:.9f} {np.cos(angle):.9f}"]
            lines += [f"vt {i / around:.9f} {j / along:.9f}"]
    for j in range(along):
        for i in range(around):
            a = j * (around + 1) + i + 1
            b, c, d = a + 1, a + around + 2, a + around + 1
            lines += [f"f {a}/{a} {b}/{b} {c}/{c}", f"f {a}/{a} {c}/{c} {d}/{d}"]
    return "\n".join(lines).encode()


def request_of(brdf, **changes):
    bake = {"n_terms": TERMS, "n_centres": 42, "cube_resolution": 8}
    compress = {"n_clusters": 1, "ranks": [TERMS, 42, 200]}
    settings = {"bake": bake, "compress": compress}
    return asset_request(brdf=brdf, receiver=None, settings=settings, **changes)


def view_of(store, brdf, **changes):
    request = request_of(brdf, effects={"interreflection": "off"}, **changes)
    blob = store.put_bytes(cylinder_obj())
    context = context_of(store, request, {"blob": blob, "format": "obj"}, SKY)
    results = run_until(store, request, context, "fit_light")
    validation = validation_of(store, results, context["environment"]["canonical"])
    (view,) = validate_camera(validation, Camera(), [np.eye(3)], SETTINGS, seed=1)
    return results, view


@pytest.fixture(scope="module")
def around(store):
    """Brushed around the tube: tangents along u."""
    return view_of(store, ALONG, tangents="uv")


@pytest.fixture(scope="module")
def upright(store):
    """The slopes exchanged and tangents along the axis, a quarter turn from u."""
    return view_of(store, ACROSS, tangents=[0.0, 1.0, 0.0])


def test_frames_follow_u(store, around):
    results, _ = around
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        (part,) = transfer.header.parts
        normals, positions = transfer.header.normals, transfer.header.positions
    x, _, z = normals.T
    expected = np.stack([z, np.zeros(len(z)), -x], axis=1)
    # the tube's normals at its seam are those of facets of 15 degrees
    assert np.abs((part.frames[:, 0] * expected).sum(axis=1)).min() > 0.99
    assert isinstance(factorisation_from_tables(part.factorisation), OrientedFactorisation)
    (decision,) = (
        one for one in results["plan"][0]["plan"]["effects"] if one["effect"] == "tangent_frames"
    )
    assert "along u of the texture coordinates" in decision["reason"]
    assert decision["evidence"]["tangents"][0]["singular"] == 0
    assert len(positions) == 25 * 7


def test_a_quarter_turn_of_frames_and_slopes_changes_no_picture(around, upright):
    (_, one), (_, other) = around, upright
    for name in ("reference", "K terms", "BRDF tables", "SRBF basis", "16-bit transfer"):
        index = LINES.index(name)
        difference = relative_difference(other.chain[index].mean, one.chain[index].mean)
        # tables of a quarter turn mirror each other, up to float32 and the 16 bits of transfer
        assert difference < 1e-3, name
    # full ranks, factors in 16 bits
    assert relative_difference(other.delivered, one.delivered) < 1e-2


def test_a_quarter_turn_of_the_frames_alone_is_seen(store, around, upright):
    """Twin: the slopes stay, the tangents turn."""
    _, wrong = view_of(store, ALONG, tangents=[0.0, 1.0, 0.0])
    assert relative_difference(wrong.reference, around[1].reference) > 0.05
    assert relative_difference(wrong.delivered, around[1].delivered) > 0.05


def test_slopes_that_hardly_differ_give_the_picture_of_equal_ones(store):
    """The anisotropic path beside the isotropic one, from factorisation to asset."""
    equal, nearly = (
        view_of(store, ALONG | {"alpha_x": 0.3, "alpha_y": slope}, tangents="uv")[1]
        for slope in (0.3, 0.3 + 1e-8)
    )
    lines = {line.name: line.error for line in equal.budget.lines}
    for line in nearly.budget.lines:
        # tables of one angle and of two differ by less than either line of theirs
        assert line.error == pytest.approx(lines[line.name], rel=0.02, abs=2e-3)
    # other frames, and tables: 0.1 % of the picture each
    assert relative_difference(nearly.delivered, equal.delivered) < 5e-3


def test_a_whole_job_of_a_brushed_ball_and_plane(store):
    request = request_of(ALONG, tangents=[0.0, 0.0, 1.0])
    request["receiver"] = {"resolution": 6, "brdf": ACROSS}
    request["settings"]["validation"] |= {
        "width": 40, "height": 30, "passes": 2, "samples": 32, "cameras": [{"name": "front"}],
    }  # fmt: skip
    mesh = {"builtin": {"name": "icosphere", "tessellation": 2}}
    context = context_of(store, request, mesh, SKY)
    results = run_asset(store, request, context)
    plan = results["plan"][0]["plan"]
    asset = read_asset(store.local_path(results["quantise"][0]["asset"]))
    mesh, _ = load_mesh(store, context["mesh"]["canonical"])
    expected = oriented_frames(mesh, (0.0, 0.0, 1.0))
    np.testing.assert_allclose(asset.parts[0].frames, expected.frames, atol=1e-3)
    np.testing.assert_allclose(asset.parts[1].frames[:, 0], [[1.0, 0.0, 0.0]] * 36, atol=1e-3)
    assert len(expected.singular) == 2
    first = expected.singular[0]
    (note,) = (note for note in plan["notes"] if "no tangent" in note)
    assert f"2 of {mesh.n_vertices} vertices of object have no tangent along (0, 0, 1)" in note
    assert f"the first is vertex {first} at" in note
    (view,) = results["validate"][0]["views"]
    lines = {line["name"]: line["error"] for line in view["budget"]["lines"]}
    stated = max(results["plan"][0]["errors"].values())
    # one light and one view, against all of them with weights cos_i^2 cos_o^2: measured 0.11
    assert 0.03 < lines["K terms"] ** 2 / stated < 5.0
    assert lines["BRDF tables"] < 0.01
    assert view["budget"]["total"] < 0.7


def test_tangents_of_an_isotropic_brdf_are_said_not_to_be_read(store):
    request = asset_request(receiver=None, tangents=[0.0, 1.0, 0.0])
    mesh = {"builtin": {"name": "icosphere", "tessellation": 1}}
    results = run_until(store, request, context_of(store, request, mesh, SKY), "plan")
    assert any("isotropic" in note for note in results["plan"][0]["plan"]["notes"])
