"""What a mesh, BRDF or environment on the command line means.

::

    mesh          FILE | builtin:teapot[:N] | builtin:icosphere[:N] | mesh-0123456789abcdef
    brdf          FILE[#MATERIAL] | MODEL,key=value,... | {"model": ...} | brdf-0123456789abcdef
    environment   FILE | builtin:NAME[,key=value,...] | environment-0123456789abcdef
"""

import json
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import typer
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from prtbake.cli.assignments import legal_names, parse_value, read_json, refusing
from prtbake.client import Client
from prtbake.errors import InvalidRequest
from prtbake_storage.contract.brdf import BrdfSpec, brdf_adapter
from prtbake_storage.contract.resources import (
    BuiltinEnvironment,
    BuiltinMesh,
    EnvironmentRegistration,
    MeshRegistration,
)

BUILTIN = "builtin:"
_RESOURCE = re.compile(r"(mesh|brdf|environment)-[0-9a-f]{16}")
_MODELS: dict[str, type[BaseModel]] = {
    member.model_fields["model"].default: member for member in get_args(get_args(BrdfSpec)[0])
}


def mesh_id(
    client: Client, source: str, *, format: str = "auto", crease_angle_deg: float | None = None
) -> str:
    """Return the id of the mesh that an argument means, registering it if it is new."""
    if _RESOURCE.fullmatch(source):
        if crease_angle_deg is not None:
            raise typer.BadParameter(
                f"{source} is registered already: a crease angle belongs to the registration",
                param_hint="--crease-angle",
            )
        return source
    if source.startswith(BUILTIN):
        name, _, count = source.removeprefix(BUILTIN).partition(":")
        body: dict[str, Any] = {"name": name}
        if count:
            body["tessellation"] = parse_value(count)
        with refusing("--mesh"):
            builtin = BuiltinMesh.model_validate(body)
        with refusing("--crease-angle"):
            registration = MeshRegistration(builtin=builtin, crease_angle_deg=crease_angle_deg)
        return client.register(registration).id
    path = existing_file(source, "--mesh")
    with naming(path, {"/format": "--mesh-format"}):
        return client.add_mesh(path, format=format, crease_angle_deg=crease_angle_deg).id


def environment_id(
    client: Client, source: str, *, option: str = "--environment", **options: object
) -> str:
    """Return the id of the environment that an argument means, registering it if it is new."""
    if _RESOURCE.fullmatch(source):
        return source
    if source.startswith(BUILTIN):
        name, *pairs = source.removeprefix(BUILTIN).split(",")
        fields = [field for field in BuiltinEnvironment.model_fields if field != "name"]
        options = legal_names(key_values(pairs), fields, source.partition(",")[0], option)
        with refusing(option):
            builtin = BuiltinEnvironment.model_validate({"name": name, **options})
        return client.register(EnvironmentRegistration(builtin=builtin)).id
    path = existing_file(source, option)
    with naming(path, {"/layout": "--layout"}):
        return client.add_environment(path, **options).id


def added_lights(client: Client, words: list[str] | None) -> dict[str, Any]:
    """Return the ``lights`` of a request: each word is an environment, or ``SCALE*`` and one."""
    lights = []
    for word in words or []:
        scale, star, source = word.partition("*")
        light: dict[str, Any] = {"scale": 1.0}
        if star:
            try:
                light["scale"] = float(scale)
            except ValueError as error:
                raise typer.BadParameter(
                    f"{scale} is no number to scale {source} by", param_hint="--add-light"
                ) from error
        found = environment_id(client, source if star else word, option="--add-light")
        lights.append({"environment": found, **light})
    return {"lights": lights} if lights else {}


def brdf_value(client: Client, source: str, *, option: str = "--brdf") -> str | dict[str, Any]:
    """Return the BRDF that an argument means: an id, or the JSON that describes it.

    A file that holds no JSON is registered; ``FILE#MATERIAL`` names one row of a table of fits.
    ``option`` is where the argument stands.
    """
    if _RESOURCE.fullmatch(source):
        return source
    if source.lstrip().startswith("{"):
        return _brdf(source, option)
    name, *pairs = source.split(",")
    if (model := _MODELS.get(name)) is not None:
        fields = [field for field in model.model_fields if field != "model"]
        given = legal_names(key_values(pairs), fields, name, option)
        return _checked({"model": name, **given}, option)
    file, hash_, material = source.rpartition("#")
    if hash_ and not Path(source).expanduser().is_file():
        path = existing_file(file, option)
        with naming(path):
            return client.add_brdf(path, material=material).id
    if not Path(source).expanduser().is_file():
        raise typer.BadParameter(
            f"there is no file {source}, and the BRDF models are {', '.join(_MODELS)}",
            param_hint=option,
        )
    path = existing_file(source, option)
    if not is_json(path):
        with naming(path):
            return client.add_brdf(path).id
    try:
        return _brdf(path.read_text(), option)
    except UnicodeDecodeError as error:
        raise typer.BadParameter(f"{source} is not JSON but binary", param_hint=option) from error


@contextmanager
def naming(path: Path, options: Mapping[str, str] | None = None) -> Iterator[None]:
    """Add to the refusal of a file which file it is, and the option for the field at fault."""
    try:
        yield
    except InvalidRequest as error:
        option = (options or {}).get(error.problem.pointer or "")
        error.add_note(f"  file: {path}" + (f"; the option is {option}" if option else ""))
        raise


def is_json(path: Path) -> bool:
    """Tell whether a file begins like a JSON object."""
    with path.open("rb") as file:
        return file.read(256).lstrip().startswith(b"{")


def existing_file(source: str, option: str) -> Path:
    """Return the path of a file, or say that there is none."""
    path = Path(source).expanduser()
    if not path.is_file():
        raise typer.BadParameter(f"there is no file {source}", param_hint=option)
    return path


def read_request(place: str, name: str) -> dict[str, Any]:
    """Read a request from a JSON file, or from standard input for ``-``."""
    text = sys.stdin.read() if place == "-" else existing_file(place, name).read_text()
    value = read_json(text, name)
    if not isinstance(value, dict):
        raise typer.BadParameter("a request is a JSON object", param_hint=name)
    return value


def key_values(pairs: list[str]) -> dict[str, Any]:
    """Read ``key=value`` pairs; values as `parse_value` has them, colours as ``0.8:0.2:0.1``."""
    values: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals:
            raise typer.BadParameter(f"{pair!r} is not key=value")
        values[key.strip()] = parse_value(text.replace(":", ","))
    return values


def _brdf(text: str, option: str) -> dict[str, Any]:
    try:
        return _checked(json.loads(text), option)
    except json.JSONDecodeError as error:
        raise typer.BadParameter(f"not JSON: {error}", param_hint=option) from error


def _checked(value: object, option: str) -> dict[str, Any]:
    try:
        spec = brdf_adapter.validate_python(value)
    except ValidationError as error:
        raise typer.BadParameter("; ".join(_complaints(error)), param_hint=option) from error
    plain: dict[str, Any] = spec.model_dump(mode="json")
    return plain


def _complaints(error: ValidationError) -> list[str]:
    """Say what is wrong, once a field: not what each member of a union would have liked instead."""
    found: dict[str, ErrorDetails] = {}
    for entry in error.errors():
        # the location is the model, the field and what of it was tried
        field = str(entry["loc"][1]) if len(entry["loc"]) > 1 else "model"
        # a value out of range says more than a value of another type
        if field not in found or found[field]["type"].endswith("_type"):
            found[field] = entry
    return [f"{field}: {entry['msg']}" for field, entry in found.items()]
