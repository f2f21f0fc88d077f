"""A mesh with vertex colours through the stages of a job, beside a texture of the same colours."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.resources import read_mesh
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.scene_file import read_scene
from prtbake_workers.render.images import png_bytes, read_albedo_texture
from prtbake_workers.validation.chain import validate_camera
from support.bounce_scenes import patch
from support.local_stages import registered, run_stages
from support.scenes import asset_request, relative_difference, run_until, validation_of

# sRGB codes of two texels, whose centres lie at u = 1/4 and 3/4: a linear ramp between
TEXELS = np.array([[[240, 40, 60], [40, 90, 235]]], np.uint8)
BAKE = {"n_centres": 42, "bounce_rays": 32, "max_bounces": 3, "bounce_tolerance": 0.0}
SETTINGS = ValidateSettings(width=32, height=24, passes=4, samples=64)
EFFECTS = {"interreflection": "on", "colour_bleeding": "on"}
SKY = {"builtin": {"name": "sun_sky", "width": 64}}


def nook_ply():
    """A floor and two walls as text, with texture coordinates and the ramp as linear floats."""
    meshes = [
        patch((-1, 0, 1), (2, 0, 0), (0, 0, -2), 6, 6),
        patch((-1, 0, -1), (2, 0, 0), (0, 2, 0), 5, 5),
        patch((-1, 0, 1), (0, 0, -2), (0, 2, 0), 5, 5),
    ]
    scene = Scene.from_parts(meshes)
    u = scene.uv[:, :1]
    left, right = read_albedo_texture(png_bytes(TEXELS))[0].astype(np.float64)
    colours = (1 - u) * left + u * right
    rows = np.hstack([scene.positions, scene.normals, 0.25 + 0.5 * scene.uv, colours])
    names = ["x", "y", "z", "nx", "ny", "nz", "s", "t", "red", "green", "blue"]
    header = "".join(f"property float {name}\n" for name in names)
    lines = [" ".join(f"{value:.9g}" for value in row) for row in rows]
    lines += [f"3 {a} {b} {c}" for a, b, c in scene.faces]
    return (
        f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{header}element face "
        f"{scene.n_faces}\nproperty list uchar int vertex_indices\nend_header\n"
        + "\n".join(lines)
        + "\n"
    ).encode()


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return open_store((tmp_path_factory.mktemp("colours") / "blobs").as_uri())


@pytest.fixture(scope="module")
def mesh(store):
    blob = store.put_bytes(nook_ply())
    return registered(store, "mesh", blob=blob, format="ply", orient_outward=False)


@pytest.fixture(scope="module")
def job(store, mesh):
    """Run a job on the nook: results, and the digest of its environment."""
    environment = registered(store, "environment", **SKY)
    texture = store.put_bytes(png_bytes(TEXELS))

    def run(last, *, textured=False, **changes):
        request = asset_request(
            brdf={"model": "lambert", "albedo": 0.9}, receiver=None, effects=EFFECTS,
            settings={"bake": BAKE}, **changes,
        )  # fmt: skip
        context = {
            "mesh": mesh,
            "brdf": {"spec": request["brdf"]},
            "environment": environment,
            "albedo_texture": texture if textured else None,
            "artefacts": {},
        }
        return run_until(store, request, context, last), environment["canonical"]

    return run


@pytest.fixture(scope="module")
def of_vertices(job):
    return job("fit_light", vertex_colours=True)


@pytest.fixture(scope="module")
def of_texture(job):
    return job("fit_light", textured=True)


def coefficients(store, results):
    with open_transfer(store.local_path(results["join"][0]["transfer"])) as transfer:
        return transfer.header.parts[0], transfer.read(0)


def view_of(validation):
    (view,) = validate_camera(validation, Camera(), [np.eye(3)], SETTINGS, seed=1)
    return view


def test_the_mesh_says_what_was_understood(store, mesh):
    understood = mesh["understood"]
    assert understood["vertex_colours"] is True
    assert understood["colour_encoding"] == "linear"
    colours = read_mesh(store.local_path(mesh["canonical"])).colours
    assert colours is not None
    assert len(colours) == understood["n_vertices"]


def test_transfer_and_asset_hold_the_colours_of_the_mesh(store, mesh, of_vertices):
    results, _ = of_vertices
    colours = read_mesh(store.local_path(mesh["canonical"])).colours
    part, _ = coefficients(store, results)
    assert part.vertex_colours.tobytes() == colours.tobytes()
    for name in ("asset", "exact"):
        asset = read_asset(store.local_path(results["quantise"][0][name]))
        assert asset.parts[0].vertex_colours.tobytes() == colours.tobytes()
    assert results["quantise"][0]["groups"]["vertex_colours"] == colours.nbytes
    planned = read_scene(store.local_path(results["plan"][0]["scene"]))
    assert planned.colours[0].tobytes() == colours.tobytes()
    assert planned.header["provenance"]["inputs"]["vertex_colours"] is True


def test_bounces_are_those_of_a_texture_of_the_same_colours(store, job, of_vertices, of_texture):
    part, found = coefficients(store, of_vertices[0])
    _, expected = coefficients(store, of_texture[0])
    assert part.n_channels == 3
    # half a step of 16 bits, twice: 1/65534 of a row's largest
    np.testing.assert_allclose(found, expected, atol=5e-5 * np.abs(expected).max())
    # the negative twin: where the mesh has colours and nobody asks for them, all is grey
    plain, _ = job("join")
    own, grey = coefficients(store, plain)
    assert own.vertex_colours is None
    rows = np.repeat(grey, 3 // own.n_channels, axis=1)
    assert np.abs(rows - expected).max() > 0.02 * np.abs(expected).max()


def test_pictures_are_those_of_a_texture_and_near_the_reference(store, of_vertices, of_texture):
    validation = validation_of(store, *of_vertices)
    view, other = view_of(validation), view_of(validation_of(store, *of_texture))
    # the same seeds: paths differ by what the last bits of an albedo decide
    assert relative_difference(view.reference, other.reference) < 1e-3
    assert relative_difference(view.delivered, other.delivered) < 1e-3
    # 42 SRBFs blur the shadows of the walls
    assert view.budget.total == pytest.approx(other.budget.total, rel=0.01)
    assert view.budget.total < 0.25
    # the negative twin: an asset that lost its colours is far off
    (part,) = validation.delivered.parts
    bare = replace(validation.delivered, parts=(replace(part, vertex_colours=None),))
    assert view_of(replace(validation, delivered=bare)).budget.total > 3 * view.budget.total


def test_colours_and_texture_multiply(store, of_vertices, job):
    results, _ = job("quantise", textured=True, vertex_colours=True)
    part = read_asset(store.local_path(results["quantise"][0]["asset"])).parts[0]
    assert part.albedo_texture is not None
    assert part.vertex_colours is not None
    _, twice = coefficients(store, results)
    _, once = coefficients(store, of_vertices[0])
    # darker: less light goes from surface to surface
    assert (twice.astype(np.float64) ** 2).sum() < 0.999 * (once.astype(np.float64) ** 2).sum()


@pytest.mark.parametrize(
    ("brdf", "builtin"),
    [({"model": "ggx", "alpha": 0.3}, False), ({"model": "lambert"}, True)],
    ids=["glossy", "colourless"],
)
def test_what_cannot_be_coloured_is_refused_before_the_first_ray(store, mesh, brdf, builtin):
    plain = registered(store, "mesh", builtin={"name": "icosphere", "tessellation": 1})
    request = asset_request(brdf=brdf, vertex_colours=True)
    context = {"mesh": plain if builtin else mesh, "brdf": {"spec": brdf}, "artefacts": {}}
    context["environment"] = registered(store, "environment", **SKY)
    with pytest.raises(SettingsError) as caught:
        run_stages(REGISTRY.stages("asset", request, context)[:1], store)
    assert caught.value.pointer == "/vertex_colours"
