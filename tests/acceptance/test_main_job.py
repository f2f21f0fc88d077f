"""The main job through service, workers, SDK and command line, all of them processes."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from prtbake import Asset, InvalidRequest
from prtbake_storage.contract.jobs import JobState
from prtbake_storage.decode.relight import project_light, rotation_matrix
from prtbake_storage.hdf5.light import read_light
from prtbake_storage.hdf5.transfer import open_transfer
from support.deployment import Installation, until
from support.main_job import GLOSSY, HEAVY_BAKE, SETTINGS, Finished, main_request

pytestmark = pytest.mark.acceptance

FILES = {
    "transfer.h5", "asset.h5", "asset-float32.h5", "light.h5", "preview-front.png",
    "preview-front.exr", "validation-front.png", "report.json", "report.html",
}  # fmt: skip
STAGES = [
    "plan", "bake", "scattering", "bounces", "add_bounces", "join", "compress", "quantise",
    "fit_light", "render", "validate", "report",
]  # fmt: skip
QUADRANTS = np.array([[[220, 40, 40], [40, 200, 40]], [[40, 60, 220], [230, 210, 40]]], np.uint8)


@pytest.fixture(scope="module")
def glossy(
    local: Installation, undisturbed: Finished, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The folder with everything that the glossy job left."""
    folder = tmp_path_factory.mktemp("glossy")
    local.client.download_all(undisturbed.job.id, folder)
    return folder


def test_the_main_job_succeeds(undisturbed: Finished) -> None:
    job = undisturbed.job
    assert job.state is JobState.succeeded, job.error
    assert {artefact.name for artefact in job.artefacts} == FILES
    assert job.result is not None
    # the report cannot tell how long it took itself
    assert set(job.result["seconds"]) == {*STAGES[:-1], "total"}
    assert job.result["renderer"]["backend"] in ("egl", "cpu")
    assert job.result["renderer"]["backend"] == "egl" or job.result["renderer"]["reason"]


def test_progress_never_falls(undisturbed: Finished) -> None:
    states = [event.data["state"] for event in undisturbed.events if event.type == "state"]
    assert states == ["queued", "running", "succeeded"]
    progress = [event.data for event in undisturbed.events if event.type == "progress"]
    fractions = [one["fraction"] for one in progress]
    assert fractions == sorted(fractions)
    assert 0.0 <= fractions[0] < fractions[-1] <= 1.0
    # every stage was seen, in its turn
    assert list(dict.fromkeys(one["stage"] for one in progress if one["stage"])) == STAGES
    assert undisturbed.job.progress.fraction == 1.0
    ids = [event.id for event in undisturbed.events]
    assert ids == sorted(set(ids))


def test_every_file_arrives_whole(undisturbed: Finished, glossy: Path) -> None:
    assert {path.name for path in glossy.iterdir()} == FILES
    for artefact in undisturbed.job.artefacts:
        data = (glossy / artefact.name).read_bytes()
        assert len(data) == artefact.size
        assert f"sha256:{hashlib.sha256(data).hexdigest()}" == artefact.sha256, artefact.name


def test_the_budget_closes(glossy: Path, undisturbed: Finished) -> None:
    report = json.loads((glossy / "report.json").read_text())
    budget = report["budget"]
    lines = sum(line["error"] for line in budget["lines"])
    assert budget["total"] <= lines
    assert budget["total"] >= lines / 3
    assert undisturbed.job.result is not None
    assert undisturbed.job.result["budget"] == budget
    assert report["summary"] in (glossy / "report.html").read_text()


def test_the_asset_relights(glossy: Path) -> None:
    """The decoder's colours against the transfer file's own product with the light."""
    asset = Asset.open(glossy / "asset.h5")
    light = read_light(glossy / "light.h5")
    rotation = (180.0, 0.0, 0.0)
    diffuse = asset.data.parts[1]
    with open_transfer(glossy / "transfer.h5") as transfer:
        matrix = transfer.read(1).astype(np.float64)[:, 0]
    expected = {
        turn: matrix @ project_light(asset.data.basis, light, rotation_matrix(turn))
        for turn in ((0.0, 0.0, 0.0), rotation)
    }
    for turn, radiance in expected.items():
        decoded = asset.relight(light, rotation=turn)[1]
        assert decoded.shape == (diffuse.n_vertices, 1, 3)
        # the compression of this tiny plane keeps 8 components: some percent
        assert difference(decoded[:, 0], radiance) < 0.1
    # the wrong light would not do
    assert difference(expected[rotation], expected[0.0, 0.0, 0.0]) > 0.5
    eye = asset.positions.mean(axis=0) + np.array([0.0, 3.0, 6.0])
    colours = asset.vertex_radiance(eye, light)
    assert np.isfinite(colours).all()
    assert colours.mean() > 0


