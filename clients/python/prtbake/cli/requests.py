"""One command a job kind, for ``submit`` and ``estimate`` alike.

Each builder below turns its options into a request; `request_commands` joins it with what is to be
done with the request, so that both groups take the same options.
"""

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel

from prtbake.cli.assignments import legal_names, nested
from prtbake.cli.context import client_of
from prtbake.cli.materials import (
    Materials,
    MaterialTextures,
    MaterialWords,
    ReceiverTexture,
)
from prtbake.cli.options import (
    AddLight,
    Artefact,
    Brdf,
    Colours,
    CreaseAngle,
    Effect,
    Environment,
    Exact,
    Label,
    Layout,
    MaxBakeError,
    MaxBytes,
    MaxError,
    MaxSeconds,
    MaxTransferBytes,
    Medium,
    Mesh,
    MeshFormat,
    Priority,
    QualityOrBudget,
    Receiver,
    Repair,
    Seed,
    Set,
    StageQuality,
    StageSet,
    TangentsWord,
    Texture,
    Timeout,
    TwoSided,
)
from prtbake.cli.scene_words import medium_value, receiver_value, tangents_value
from prtbake.cli.sources import (
    added_lights,
    brdf_value,
    environment_id,
    existing_file,
    key_values,
    mesh_id,
    read_request,
)
from prtbake.client import Client
from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import (
    STAGES,
    BakeSettings,
    CompressSettings,
    Effects,
    RenderSettings,
    ValidateSettings,
)

Request = dict[str, Any]
Builder = Callable[..., Request]
Action = Callable[..., None]

WORDS = "How to write MESH, BRDF, LIGHT and PLANE: docs/client.md, words on the command line."


def asset(
    client: Client,
    *,
    mesh: Mesh,
    brdf: Brdf,
    environment: Environment,
    add_light: AddLight = None,
    quality: QualityOrBudget = None,
    max_error: MaxError = None,
    max_bytes: MaxBytes = None,
    max_seconds: MaxSeconds = None,
    receiver: Receiver = None,
    albedo_texture: Texture = None,
    subsurface: Medium = None,
    vertex_colours: Colours = False,
    tangents: TangentsWord = "horizontal",
    two_sided: TwoSided = False,
    material: Materials = None,
    material_texture: MaterialTextures = None,
    receiver_texture: ReceiverTexture = None,
    effect: Effect = None,
    setting: StageSet = None,
    mesh_format: MeshFormat = "auto",
    crease_angle: CreaseAngle = None,
    layout: Layout = "auto",
    repair_non_finite: Repair = False,
    label: Label = None,
    priority: Priority = 50,
    seed: Seed = 0,
    timeout: Timeout = None,
) -> Request:
    """Bake, compress, fit the light, render, validate, report: the main job."""
    settings = _stage_settings(setting)
    materials = MaterialWords.read(material, material_texture, receiver_texture)
    scene = _scene(
        client,
        mesh,
        brdf,
        materials,
        receiver,
        albedo_texture,
        subsurface,
        tangents,
        effect,
        mesh_format,
        crease_angle,
    )
    if vertex_colours:
        scene["vertex_colours"] = True
    if two_sided:
        scene["two_sided"] = True
    light = environment_id(client, environment, layout=layout, repair_non_finite=repair_non_finite)
    return {
        "kind": "asset",
        **scene,
        "environment": light,
        **added_lights(client, add_light),
        **_quality_or_budget(quality, max_error, max_bytes, max_seconds),
        "settings": settings,
        **_common(label, priority, seed, timeout),
    }


