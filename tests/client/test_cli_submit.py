"""Submission from the command line: words, JSON and files become the request that was meant."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer
from click.testing import Result

from prtbake.cli.exits import Exit
from prtbake.cli.scene_words import medium_value, receiver_value, tangents_value
from prtbake_service.testing import LiveService

Run = Callable[..., Result]
WAX = {
    "brdf": {"model": "lambert", "albedo": 0.9},
    "subsurface": {"medium": "marble", "mm_per_unit": 10},
}


def test_submit_takes_settings(run: Run, service: LiveService, environment: str) -> None:
    options = ["--set", "n_lobes=20", "--set", "max_iterations=3", "--label", "cli", "--seed", 5]
    result = run("submit", "fit-light", "--environment", environment, *options, "-o", "json")
    job = json.loads(result.stdout)
    assert job["request"]["settings"]["n_lobes"] == 20
    assert (job["label"], job["request"]["seed"]) == ("cli", 5)


def test_lights_are_added_and_scaled(run: Run, environment: str) -> None:
    words = ("submit", "fit-light", "--environment", environment, "--add-light")
    made = run(*words, f"0.5*{environment}", "--add-light", environment, "-o", "json")
    assert made.exit_code == 0, made.output
    lights = json.loads(made.stdout)["request"]["lights"]
    assert [(light["environment"], light["scale"]) for light in lights] == [
        (environment, 0.5),
        (environment, 1.0),
    ]
    wrong = run(*words, f"half*{environment}")
    assert wrong.exit_code == 2
    assert "half is no number" in " ".join(wrong.stderr.split())


def test_submit_asset_from_words(
    run: Run, service: LiveService, environment: str, tmp_path: Path
) -> None:
    texture = tmp_path / "albedo.png"
    texture.write_bytes(b"png")
    canonical = service.backend.blobs.put_bytes(b"mesh")
    result = {"canonical": canonical, "understood": {"vertex_colours": True}}
    service.answer_next("register", lambda job: service.succeed(job, result))
    made = run(
        *("submit", "asset", "--mesh", "builtin:teapot:3", "--environment", environment),
        *("--brdf", "lambert,albedo=0.9:0.2:0.1", "--quality", "draft"),
        *("--receiver", "resolution=8,extent=3", "--effect", "self_shadowing=off"),
        *("--subsurface", "marble,mm_per_unit=10", "--tangents", "0:1:-0.5"),
        *("--albedo-texture", texture, "--vertex-colours", "--set", "bake.n_terms=16"),
        *("--set", "bake.n_centres=auto", "--set", "compress.ranks=8,48,24", "-o", "json"),
    )
    assert made.exit_code == 0, made.output
    request = json.loads(made.stdout)["request"]
    assert request["brdf"]["albedo"] == [0.9, 0.2, 0.1]
    assert request["settings"]["bake"] == {"n_terms": 16, "n_centres": "auto"}
    assert request["settings"]["compress"] == {"ranks": [8, 48, 24]}
    assert request["receiver"]["resolution"] == 8
    assert request["effects"]["self_shadowing"] == "off"
    assert request["albedo_texture"].startswith("sha256:")
    assert request["subsurface"]["medium"] == "marble"
    assert request["subsurface"]["mm_per_unit"] == 10.0
    assert request["vertex_colours"] is True
    assert request["tangents"] == [0.0, 1.0, -0.5]
    assert request["two_sided"] is False


def test_submit_asset_with_a_quality_or_a_budget(
    run: Run, service: LiveService, environment: str
) -> None:
    canonical = service.backend.blobs.put_bytes(b"mesh of a budget")
    result = {"canonical": canonical, "understood": {}}
    service.answer_next("register", lambda job: service.succeed(job, result))
    asked = ("--max-error", "0.05", "--max-seconds", "600")
    sized = ("--max-bytes", "50000")
    none = {"max_error": None, "max_bytes": None, "max_seconds": None}
    for options, quality, budget in (
        ((), "medium", None),
        (("--quality", "low"), "low", None),
        (asked[:2], None, none | {"max_error": 0.05}),
        (asked, None, none | {"max_error": 0.05, "max_seconds": 600.0}),
        (sized, "medium", none | {"max_bytes": 50_000}),
        ((*sized, "--quality", "low"), "low", none | {"max_bytes": 50_000}),
    ):
        made = run(
            *("submit", "asset", "--mesh", "builtin:teapot:11", "--environment", environment),
            *("--brdf", "lambert", *options, "-o", "json"),
        )
        assert made.exit_code == 0, made.output
        request = json.loads(made.stdout)["request"]
        assert (request["quality"], request["budget"]) == (quality, budget)


def test_submit_bake_with_a_budget(run: Run, service: LiveService) -> None:
    canonical = service.backend.blobs.put_bytes(b"mesh of a bake's budget")
    result = {"canonical": canonical, "understood": {}}
    service.answer_next("register", lambda job: service.succeed(job, result))
    asked = ("--max-error", "0.1", "--max-bytes", "1000000", "--max-seconds", "60")
    names = ("max_error", "max_bytes", "max_seconds")
    for options, budget in (
        ((), None),
        (asked[:2], dict.fromkeys(names) | {"max_error": 0.1}),
        (asked, dict(zip(names, (0.1, 1_000_000, 60.0), strict=True))),
    ):
        words = ("--mesh", "builtin:teapot:12", "--brdf", "lambert", *options)
        made = run("submit", "bake", *words, "-o", "json")
        assert made.exit_code == 0, made.output
        assert json.loads(made.stdout)["request"]["budget"] == budget


def test_a_quality_beside_a_budget_is_refused(
    run: Run, service: LiveService, environment: str
) -> None:
    made = run(
        *("submit", "asset", "--mesh", "mesh-0000000000000000", "--environment", environment),
        *("--brdf", "lambert", "--max-error", "0.05", "--quality", "low"),
    )
    assert made.exit_code != 0
    assert "one quality or budget" in made.output


def test_submit_materials_from_words(
    run: Run, service: LiveService, environment: str, tmp_path: Path
) -> None:
    """Names may hold blanks and signs; what stands behind them is read as --brdf is."""
    texture = tmp_path / "wood.png"
    texture.write_bytes(b"png of wood")
    canonical = service.backend.blobs.put_bytes(b"a mesh of four groups")
    names = ("lid", "lid top", "wood Brown", "a/b#1", "body")
    groups = [{"name": name, "faces": 1} for name in names]
    result = {"canonical": canonical, "understood": {"groups": groups}}
    service.answer_next("register", lambda job: service.succeed(job, result))
    made = run(
        *("submit", "bake", "--mesh", "builtin:teapot:9", "--brdf", "lambert"),
        *("--material", "lid=ggx,alpha=0.3", "--material", "wood Brown=lambert,albedo=0.9"),
        *("--material", 'a/b#1={"model": "phong", "exponent": 4}', "--two-sided"),
        *("--material", 'lid top={"brdf": {"model": "ggx"}, "two_sided": true}'),
        *("--material", f"body={json.dumps(WAX)}"),
        *("--material-texture", f"wood Brown={texture}", "--receiver-texture", texture),
        *("-o", "json"),
    )
    assert made.exit_code == 0, made.output
    request = json.loads(made.stdout)["request"]
    assert {name: one["brdf"]["model"] for name, one in request["materials"].items()} == {
        "lid": "ggx", "wood Brown": "lambert", "a/b#1": "phong", "body": "lambert",
        "lid top": "ggx",
    }  # fmt: skip
    assert request["materials"]["body"]["subsurface"]["medium"] == "marble"
    digest = request["materials"]["wood Brown"]["albedo_texture"]
    assert service.backend.blobs.read_bytes(digest) == b"png of wood"
    assert request["receiver"]["albedo_texture"] == digest
    assert request["materials"]["lid"]["albedo_texture"] is None
    assert request["two_sided"] is True
    assert [name for name, one in request["materials"].items() if one["two_sided"]] == ["lid top"]


def test_a_plane_is_words_or_json() -> None:
    assert receiver_value("on") == {}
    assert receiver_value("24") == {"resolution": 24}
    assert receiver_value("extent=3,albedo=0.9:0.2:0.1") == {"extent": 3, "albedo": [0.9, 0.2, 0.1]}
    glossy = {"brdf": {"model": "phong", "exponent": 4}}
    assert receiver_value(json.dumps(glossy)) == glossy
    for wrong in ("{", '{"size": 3}', "size=3"):
        with pytest.raises(typer.BadParameter):
            receiver_value(wrong)


def test_a_medium_is_a_name_parameters_or_json() -> None:
    marble = {"medium": "marble", "mm_per_unit": 10}
    assert medium_value("marble,mm_per_unit=10") == marble
    assert medium_value(json.dumps(marble)) == marble
    own = {"scattering": [2, 3, 4], "absorption": 0.1, "mm_per_unit": 2.5, "eta": 1.4}
    assert medium_value("scattering=2:3:4,absorption=0.1,mm_per_unit=2.5,eta=1.4") == own
    for wrong, said in (
        ("{", "not JSON"),
        ("marble", "mm_per_unit: Field required"),
        ("marbel,mm_per_unit=1", "medium: Input should be 'apple'"),
        ("marble,mm_per_unit=1,size=2", "size"),
        ("marble,mm_per_unit=1,absorption=2", "state it or them"),
        ("scattering=0,absorption=0,mm_per_unit=1", "meets nothing"),
        ("scattering=1,mm_per_unit=1", "both scattering and absorption"),
    ):
        with pytest.raises(typer.BadParameter, match=said):
            medium_value(wrong)


def test_tangents_are_a_word_or_a_direction() -> None:
    assert tangents_value("uv") == "uv"
    assert tangents_value("1:0:2.5") == [1.0, 0.0, 2.5]
    for wrong in ("vertical", "1:2", "1:2:x"):
        with pytest.raises(typer.BadParameter, match="0:1:0"):
            tangents_value(wrong)


def test_a_brdf_is_inline_json_or_a_file_to_register(
    run: Run, service: LiveService, environment: str, tmp_path: Path
) -> None:
    canonical = service.backend.blobs.put_bytes(b"parsed")
    result = {"canonical": canonical, "understood": {"spec": {"model": "lambert"}}}
    spec = tmp_path / "spec.json"
    spec.write_text('\n {"model": "ward", "alpha_x": 0.1, "alpha_y": 0.1}')
    measured = tmp_path / "paint.binary"
    measured.write_bytes(b"\x5a\0\0\0 and so on")

    def submitted(path: Path) -> Any:
        service.answer_next("register", lambda job: service.succeed(job, result))
        options = ["--mesh", "builtin:teapot:5", "--brdf", path]
        made = run("submit", "bake", *options, "-o", "json")
        assert made.exit_code == 0, made.output
        return json.loads(made.stdout)["request"]["brdf"]

    # one registration each: the mesh with the first, the measurement with the second
    assert submitted(spec)["alpha_x"] == 0.1
    assert submitted(measured).startswith("brdf-")
    # a row of a table
    resource = submitted(Path(f"{measured}#gold-paint"))
    found = service.backend.resources.get(resource)
    assert found.request["material"] == "gold-paint"


def test_submit_a_file(run: Run, environment: str, tmp_path: Path) -> None:
    path = tmp_path / "request.json"
    path.write_text(json.dumps({"kind": "fit_light", "environment": environment}))
    assert run("submit", "file", path, "--id", "from-a-file").exit_code == 0
    assert run("submit", "file", path, "--id", "from-a-file").exit_code == 0
    path.write_text("[1]")
    assert run("submit", "file", path).exit_code == Exit.usage


def test_submit_a_study(run: Run, environment: str, tmp_path: Path) -> None:
    path = tmp_path / "base.json"
    path.write_text(json.dumps({"kind": "fit_light", "environment": environment}))
    axes = ["--axis", "settings.n_lobes=8,16", "--axis", "settings.max_iterations=2"]
    told = run("submit", "study", path, *axes, "--label", "lobes", "-o", "json")
    assert told.exit_code == 0, told.output
    request = json.loads(told.stdout)["request"]
    assert request["axes"] == [
        {"path": "settings.n_lobes", "values": [8, 16]},
        {"path": "settings.max_iterations", "values": [2]},
    ]
    assert request["base"]["environment"] == environment
    assert not request["skip_illegal"]
    refused = run("submit", "study", path, "--axis", "settings.n_lobes=0,16")
    assert refused.exit_code == Exit.refused
    assert "settings.n_lobes = 0" in refused.stderr
    assert run("submit", "study", path, "--axis", "settings.n_lobes").exit_code == Exit.usage
