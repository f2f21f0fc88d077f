"""Several materials on one mesh, through the real stages."""

import io
import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from prtbake_storage.contract.jobs import BakeRequest
from prtbake_storage.contract.materials import MOST_MATERIALS
from prtbake_storage.contract.settings import Camera
from prtbake_storage.errors import InputError, SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.jobs.inputs import load_mesh
from prtbake_workers.jobs.materials import part_inputs, part_names
from prtbake_workers.jobs.plan import arguments
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.validate import scene_of
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.validation.hits import trace_camera
from support.local_stages import registered
from support.scenes import GLOSSY, asset_request, context_of, run_asset, run_until, validation_of

TEAPOT = {"builtin": {"name": "teapot", "tessellation": 3}}
SKY = {"builtin": {"name": "sun_sky", "width": 64}}
# a BRDF that is not quite another, so that its part stays one of its own
GREY, GREY_AGAIN = ({"model": "lambert", "albedo": albedo} for albedo in (0.5, 0.5 + 1e-12))
SHINY, SHINY_AGAIN = GLOSSY, GLOSSY | {"kd": GLOSSY["kd"] + 1e-12}
CHECKS = np.array([[[230, 40, 40], [40, 60, 220]], [[40, 60, 220], [230, 40, 40]]], np.uint8)


def png(pixels):
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "png")
    return buffer.getvalue()


def obj(positions, faces, groups, normals=None):
    """An OBJ file whose every face names its material; rows of six hold colours too."""
    lines = ["v " + " ".join(f"{value:.17g}" for value in row) for row in positions]
    lines += [
        "vn {:.17g} {:.17g} {:.17g}".format(*row) for row in ([] if normals is None else normals)
    ]
    corner = "{0}" if normals is None else "{0}//{0}"
    for face, group in zip(faces + 1, groups, strict=True):
        lines += [f"usemtl {group}", "f " + " ".join(corner.format(index) for index in face)]
    return "\n".join(lines).encode()


@pytest.fixture(scope="module")
def bowl(store):
    """A closed, dented ball whose border of groups runs through the dent."""
    ball = sphere_mesh(2)
    positions = ball.positions.copy()
    top = positions[:, 1] > 1.2
    positions[top, 1] = 2.4 - positions[top, 1]
    sides = np.where(positions[ball.faces].mean(axis=1)[:, 0] > 0.05, "east", "west")
    return {"blob": store.put_bytes(obj(positions, ball.faces, sides)), "format": "obj"}


def run_bowl(store, bowl, last, **changes):
    # bounces are drawn at random, anew for every numbering of the vertices
    request = asset_request(
        receiver=None, effects={"interreflection": "off"},
        # nothing is lost to clusters and components
        settings={"compress": {"n_clusters": 1, "n_components": 162}}, **changes,
    )  # fmt: skip
    return run_until(store, request, context_of(store, request, bowl, SKY), last)


def transfer_of(store, results):
    """Scene, coefficients of every part, and the parts of a baked transfer."""
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        parts = transfer.header.parts
        return scene_of(transfer.header), [transfer.read(i) for i in range(len(parts))], parts


@pytest.mark.parametrize(("brdf", "again"), [(GREY, GREY_AGAIN), (SHINY, SHINY_AGAIN)])
def test_two_groups_of_one_brdf_give_the_transfer_of_the_whole(store, bowl, brdf, again):
    """Through plan, bake and join; at 16 bits the two may be off by a step of them."""
    whole, (expected,), _ = transfer_of(store, run_bowl(store, bowl, "join", brdf=brdf))
    results = run_bowl(store, bowl, "join", brdf=brdf, materials={"east": {"brdf": again}})
    cut, pieces, parts = transfer_of(store, results)
    assert [(part.name, part.role) for part in parts] == [("east", "object"), ("west", "object")]
    assert results["plan"][0]["plan"]["parts"][1]["occluders"] == [0, 1]
    # the border is in both parts
    assert cut.n_vertices > whole.n_vertices == 162
    _, source = cKDTree(whole.positions).query(cut.positions)
    np.testing.assert_array_equal(whole.positions[source], cut.positions)
    np.testing.assert_array_equal(whole.normals[source], cut.normals)
    expected = expected[source]
    step = np.abs(expected).max(axis=2, keepdims=True) / 32767
    assert (np.abs(np.concatenate(pieces) - expected) <= 1.1 * step).all()