def bake(
    client: Client,
    *,
    mesh: Mesh,
    brdf: Brdf,
    receiver: Receiver = None,
    albedo_texture: Texture = None,
    subsurface: Medium = None,
    vertex_colours: Colours = False,
    tangents: TangentsWord = "horizontal",
    two_sided: TwoSided = False,
    material: Materials = None,
    material_texture: MaterialTextures = None,
    receiver_texture: ReceiverTexture = None,
    effect: Effect = None,
    quality: StageQuality = None,
    max_error: MaxBakeError = None,
    max_bytes: MaxTransferBytes = None,
    max_seconds: MaxSeconds = None,
    setting: Set = None,
    mesh_format: MeshFormat = "auto",
    crease_angle: CreaseAngle = None,
    label: Label = None,
    priority: Priority = 50,
    seed: Seed = 0,
    timeout: Timeout = None,
) -> Request:
    """Simulate transport: gives transfer.h5."""
    settings = _settings(setting, BakeSettings)
    materials = MaterialWords.read(material, material_texture, receiver_texture)
    scene = _scene(
        client,
        mesh,
        brdf,
        materials,
        receiver,
        albedo_texture,
        subsurface,
        tangents,
        effect,
        mesh_format,
        crease_angle,
    )
    if vertex_colours:
        scene["vertex_colours"] = True
    if two_sided:
        scene["two_sided"] = True
    return {
        "kind": "bake",
        **scene,
        "settings": settings,
        **({} if quality is None else {"quality": quality}),
        **_budget(max_error=max_error, max_bytes=max_bytes, max_seconds=max_seconds),
        **_common(label, priority, seed, timeout),
    }


def compress(
    client: Client,
    *,
    transfer: Artefact,
    quality: StageQuality = None,
    setting: Set = None,
    label: Label = None,
    priority: Priority = 50,
    seed: Seed = 0,
    timeout: Timeout = None,
) -> Request:
    """Compress a transfer artefact: gives asset.h5."""
    del client
    return {
        "kind": "compress",
        "transfer": transfer,
        "settings": _settings(setting, CompressSettings),
        **({} if quality is None else {"quality": quality}),
        **_common(label, priority, seed, timeout),
    }


def fit_light(
    client: Client,
    *,
    environment: Environment,
    add_light: AddLight = None,
    quality: StageQuality = None,
    setting: Set = None,
    layout: Layout = "auto",
    repair_non_finite: Repair = False,
    label: Label = None,
    priority: Priority = 50,
    seed: Seed = 0,
    timeout: Timeout = None,
) -> Request:
    """Fit an environment: gives light.h5."""
    settings = _settings(setting, FitLightSettings)
    light = environment_id(client, environment, layout=layout, repair_non_finite=repair_non_finite)
    return {
        "kind": "fit_light",
        "environment": light,
        **added_lights(client, add_light),
        "settings": settings,
        **({} if quality is None else {"quality": quality}),
        **_common(label, priority, seed, timeout),
    }


def render(
    client: Client,
    *,
    asset: Artefact,
    light: Artefact,
    setting: Set = None,
    label: Label = None,
    priority: Priority = 50,
    seed: Seed = 0,
    timeout: Timeout = None,
) -> Request:
    """Relight an asset: gives PNG and EXR pictures."""
    del client
    return {
        "kind": "render",
        "asset": asset,
        "light": light,
        "settings": _settings(setting, RenderSettings),
        **_common(label, priority, seed, timeout),
    }


def validate(
    client: Client,
    *,
    asset: Artefact,
    transfer: Artefact,
    light: Artefact,
    environment: Environment,
    add_light: AddLight = None,
    exact: Exact = None,
    setting: Set = None,
    label: Label = None,
    priority: Priority = 50,
    seed: Seed = 0,
    timeout: Timeout = None,
) -> Request:
    """Hold an asset against the reference: gives pictures, metrics and the error budget."""
    settings = _settings(setting, ValidateSettings)
    return {
        "kind": "validate",
        "asset": asset,
        **({"exact": exact} if exact is not None else {}),
        "transfer": transfer,
        "light": light,
        "environment": environment_id(client, environment),
        **added_lights(client, add_light),
        "settings": settings,
        **_common(label, priority, seed, timeout),
    }


def file(
    client: Client,
    *,
    request: Annotated[str, typer.Argument(help="A request as JSON; - reads standard input.")],
) -> Request:
    """Take the whole request from a JSON file."""
    del client
    return read_request(request, "REQUEST")


BUILDERS: dict[str, Builder] = {
    "asset": asset,
    "bake": bake,
    "compress": compress,
    "fit-light": fit_light,
    "render": render,
    "validate": validate,
    "file": file,
}


