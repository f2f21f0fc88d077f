"""Options of the commands that make a request: their types, short names and help."""

from typing import Annotated, get_args

import typer

from prtbake.cli.assignments import one_of
from prtbake_storage.contract import resources as contract
from prtbake_storage.contract.settings import Effects
from prtbake_storage.contract.settings import Quality as QualityName

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
        help="draft, low, medium, high or reference; medium unless a budget finds one.",
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
MaxBytes = Annotated[
    int | None,
    typer.Option(
        metavar="BYTES",
        help="What asset.h5 may take, as 500000; alone it goes with a quality.",
    ),
]
MaxBakeError = Annotated[
    float | None,
    typer.Option(
        "--max-error",
        metavar="RATIO",
        help="In place of a quality: what the transfer may err by, relative L2, as 0.1.",
    ),
]
MaxTransferBytes = Annotated[
    int | None,
    typer.Option(
        "--max-bytes", metavar="BYTES", help="In place of a quality: of transfer.h5, at most."
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