def test_two_groups_of_one_brdf_give_the_picture_of_the_whole(store, bowl):
    """Through compression and renderer, to a level of 8 bits, border included."""
    pictures = {}
    for name, materials in (
        ("whole", {}),
        ("cut", {"east": {"brdf": GREY_AGAIN}}),
        ("darker", {"east": {"brdf": GREY | {"albedo": 0.45}}}),
    ):
        results = run_bowl(store, bowl, "render", brdf=GREY, materials=materials)
        found = {one["name"]: one["digest"] for one in results["render"][0]["pictures"]}
        data = store.read_bytes(found["preview-front.png"])
        pixels = np.asarray(Image.open(io.BytesIO(data)), np.float64)
        # a level is one of the colour times its coverage: they were divided by that
        pictures[name] = pixels[..., :3] * pixels[..., 3:] / 255.0
    assert np.ptp(pictures["whole"]) > 100
    assert np.abs(pictures["cut"] - pictures["whole"]).max() < 1.1
    # negative twin: a tenth less of the light would show
    assert np.abs(pictures["darker"] - pictures["whole"]).max() > 5


@pytest.fixture(scope="module")
def mixed(store):
    """A diffuse body, a glossy lid, one green triangle, and a painted plane."""
    mesh, _ = load_mesh(store, registered(store, "mesh", **TEAPOT)["canonical"])
    groups = np.array(["body", "lid", "body", "body"])[mesh.face_groups]
    groups[40] = "chip"
    data = obj(mesh.positions, mesh.faces, groups, mesh.normals)
    request = asset_request(
        brdf={"model": "lambert", "albedo": 0.6},
        materials={
            "lid": {"brdf": GLOSSY},
            "chip": {"brdf": {"model": "lambert", "albedo": [0.1, 0.8, 0.1]}},
        },
        receiver={
            "resolution": 16,
            "albedo": 0.9,
            "albedo_texture": store.put_bytes(png(CHECKS.repeat(8, axis=0).repeat(8, axis=1))),
            "texture_repeats": 2.0,
        },
        settings={"validation": {"cameras": [{"name": "front"}], "passes": 2}},
    )
    context = context_of(store, request, {"blob": store.put_bytes(data), "format": "obj"}, SKY)
    return request, context, run_asset(store, request, context)


def test_every_material_is_a_part_and_tells_its_role(mixed, store):
    *_, results = mixed
    asset = read_asset(store.local_path(results["quantise"][0]["asset"]))
    named = [(part.name, part.role, part.material["model"]) for part in asset.parts]
    assert named == [
        ("body", "object", "lambert"),
        ("chip", "object", "lambert"),
        ("lid", "object", "cook_torrance"),
        ("receiver", "receiver", "lambert"),
    ]
    # a part of one triangle has three vertices, and no more clusters than these
    assert asset.parts[1].n_vertices == 3
    assert asset.parts[1].n_clusters <= 3
    assert asset.parts[3].albedo_texture is not None
    assert len(asset.object_ranges) == 3
    result = REGISTRY.finish("asset", *mixed).result
    assert [(part["name"], part["role"]) for part in result["parts"]] == [
        (name, role) for name, role, _ in named
    ]
    assert set(result["errors"]["bake"]) >= {"body", "chip", "lid", "receiver"}


def test_the_object_shadows_itself_across_its_parts(mixed):
    *_, results = mixed
    parts = {part["name"]: part for part in results["plan"][0]["plan"]["parts"]}
    for name in ("body", "chip", "lid"):
        assert parts[name]["occluders"] == [0, 1, 2, 3]
    assert parts["receiver"]["occluders"] == [0, 1, 2]
    effects = {one["effect"]: one for one in results["plan"][0]["plan"]["effects"]}
    assert set(effects["self_shadowing"]["evidence"]["blocked_share_of"]) == {"body", "chip", "lid"}
    assert "body 1, chip 1, lid" in effects["view_dependence"]["reason"]


def test_the_budget_of_several_materials_closes(mixed):
    result = REGISTRY.finish("asset", *mixed).result
    budget = result["budget"]
    assert budget["total"] <= budget["sum_of_lines"]
    # a draft of 162 SRBFs, 4 clusters a part and 64 samples a pixel: 10 % were measured
    assert budget["total"] < 0.2


