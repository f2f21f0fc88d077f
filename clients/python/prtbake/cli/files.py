"""``get``, ``upload`` and ``register``: files down and up."""

from pathlib import Path
from typing import Annotated

import typer

from prtbake.cli.context import client_of
from prtbake.cli.jobs import Job
from prtbake.cli.options import CreaseAngle
from prtbake.cli.output import Output, OutputOption, console, human_bytes, print_json
from prtbake.cli.progress import TransferProgress
from prtbake.cli.sources import existing_file, naming
from prtbake.errors import JobNotSucceeded, PrtbakeError
from prtbake_storage.contract.jobs import JobState
from prtbake_storage.contract.resources import Resource

register_group = typer.Typer(no_args_is_help=True, help="Upload an input and have it parsed.")
LINE_MAX = 1000
"""Characters of one finding that are printed; ``-o json`` prints all."""
File = Annotated[str, typer.Argument(metavar="FILE")]


def get(
    context: typer.Context,
    job: Job,
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...")] = None,
    to: Annotated[Path, typer.Option(help="Folder to put the files into.")] = Path(),
    output: OutputOption = Output.text,
) -> None:
    """Download a job's files, or those named; goes on where an earlier try stopped."""
    with client_of(context) as client:
        manifest = {artefact.name: artefact for artefact in client.artefacts(job)}
        if not manifest:
            found = client.job(job)
            if found.state.terminal and found.state is not JobState.succeeded:
                raise JobNotSucceeded(found)
            raise PrtbakeError(f"job {job} is {found.state}: it has no files")
        if unknown := sorted(set(names or ()) - set(manifest)):
            has = ", ".join(manifest) or "none yet"
            raise PrtbakeError(f"job {job} has no file {unknown[0]} (it has: {has})")
        wanted = [manifest[name] for name in names or manifest]
        paths: dict[str, str] = {}
        for artefact in wanted:
            with TransferProgress(artefact.name, artefact.size) as progress:
                path = client.download(job, artefact, to, on_bytes=progress.advance)
            paths[artefact.name] = str(path)
    if output is Output.json:
        print_json({"job": job, "files": paths})
    else:
        for artefact in wanted:
            console().print(f"{paths[artefact.name]}  {human_bytes(artefact.size)}")


def upload(
    context: typer.Context,
    files: Annotated[list[str], typer.Argument(metavar="FILE...")],
    output: OutputOption = Output.text,
) -> None:
    """Upload files by their digest; what is known already is not sent again."""
    paths = [existing_file(name, "FILE") for name in files]
    with client_of(context) as client:
        done = []
        for path in paths:
            with TransferProgress(path.name, path.stat().st_size) as progress:
                done.append(client.upload(path, on_bytes=progress.advance))
    if output is Output.json:
        print_json(done)
    else:
        for path, item in zip(paths, done, strict=True):
            console().print(f"{item.digest}  {path}")


@register_group.command("mesh")
def register_mesh(
    context: typer.Context,
    file: File,
    format_: Annotated[
        str, typer.Option("--format", help="auto, obj, ply, stl, off or glb.")
    ] = "auto",
    orient_outward: Annotated[bool, typer.Option(help="Turn faces that look inward.")] = True,
    crease_angle: CreaseAngle = None,
    label: Annotated[str | None, typer.Option(help="A name for people.")] = None,
    output: OutputOption = Output.text,
) -> None:
    """Register a mesh; prints what was understood and repaired."""
    path = existing_file(file, "FILE")
    with client_of(context) as client:
        options = {
            "format": format_,
            "orient_outward": orient_outward,
            "crease_angle_deg": crease_angle,
            "label": label,
        }
        with naming(path, {"/format": "--format"}):
            mesh = client.add_mesh(path, **options)
        _print(mesh, output)


@register_group.command("brdf")
def register_brdf(
    context: typer.Context,
    file: File,
    material: Annotated[
        str | None, typer.Option(help="Row of a table of fits (.csv) that holds several.")
    ] = None,
    label: Annotated[str | None, typer.Option(help="A name for people.")] = None,
    output: OutputOption = Output.text,
) -> None:
    """Register a BRDF: JSON, fits (.csv, .h5) or a measurement; prints what was understood."""
    path = existing_file(file, "FILE")
    with client_of(context) as client:
        with naming(path, {"/material": "--material"}):
            brdf = client.add_brdf(path, material=material, label=label)
        _print(brdf, output)


@register_group.command("environment")
def register_environment(
    context: typer.Context,
    file: File,
    layout: Annotated[
        str, typer.Option(help="auto, lat_long, lat_long_exr, angular_probe or cube_strip.")
    ] = "auto",
    repair_non_finite: Annotated[
        bool, typer.Option(help="Replace NaN and infinite pixels.")
    ] = False,
    clamp_negative: Annotated[bool, typer.Option(help="Set negative pixels to 0.")] = True,
    label: Annotated[str | None, typer.Option(help="A name for people.")] = None,
    output: OutputOption = Output.text,
) -> None:
    """Register an environment (.hdr, .exr); prints what was understood and repaired."""
    path = existing_file(file, "FILE")
    options = {
        "layout": layout,
        "repair_non_finite": repair_non_finite,
        "clamp_negative": clamp_negative,
        "label": label,
    }
    with client_of(context) as client:
        with naming(path, {"/layout": "--layout"}):
            environment = client.add_environment(path, **options)
        _print(environment, output)


def _print(resource: Resource, output: Output) -> None:
    if output is Output.json:
        print_json(resource)
        return
    out = console()
    out.print(f"[bold]{resource.id}[/]")
    for name, value in resource.understood.items():
        text = str(value)
        # a network's weights tell a reader nothing
        shown = text if len(text) <= LINE_MAX else f"{text[:LINE_MAX]} ..."
        out.print(f"  {name}: {shown}", markup=False)