def request_commands(
    group: typer.Typer, action: Action, builders: Mapping[str, Builder] = BUILDERS
) -> None:
    """Add one command a builder: its options, then those of the action.

    The action is called as ``action(client, request, **its options)``.
    """
    for name, builder in builders.items():
        group.command(name, epilog=WORDS)(_joined(builder, action))


def _joined(builder: Builder, action: Action) -> Callable[..., None]:
    built = _options(builder, skip=1)
    acted = _options(action, skip=2)

    def command(context: typer.Context, **values: Any) -> None:
        with client_of(context) as client:
            request = builder(client, **{key: values[key] for key in built})
            action(client, request, **{key: values[key] for key in acted})

    first = inspect.Parameter(
        "context", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context
    )
    parameters = [first, *built.values(), *acted.values()]
    command.__doc__ = builder.__doc__
    # typer reads a command's options from its signature and annotations
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {item.name: item.annotation for item in parameters}
    return command


def _options(function: Callable[..., Any], *, skip: int) -> dict[str, inspect.Parameter]:
    parameters = list(inspect.signature(function).parameters.values())[skip:]
    return {item.name: item for item in parameters}


def _scene(
    client: Client,
    mesh: str,
    brdf: str,
    materials: MaterialWords,
    receiver: str | None,
    texture: str | None,
    medium: str | None,
    tangents: str,
    effects: list[str] | None,
    mesh_format: str,
    crease_angle: float | None,
) -> Request:
    # all that this side can refuse, before anything is uploaded
    given = legal_names(key_values(effects or []), Effects.model_fields, "the scene", "--effect")
    scene: Request = {
        # JSON's true and false are not what a switch is called
        "effects": {
            name: {True: "on", False: "off"}.get(value, value) for name, value in given.items()
        },
    }
    if tangents != "horizontal":
        scene["tangents"] = tangents_value(tangents)
    if receiver is not None:
        scene["receiver"] = receiver_value(receiver)
    if medium is not None:
        scene["subsurface"] = medium_value(medium)
    picture: Path | None = None
    if texture is not None and not texture.startswith("sha256:"):
        picture = existing_file(texture, "--albedo-texture")
    scene["brdf"] = brdf_value(client, brdf)
    materials.add_to(client, scene)
    scene["mesh"] = mesh_id(client, mesh, format=mesh_format, crease_angle_deg=crease_angle)
    if texture is not None:
        scene["albedo_texture"] = texture if picture is None else client.upload(picture).digest
    return scene


def _settings(pairs: list[str] | None, model: type[BaseModel]) -> Request:
    return legal_names(nested(pairs or []), model.model_fields, "this job", "--set")


def _stage_settings(pairs: list[str] | None) -> Request:
    """Check names only: the service knows what their values may be."""
    below = {stage: model.model_fields for stage, model in STAGES.items()}
    given = legal_names(nested(pairs or []), STAGES, "this job", "--set", below=below)
    for stage, fields in given.items():
        if not isinstance(fields, dict):
            raise typer.BadParameter(f"write {stage}.NAME=VALUE", param_hint="--set")
        legal_names(fields, STAGES[stage].model_fields, stage, "--set")
    return given


def _budget(**asked: float | None) -> Request:
    """Say what a job may err by, weigh and take; nothing where nothing is asked."""
    budget = {name: value for name, value in asked.items() if value is not None}
    return {"budget": budget} if budget else {}


def _quality_or_budget(
    quality: str | None,
    max_error: float | None,
    max_bytes: int | None,
    max_seconds: float | None,
) -> Request:
    """Say what the asset may cost, or how good it shall be; the service refuses most of both."""
    budget = _budget(max_error=max_error, max_bytes=max_bytes, max_seconds=max_seconds)
    if not budget:
        return {"quality": quality or "medium"}
    return budget | ({} if quality is None else {"quality": quality})


def _common(label: str | None, priority: int, seed: int, timeout: int | None) -> Request:
    common: Request = {"label": label, "priority": priority, "seed": seed, "timeout_s": timeout}
    return {name: value for name, value in common.items() if value is not None}