def test_the_picture_shows_every_material_beside_the_reference(mixed, store):
    """Means over the pixels of each part, channel by channel, in reference and delivered asset."""
    request, context, results = mixed
    validation = validation_of(store, results, context["environment"]["canonical"])
    view = results["validate"][0]["views"][0]
    whole = np.asarray(
        Image.open(io.BytesIO(store.read_bytes(view["pictures"]["front.png"]))), np.float64
    )
    width, height = (request["settings"]["validation"][name] for name in ("width", "height"))
    # three pictures with gaps between them
    gap = (whole.shape[1] - 3 * width) // 2
    reference, delivered = whole[:, :width], whole[:, width + gap : 2 * width + gap]
    hits = trace_camera(validation, Camera(name="front"), width, height)
    means = {}
    for index, part in enumerate(validation.delivered.parts):
        own = hits.pixels[hits.parts == index]
        if len(own) < 20:
            continue
        means[part.name] = [
            picture.reshape(-1, 3)[own].mean(axis=0) for picture in (reference, delivered)
        ]
        # sRGB steps
        assert np.abs(np.subtract(*means[part.name])).max() < 12.0
    assert set(means) == {"body", "lid", "receiver"}
    # the checks are red and blue, half and half: no green
    red, green, blue = means["receiver"][1]
    assert min(red, blue) > 1.5 * green


def test_the_texture_lies_upright_and_repeats(mixed, store):
    """Seen from above with -z away from the viewer, the upper left of the picture is at -x, -z."""
    *_, results = mixed
    asset = read_asset(store.local_path(results["quantise"][0]["asset"]))
    part = asset.parts[3]
    rows = slice(*part.vertex_range)
    uv, plane = asset.uv[rows], asset.positions[rows]
    low, high = plane.min(axis=0), plane.max(axis=0)
    share = (plane - low) / np.maximum(high - low, 1e-9)
    np.testing.assert_allclose(uv[:, 0], 2.0 * share[:, 0], atol=1e-5)
    np.testing.assert_allclose(uv[:, 1], 2.0 * (1.0 - share[:, 2]), atol=1e-5)


def parts_of(store, request, mesh=TEAPOT):
    """The parts that a request makes, and the plan's arguments."""
    context = context_of(store, request, mesh, SKY)
    settings = StageSettings.for_bake(BakeRequest.model_validate(BASE).settings)
    args = arguments(request, context, settings, "medium")
    loaded, _ = load_mesh(store, context["mesh"]["canonical"])
    return part_inputs(json.loads(json.dumps(args)), loaded, store)


BASE = {"mesh": "mesh-" + "0" * 16, "brdf": GREY}


def names_of(store, **changes):
    return [part.name for part in parts_of(store, asset_request(receiver=None, **changes))]


def test_groups_of_one_material_are_one_part(store):
    assert names_of(store) == ["object"]
    red = {"brdf": {"model": "lambert", "albedo": 0.2}}
    assert names_of(store, materials={"lid": red, "spout": red}) == ["body, handle", "lid, spout"]
    # of all groups: one part again, whatever the top level says
    everything = dict.fromkeys(("body", "lid", "handle", "spout"), red)
    (part,) = parts_of(store, asset_request(receiver=None, materials=everything))
    assert (part.name, part.brdf["albedo"]) == ("object", 0.2)
    # the same as the top level says: nothing is cut
    assert names_of(store, materials={"lid": {"brdf": GLOSSY}}) == ["object"]


@pytest.mark.parametrize(
    ("field", "value", "found"),
    [
        ("tangents", [0.0, 1.0, 0.0], (0.0, 1.0, 0.0)),
        ("subsurface", {"mm_per_unit": 1.0, "medium": "marble"}, None),
        ("albedo_texture", None, None),
    ],
)
def test_groups_that_differ_in_anything_of_a_material_are_apart(store, field, value, found):
    plain = {"brdf": GREY}
    materials = {"lid": plain, "spout": plain | {field: value}}
    parts = parts_of(store, asset_request(receiver=None, materials=materials))
    if value is None:
        # the default, said aloud
        assert [part.name for part in parts] == ["body, handle", "lid, spout"]
        return
    assert [part.name for part in parts] == ["body, handle", "lid", "spout"]
    assert getattr(parts[2], field) == (found or value)
    assert getattr(parts[1], field) != (found or value)


