"""One command a job kind, for ``submit`` and ``estimate`` alike.

Each builder below turns its options into a request; `request_commands` joins it with what is to be
done with the request, so that both groups take the same options.
"""

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from pydantic import BaseModel

from prtbake.cli.assignments import legal_names, nested, one_of
from prtbake.cli.context import client_of
from prtbake.cli.materials import (
    Materials,
    MaterialTextures,
    MaterialWords,
    ReceiverTexture,
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
from prtbake_storage.contract import resources as contract
from prtbake_storage.contract.settings import (
    STAGES,
    BakeSettings,
    CompressSettings,
    Effects,
    FitLightSettings,
    RenderSettings,
    ValidateSettings,
)
from prtbake_storage.contract.settings import Quality as QualityName

Request = dict[str, Any]
Builder = Callable[..., Request]
Action = Callable[..., None]

# metavars are short so that 80 columns have room for the syntax
Mesh = Annotated[
    str,
    typer.Option(
        metavar="MESH",
        help="A file, an id, builtin:teapot:12 or builtin:icosphere:4",
    ),
]
Brdf = Annotated[
    str,
    typer.Option(
        metavar="BRDF",
        help="A file, FILE#MATERIAL, JSON, an id, or a model: lambert,albedo=0.5:0.3:0.2",
    ),
]
Environment = Annotated[
    str,
    typer.Option(metavar="LIGHT", help="A file (.hdr, .exr), an id, or builtin:sun_sky,width=256"),
]
AddLight = Annotated[
    list[str] | None,
    typer.Option(metavar="LIGHT", help="Shines too; 0.5*LIGHT half as bright. Repeatable."),
]
MeshFormat = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="auto, obj, ply, stl, off or glb.",
        callback=one_of(*get_args(contract.MeshFormat)),
    ),
]
CreaseAngle = Annotated[
    float | None,
    typer.Option(
        metavar="DEGREES",
        help="Edges sharper than this stay sharp, and the file's normals are not taken.",
    ),
]
Layout = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="auto, lat_long, lat_long_exr, angular_probe or cube_strip.",
        callback=one_of(*get_args(contract.EnvironmentLayout)),
    ),
]
Repair = Annotated[
    bool,
    typer.Option("--repair-non-finite", help="Replace NaN and infinite pixels, and say so."),
]
Receiver = Annotated[
    str | None,
    typer.Option(
        metavar="PLANE",
        help="Plane under the object: 'on', a resolution, resolution=64,extent=2 or JSON.",
    ),
]
Medium = Annotated[
    str | None,
    typer.Option(
        metavar="MEDIUM",
        help="Light scatters inside: marble,mm_per_unit=10, parameters or JSON.",
    ),
]
Texture = Annotated[str | None, typer.Option(metavar="PNG", help="Albedo: a file, or sha256:...")]
Colours = Annotated[
    bool, typer.Option("--vertex-colours", help="Multiply the albedo by the colours of the mesh.")
]
TwoSided = Annotated[
    bool, typer.Option("--two-sided", help="The object reflects on its backs too.")
]
TangentsWord = Annotated[
    str,
    typer.Option(
        "--tangents",
        metavar="WHERE",
        help="Of an anisotropic BRDF: horizontal, uv, or a direction as 0:1:0.",
    ),
]
Effect = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=...",
        help=f"auto, on or off for one of {', '.join(Effects.model_fields)}; repeat for several.",
    ),
]
Quality = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="draft, low, medium, high or reference.",
        callback=one_of(*get_args(QualityName)),
    ),
]
QualityOrBudget = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="draft, low, medium, high or reference; medium unless a budget is given.",
        callback=one_of(*get_args(QualityName)),
    ),
]
MaxError = Annotated[
    float | None,
    typer.Option(
        metavar="RATIO",
        help="In place of a quality: what pictures may err by, relative L2, as 0.05.",
    ),
]
MaxSeconds = Annotated[
    float | None,
    typer.Option(metavar="SECONDS", help="In place of a quality: what the job may take."),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=...", help="A setting, as n_terms=16; repeat for several."),
]
StageSet = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=...",
        help="A setting of a stage, as bake.n_terms=16; repeat for several.",
    ),
]
StageQuality = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Begin with the settings of draft, low, medium, high or reference.",
        callback=one_of(*get_args(QualityName)),
    ),
]
Label = Annotated[str | None, typer.Option(metavar="TEXT", help="A name for people.")]
Priority = Annotated[int, typer.Option(metavar="N", help="1 (first) to 100.")]
Seed = Annotated[int, typer.Option(metavar="N", help="Seed of everything random.")]
Timeout = Annotated[
    int | None,
    typer.Option(metavar="SECONDS", help="After these the job expires."),
]
Artefact = Annotated[str, typer.Option(metavar="JOB/NAME", help="A file of an earlier job.")]
Exact = Annotated[
    str | None,
    typer.Option(
        metavar="JOB/NAME",
        help="The asset in 32 bits, to tell compression from quantisation.",
    ),
]
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
        **_quality_or_budget(quality, max_error, max_seconds),
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


def _quality_or_budget(
    quality: str | None, max_error: float | None, max_seconds: float | None
) -> Request:
    """Say what the asset may cost, or how good it shall be; the service refuses both together."""
    given = {"max_error": max_error, "max_seconds": max_seconds}
    budget = {name: value for name, value in given.items() if value is not None}
    if not budget:
        return {"quality": quality or "medium"}
    return {"budget": budget} | ({} if quality is None else {"quality": quality})


def _common(label: str | None, priority: int, seed: int, timeout: int | None) -> Request:
    common: Request = {"label": label, "priority": priority, "seed": seed, "timeout_s": timeout}
    return {name: value for name, value in common.items() if value is not None}