def test_a_textured_mesh_through_the_command_line(local: Installation, tmp_path: Path) -> None:
    """Estimate, submit, wait, look, download: what a person types."""
    write_box(tmp_path / "box.obj", 4)
    Image.fromarray(QUADRANTS.repeat(8, axis=0).repeat(8, axis=1)).save(tmp_path / "albedo.png")
    options = [
        "asset", "--mesh", tmp_path / "box.obj", "--brdf", "lambert,albedo=0.8",
        "--albedo-texture", tmp_path / "albedo.png", "--receiver", "resolution=8",
        "--environment", local.environment, "--quality", "draft", "--label", "a painted box",
    ]  # fmt: skip
    for stage, fields in (SETTINGS | {"bake": {"cube_resolution": 12, "n_centres": 162}}).items():
        options += [
            text
            for name, value in fields.items()
            for text in ("--set", f"{stage}.{name}={json.dumps(value)}")
        ]
    estimate = json.loads(local.command("estimate", *options, "-o", "json").stdout)
    assert [part["name"] for part in estimate["plan"]["parts"]] == ["object", "receiver"]
    assert estimate["total_seconds"] > 0
    done = local.command("submit", *options, "--wait", "-o", "json")
    job = json.loads(done.stdout)
    assert job["state"] == "succeeded"
    assert "100%" in done.stderr
    assert {artefact["name"] for artefact in job["artefacts"]} == FILES

    listed = json.loads(local.command("ls", "--label", "a painted box", "-o", "json").stdout)
    assert [one["id"] for one in listed] == [job["id"]]
    logged = [
        json.loads(line)
        for line in local.command("logs", job["id"], "-o", "json").stdout.splitlines()
    ]
    assert logged[-1]["data"]["state"] == "succeeded"
    names = ["asset.h5", "light.h5", "validation-front.png", "report.json"]
    local.command("get", job["id"], *names, "--to", tmp_path / "out")
    digests = {artefact["name"]: artefact["sha256"] for artefact in job["artefacts"]}
    for name in names:
        data = (tmp_path / "out" / name).read_bytes()
        assert f"sha256:{hashlib.sha256(data).hexdigest()}" == digests[name]
    with Image.open(tmp_path / "out" / "validation-front.png") as picture:
        picture.load()
        width, height = picture.size
        assert width >= 3 * 48
        assert height >= 36
    check_quadrants(Asset.open(tmp_path / "out" / "asset.h5"), tmp_path / "out" / "light.h5")
    budget = json.loads((tmp_path / "out" / "report.json").read_text())["budget"]
    assert budget["sum_of_lines"] / 3 <= budget["total"] <= budget["sum_of_lines"]


def test_two_materials_and_a_painted_plane_over_rest(local: Installation, tmp_path: Path) -> None:
    """The teapot with a glossy lid on a tiled plane, from a request in JSON."""
    Image.fromarray(QUADRANTS.repeat(8, axis=0).repeat(8, axis=1)).save(tmp_path / "tiles.png")
    tiles = local.client.upload(tmp_path / "tiles.png").digest
    request = main_request(local) | {
        "label": "a glossy lid",
        "brdf": {"model": "lambert", "albedo": 0.6},
        "materials": {"lid": {"brdf": GLOSSY}},
        "receiver": {"resolution": 12, "albedo_texture": tiles, "texture_repeats": 2},
    }
    found = local.client.estimate(request).plan["parts"]
    parts = [("body, handle, spout", "object"), ("lid", "object"), ("receiver", "receiver")]
    assert [(part["name"], part["role"]) for part in found] == parts
    job = local.client.wait(local.client.submit(request).id)
    assert job.state is JobState.succeeded, job.error
    assert {artefact.name for artefact in job.artefacts} == FILES
    assert job.result is not None
    budget = job.result["budget"]
    assert budget["sum_of_lines"] / 3 <= budget["total"] <= budget["sum_of_lines"]
    assert {name for name, _ in parts} <= set(job.result["errors"]["bake"])
    local.client.download_all(job.id, tmp_path / "out")
    asset = Asset.open(tmp_path / "out" / "asset.h5")
    assert [(part.name, part.role) for part in asset.data.parts] == parts
    assert asset.data.parts[2].albedo_texture is not None

    with pytest.raises(InvalidRequest, match="'body', 'lid', 'handle', 'spout'") as refused:
        local.client.submit(request | {"materials": {"knob": {"brdf": GLOSSY}}})
    assert refused.value.problem.pointer == "/materials/knob"