def test_vertex_colours_go_to_the_materials_that_ask_for_them(store):
    """Each part has those of its own vertices."""
    mesh, _ = load_mesh(store, registered(store, "mesh", **TEAPOT)["canonical"])
    shades = np.random.default_rng(3).random((mesh.n_vertices, 3))
    data = obj(
        np.hstack([mesh.positions, shades]), mesh.faces,
        np.array(mesh.group_names)[mesh.face_groups],
    )  # fmt: skip
    painted = {"brdf": {"model": "lambert", "albedo": 0.9}, "vertex_colours": True}
    request = asset_request(receiver=None, brdf=GREY, materials={"lid": painted})
    source = {"blob": store.put_bytes(data), "format": "obj"}
    rest, lid = parts_of(store, request, source)
    assert rest.vertex_colours is None
    assert lid.vertex_colours.shape == (lid.mesh.n_vertices, 3)
    _, place = cKDTree(mesh.positions).query(lid.mesh.positions)
    encoded = shades[place]
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    # stored in float32
    np.testing.assert_allclose(lid.vertex_colours, linear, atol=1e-6)
    with pytest.raises(SettingsError, match="no usable vertex colours") as caught:
        parts_of(store, request)
    assert caught.value.pointer == "/materials/lid/vertex_colours"


def test_parts_are_named_after_their_groups_and_never_alike():
    assert part_names([["a"], ["b", "c"], ["d", "e", "f", "g"]]) == ["a", "b, c", "d and 3 more"]
    assert part_names([["a, b"], ["a", "b"]]) == ["a, b", "a, b (2)"]
    assert part_names([["receiver"], ["object"]]) == ["receiver (2)", "object"]
    (name,) = part_names([["x" * 100, "y"]])
    assert len(name) == 100
    assert name.endswith("x and 1 more")


def test_a_group_that_the_mesh_lacks_is_refused_with_those_there_are(store):
    request = asset_request(materials={"li/d~": {"brdf": GREY}})
    with pytest.raises(SettingsError, match="'body', 'lid', 'handle', 'spout'") as caught:
        parts_of(store, request)
    assert caught.value.pointer == "/materials/li~1d~0"
    with pytest.raises(SettingsError, match="it has none at all"):
        parts_of(store, request, {"builtin": {"name": "icosphere", "tessellation": 1}})


def test_textures_of_materials_and_plane_are_checked_where_they_stand(store):
    picture, broken = store.put_bytes(png(CHECKS)), store.put_bytes(b"no picture")
    lambert = {"model": "lambert"}
    for changes, pointer, kind in (
        # the teapot has no texture coordinates
        ({"materials": {"lid": {"brdf": lambert, "albedo_texture": picture}}},
         "/materials/lid/albedo_texture", SettingsError),
        ({"receiver": {"albedo_texture": broken}}, "/receiver/albedo_texture", InputError),
        ({"receiver": {"albedo_texture": picture, "brdf": GLOSSY}},
         "/receiver/albedo_texture", SettingsError),
        ({"brdf": lambert, "albedo_texture": picture}, "/albedo_texture", SettingsError),
    ):  # fmt: skip
        with pytest.raises(kind) as caught:
            parts_of(store, asset_request(**changes))
        assert caught.value.pointer == pointer


def test_materials_are_bounded_by_the_contract():
    def request(n, **material):
        return BASE | {"materials": {f"g{i}": {"brdf": GREY} | material for i in range(n)}}

    assert len(BakeRequest.model_validate(request(MOST_MATERIALS)).materials) == MOST_MATERIALS
    for wrong, complaint in (
        (request(MOST_MATERIALS + 1), "at most 32 items"),
        (BASE | {"materials": {"": {"brdf": GREY}}}, "at least 1 character"),
        (BASE | {"materials": {"x" * 101: {"brdf": GREY}}}, "at most 100 characters"),
        (BASE | {"materials": {"a\0": {"brdf": GREY}}}, "match pattern"),
        (BASE | {"materials": {"a": {}}}, "Field required"),
    ):
        with pytest.raises(ValueError, match=complaint):
            BakeRequest.model_validate(wrong)
