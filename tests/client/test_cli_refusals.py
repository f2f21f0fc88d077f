"""What the command line refuses, or is refused: in which words, with which exit code."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from prtbake.cli.exits import Exit
from prtbake.cli.main import app
from prtbake_service.testing import LiveService
from prtbake_storage.contract.jobs import JobError

Run = Callable[..., Result]


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["wait", "nothing"], Exit.refused, "no job nothing"),
        (["submit", "compress", "--transfer", "bad"], Exit.refused, "/transfer"),
        (["submit", "bake", "--mesh", "no.obj", "--brdf", "lambert"], Exit.usage, "no.obj"),
        (["submit", "bake", "--mesh", "builtin:cow", "--brdf", "lambert"], Exit.usage, "--mesh"),
        (["submit", "bake", "--mesh", "x", "--brdf", "lambert,albedo=2"], Exit.usage, "albedo"),
        (["submit", "bake", "--mesh", "x", "--brdf", "{"], Exit.usage, "not JSON"),
        (
            [
                "submit",
                "bake",
                "--mesh",
                "builtin:teapot",
                "--brdf",
                "lambert",
                "--crease-angle",
                "181",
            ],
            Exit.usage,
            "crease_angle_deg",
        ),
        (
            [
                "submit",
                "bake",
                "--mesh",
                f"mesh-{16 * '0'}",
                "--brdf",
                "lambert",
                "--crease-angle",
                "9",
            ],
            Exit.usage,
            "--crease-angle",
        ),
        (["submit", "fit-light"], Exit.usage, "--environment"),
        (["ls", "--state", "asleep"], Exit.refused, "state"),
    ],
)
def test_refusals(run: Run, arguments: list[str], code: int, said: str) -> None:
    result = run(*arguments)
    assert result.exit_code == code
    assert said in result.stderr
    assert "Traceback" not in result.output


BAKE = ("submit", "bake", "--mesh", "builtin:teapot:3")
SKY = ("submit", "fit-light", "--environment")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((*BAKE, "--brdf", "bogus,m=0.5"), ["bogus", "lambert", "cook_torrance", "ggx"]),
        ((*BAKE, "--brdf", "cook_torrance,zz=7"), ["zz", "kd, ks, m, f0"]),
        ((*BAKE, "--brdf", "lambert", "--receiver", "size=3"), ["size", "resolution, extent"]),
        ((*BAKE, "--brdf", "lambert", "--effect", "fog=on"), ["fog", "self_shadowing"]),
        ((*BAKE, "--brdf", "lambert", "--material", "lid"), ["'lid'", "NAME=", "--material"]),
        (
            (*BAKE, "--brdf", "lambert", "--material", 'lid={"brdf": {}, "tint": 1}'),
            ["'tint'", "tangents", "--material"],
        ),
        ((*BAKE, "--brdf", "lambert", "--material", "lid=bogus"), ["bogus", "--material"]),
        ((*BAKE, "--brdf", "lambert", "--material", "a=lambert", "--material", "a=ggx"), ["twice"]),
        (
            (*BAKE, "--brdf", "lambert", "--material-texture", "lid=x.png"),
            ["'lid' has no BRDF", "--material-texture"],
        ),
        ((*BAKE, "--brdf", "lambert", "--receiver-texture", "no.png"), ["no.png", "--receiver-te"]),
        ((*SKY, "builtin:sun_sky,hour=3"), ["hour", "width, sun_elevation_deg"]),
        ((*SKY, "x.hdr", "--set", "lobes=3"), ["lobes", "n_lobes, max_iterations"]),
        (("submit", "compress", "--transfer", "a/b", "--set", "rank=3"), ["rank", "n_clusters"]),
    ],
)
def test_an_unknown_name_brings_the_known_ones(
    run: Run, arguments: tuple[str, ...], said: list[str]
) -> None:
    result = run(*arguments)
    assert result.exit_code == Exit.usage
    # the message stands in a box that breaks its lines
    told = " ".join(result.stderr.replace("│", " ").split())
    assert all(word in told for word in said), told


@pytest.mark.parametrize(
    ("pair", "said"),
    [
        ("bake.foo=1", ["bake has no 'foo'", "cube_resolution, supersample"]),
        ("baking.n_terms=1", ["no 'baking'", "bake, compress, fit_light, render, validation"]),
        ("bake=1", ["bake.NAME=VALUE"]),
        ("n_terms=16", ["no 'n_terms'; write bake.n_terms"]),
        ("passes=2", ["no 'passes'; write validation.passes"]),
    ],
)
def test_an_unknown_setting_of_a_stage_brings_the_known_ones(
    run: Run, service: LiveService, environment: str, pair: str, said: list[str]
) -> None:
    mesh = "mesh-00000000000000aa"
    scene = ("--mesh", mesh, "--environment", environment, "--brdf", "lambert")
    result = run("submit", "asset", *scene, "--set", pair)
    assert result.exit_code == Exit.usage
    told = " ".join(result.stderr.replace("│", " ").split())
    assert all(word in told for word in said), told


SCENE = ("--mesh", "builtin:teapot:3", "--environment", "builtin:sun_sky", "--brdf", "lambert")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("submit", "asset", *SCENE, "--quality", "meduim"), "'meduim' is none of draft, low"),
        (("demo", "--quality", "meduim"), "'meduim' is none of draft, low"),
        (("submit", "asset", *SCENE, "--mesh-format", "fbx"), "'fbx' is none of auto, obj"),
        (("submit", "asset", *SCENE, "--layout", "dome"), "'dome' is none of auto, lat_long"),
        (("wait", "nothing", "--timeout", "-3"), "'--timeout'"),
        (("watch", "nothing", "--timeout", "-3"), "'--timeout'"),
        ((*BAKE, "--brdf", "lambert,albedo=2"), "albedo: Input should be less than or equal to 1"),
        ((*BAKE, "--brdf", "lambert,albedo=2:0:0"), "albedo: Input should be less than or equal"),
        ((*BAKE, "--brdf", "lambert,albedo=red"), "albedo: Input should be a valid number"),
        ((*BAKE, "--brdf", '{"model": "sgd"}'), "rho_d: Field required"),
        ((*BAKE, "--brdf", '{"albedo": 1}'), "model: Unable"),
        ((*SKY, "builtin:sunsky"), "Invalid value for --environment: name: Input should be 'sun_"),
        ((*SKY, "builtin:hall,width=7"), "Invalid value for --environment: width: Input should"),
        (
            ("submit", "bake", "--mesh", "builtin:teapot:99", "--brdf", "lambert"),
            "Invalid value for --mesh: tessellation: Input should be less than or equal to 64",
        ),
    ],
)
def test_a_wrong_value_is_refused_before_anything_is_sent(
    run: Run, arguments: tuple[str, ...], said: str
) -> None:
    result = run(*arguments)
    assert result.exit_code == Exit.usage
    told = " ".join(result.stderr.replace("│", " ").split())
    assert said in told
    # no trace of how the models are written
    assert not any(word in told for word in ("constrained", "tuple", "lambert/", "function-"))


def test_a_refused_file_is_named_with_the_option_that_mends_it(
    run: Run, service: LiveService, tmp_path: Path
) -> None:
    path = tmp_path / "readme.obj"
    path.write_text("# prtbake\n")
    refusal = JobError(kind="input", code="invalid-mesh", detail="none of OBJ", pointer="/format")
    for words, option in (
        (("submit", "bake", "--brdf", "lambert", "--mesh"), "--mesh-format"),
        (("register", "mesh"), "--format"),
    ):
        path.write_text(path.read_text() + "# other bytes\n")
        service.answer_next("register", lambda job_id: service.fail(job_id, refusal))
        result = run(*words, path)
        assert result.exit_code == Exit.refused
        assert f"file: {path}; the option is {option}" in result.stderr


def test_a_refused_file_without_an_option_is_only_named(
    run: Run, service: LiveService, tmp_path: Path
) -> None:
    path = tmp_path / "odd.hdr"
    path.write_bytes(b"odd")
    refusal = JobError(kind="input", code="invalid-environment", detail="ends early")
    service.answer_next("register", lambda job_id: service.fail(job_id, refusal))
    told = run("submit", "fit-light", "--environment", path).stderr
    assert f"file: {path}\n" in told
    assert "the option" not in told


def test_errors_are_json_where_data_is(run: Run) -> None:
    result = run("show", "nope", "-o", "json")
    assert (result.exit_code, result.stdout) == (Exit.refused, "")
    told = json.loads(result.stderr)
    assert told["exit_code"] == Exit.refused
    assert told["problem"]["code"] == "not-found"
    assert told["request_id"]
    assert "no job nope" in told["error"]
    unreachable = CliRunner().invoke(app, ["--url", "http://127.0.0.1:9", "ls", "-o", "json"])
    told = json.loads(unreachable.stderr)
    assert told["exit_code"] == Exit.unreachable
    assert "problem" not in told


def test_a_binary_file_goes_to_the_parser_and_its_refusal_is_told(
    run: Run, service: LiveService, tmp_path: Path
) -> None:
    path = tmp_path / "some.binary"
    path.write_bytes(b"\x89PNG\xff\xfe")
    refusal = JobError(kind="input", code="invalid-brdf", detail="neither JSON nor a table")
    service.answer_next("register", lambda job_id: service.fail(job_id, refusal))
    result = run("submit", "bake", "--mesh", "mesh-0123456789abcdef", "--brdf", path)
    assert (result.exit_code, result.exception.__class__) == (Exit.refused, SystemExit)
    assert refusal.detail in result.stderr


def test_a_binary_file_is_no_brdf(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "some.binary"
    path.write_bytes(b'{"\xff\xfe')
    result = run("submit", "bake", "--mesh", "x", "--brdf", path)
    assert (result.exit_code, result.exception.__class__) == (Exit.usage, SystemExit)
    assert "binary" in result.stderr


def test_no_service() -> None:
    result = CliRunner().invoke(app, ["--url", "http://127.0.0.1:9", "ls"])
    assert result.exit_code == Exit.unreachable


def test_a_fault_of_the_service_is_no_refusal(
    run: Run, service: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    def explode(*_: object, **__: object) -> None:
        raise RuntimeError

    monkeypatch.setattr(type(service.backend.jobs), "page", explode)
    assert run("ls").exit_code == Exit.service


def test_a_wrong_key(service: LiveService) -> None:
    result = CliRunner().invoke(app, ["--url", service.url, "--key", "wrong", "ls"])
    assert result.exit_code == Exit.refused
    assert "API key" in result.stderr