def check_quadrants(asset: Asset, light: Path) -> None:
    """Lit points have the texture's hue, each in its own quarter of the square."""
    unpainted = asset.relight(light)[0][:, 0]
    eye = asset.positions.mean(axis=0) + np.array([4.0, 5.0, 6.0])
    colours = asset.vertex_radiance(eye, light)
    assert asset.data.uv is not None
    encoded = QUADRANTS.astype(np.float64) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    box = asset.data.parts[0]
    uv = asset.data.uv[slice(*box.vertex_range)].astype(np.float64)
    seen = colours[slice(*box.vertex_range)].max(axis=1) > 0
    # away from the borders, where the bilinear lookup mixes two quarters
    inside = seen & np.all(np.abs(uv % 0.5 - 0.25) < 0.15, axis=1)
    assert inside.sum() >= 4
    hues = set()
    for vertex in np.flatnonzero(inside):
        # v counts from below, rows from the top
        row, column = int(uv[vertex, 1] < 0.5), int(uv[vertex, 0] >= 0.5)
        expected = 0.8 * linear[row, column] * unpainted[vertex]
        np.testing.assert_allclose(colours[vertex], expected, rtol=1e-3)
        hues.add((row, column))
    assert len(hues) == 4


def test_a_mesh_with_a_hole_in_space_is_refused(local: Installation, tmp_path: Path) -> None:
    path = tmp_path / "nan.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 nan 1\nv 0 1 0\nf 1 2 3\nf 1 2 4\n")
    with pytest.raises(InvalidRequest) as refused:
        local.client.add_mesh(path)
    problem = refused.value.problem
    assert (problem.status, problem.code) == (400, "invalid-mesh")
    assert "vertex 2" in problem.detail
    assert "nan" in problem.detail
    told = local.command("register", "mesh", path, code=6).stderr
    assert problem.detail in told


def test_a_request_that_makes_no_sense_is_refused(local: Installation) -> None:
    options = ["--mesh", local.mesh, "--environment", local.environment, "--brdf", "ggx,alpha=0.3"]
    told = local.command("submit", "asset", *options, "--set", "bake.n_terms=0", code=6).stderr
    assert "n_terms" in told
    local.command("show", "no-such-job", code=6)


def test_a_job_is_cancelled_over_rest(local: Installation) -> None:
    job = local.client.submit(HEAVY_BAKE | {"mesh": local.mesh})
    until(lambda: local.client.job(job.id).progress.stage == "bake", "the bake")
    assert local.client.cancel(job.id).state in ("cancel_requested", "canceled")
    local.command("wait", job.id, code=4)
    ended = local.client.job(job.id)
    assert (ended.state, ended.artefacts, ended.result) == ("canceled", [], None)
    # once more changes nothing
    assert local.client.cancel(job.id).state == "canceled"
    events = list(local.client.events(job.id))
    assert [event.data["state"] for event in events if event.type == "state"] == [
        "queued", "running", "cancel_requested", "canceled",
    ]  # fmt: skip


def write_box(path: Path, cells: int) -> None:
    """A unit cube whose six sides each carry the whole texture, ``cells`` squares along an edge."""
    lines: list[str] = []
    steps = np.linspace(0.0, 1.0, cells + 1)
    for axis in range(3):
        for end in (0.0, 1.0):
            for v in steps:
                for u in steps:
                    across = u if end else 1.0 - u  # so that all sides wind outwards
                    point = np.roll([end, across, v], axis)
                    lines.append("v {:.6f} {:.6f} {:.6f}".format(*point))
                    lines.append(f"vt {u:.6f} {v:.6f}")
    row = cells + 1
    for side in range(6):
        for j in range(cells):
            for i in range(cells):
                first = 1 + side * row * row + j * row + i
                corners = (first, first + 1, first + 1 + row, first + row)
                lines.append("f " + " ".join(f"{n}/{n}" for n in corners))
    path.write_text("\n".join(lines) + "\n")


def difference(a: np.ndarray, b: np.ndarray) -> float:
    """L2 norm of a - b over that of b."""
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
