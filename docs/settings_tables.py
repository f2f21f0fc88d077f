"""Tables of what a request may hold, from the schema of the models that check it."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, get_args

from pydantic import BaseModel

from prtbake_storage.contract.brdf import BrdfSpec, LafortuneLobe
from prtbake_storage.contract.brdf_fits import DenseLayer
from prtbake_storage.contract.materials import Material, Subsurface
from prtbake_storage.contract.resources import BuiltinEnvironment, BuiltinMesh
from prtbake_storage.contract.settings import STAGES, Camera, Effects, ReceiverPlane
from prtbake_workers.planning.presets import LADDER

Schema = Mapping[str, Any]
COUNTS = {2: "two", 3: "three"}
OWN_FIELDS = ("verts_per_cluster", "ranks", "n_components")
"""Of a step of the ladder, beside the settings of its stages; all belong to compression."""


def brdf_tables() -> str:
    """Return one table a BRDF model, and one for each model inside."""
    models: list[type[BaseModel]] = list(get_args(get_args(BrdfSpec)[0]))
    parts = [
        model_table(model, f"`{model.model_fields['model'].default}`", skip=("model",))
        for model in models
    ]
    return "\n".join(
        [
            *parts,
            model_table(LafortuneLobe, "A lobe of `lafortune`"),
            model_table(DenseLayer, "A layer of `nbrdf`"),
        ]
    )


def scene_tables() -> str:
    """Return the tables of effects, materials, receiver, medium and built-in inputs."""
    return "\n".join(
        [
            model_table(Effects, "`effects`"),
            model_table(Material, "A material of `materials`"),
            model_table(ReceiverPlane, "`receiver`"),
            model_table(Subsurface, "`subsurface`"),
            model_table(BuiltinMesh, "A built-in mesh"),
            model_table(BuiltinEnvironment, "A built-in environment"),
        ]
    )


def stage_tables() -> str:
    """Return one table a stage of an asset job, and that of a camera."""
    parts = [model_table(model, f"`{stage}`") for stage, model in STAGES.items()]
    return "\n".join([*parts, model_table(Camera, "A camera of `render` or `validation`")])


def quality_table() -> str:
    """Return what each quality sets: a row a field, a column a quality."""
    steps = {quality: _flat(asdict(step)) for quality, step in LADDER.items()}
    names = list(dict.fromkeys(name for step in steps.values() for name in step))
    defaults = {
        f"{stage}.{name}": field.default
        for stage, model in STAGES.items()
        for name, field in model.model_fields.items()
    }
    rows = [
        [f"`{name}`", *(_shown(step.get(name, defaults.get(name))) for step in steps.values())]
        for name in sorted(names, key=lambda name: list(STAGES).index(name.partition(".")[0]))
    ]
    return _table(["field", *(f"`{quality}`" for quality in steps)], rows)


def model_table(model: type[BaseModel], heading: str, *, skip: Sequence[str] = ()) -> str:
    """Return heading, docstring and fields of a model."""
    schema = model.model_json_schema()
    rows = []
    for name, field in model.model_fields.items():
        if name in skip:
            continue
        of = schema["properties"][name]
        default = "required"
        if not field.is_required():
            value = field.get_default(call_default_factory=True)
            default = _shown(_plain(value))
        rows.append([f"`{name}`", kind_of(of), default, of.get("description", "")])
    text = re.sub(r"``(.+?)``", r"`\1`", schema.get("description", ""), flags=re.DOTALL)
    return f"### {heading}\n\n{text}\n\n" + _table(["field", "value", "default", "meaning"], rows)


def kind_of(schema: Schema) -> str:
    """Say what a value may be."""
    if members := schema.get("anyOf"):
        return _joined([kind_of(member) for member in members])
    if "discriminator" in schema:
        return "a BRDF"
    if reference := schema.get("$ref"):
        return re.sub(r"(?<!^)([A-Z])", r" \1", reference.rpartition("/")[2]).lower()
    if "const" in schema:
        return f"`{schema['const']}`"
    if legal := schema.get("enum"):
        return " ".join(f"`{value}`" for value in legal)
    match schema["type"]:
        case "null":
            return "`null`"
        case "array":
            return _array(schema)
        case "number" | "integer" as kind:
            return f"{kind}{_range(schema)}"
        case kind:
            return str(kind)


def _joined(kinds: list[str]) -> str:
    # one number or three of the same kind
    (first, *others) = kinds
    shortened = [other.removesuffix(f" of {first}") for other in others]
    return " or ".join([first, *shortened])


def _array(schema: Schema) -> str:
    if members := schema.get("prefixItems"):
        (kind,) = {kind_of(member) for member in members}
        return f"{COUNTS[len(members)]} of {kind}"
    least, most = schema.get("minItems"), schema.get("maxItems")
    counted = "" if most is None else f"{least} to {most} of "
    return f"list: {counted}{kind_of(schema['items'])}"


def _range(schema: Schema) -> str:
    low, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    high, below = schema.get("maximum"), schema.get("exclusiveMaximum")
    words = {"≥": low, ">": above, "≤": high, "<": below}
    said = [f"{sign} {_number(value)}" for sign, value in words.items() if value is not None]
    if factor := schema.get("multipleOf"):
        said.append(f"a multiple of {factor}")
    return " " + ", ".join(said) if said else ""


def _number(value: float) -> str:
    power = int(value).bit_length() - 1
    if power > 24 and value == 1 << power:
        return f"2^{power}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _flat(step: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in step.items():
        if isinstance(value, Mapping):
            flat |= {f"{name}.{inner}": of for inner, of in value.items()}
        else:
            flat[f"compress.{name}" if name in OWN_FIELDS else name] = value
    return flat


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return {name: _plain(of) for name, of in value if of != _default(value, name)}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _default(model: BaseModel, name: str) -> Any:
    return type(model).model_fields[name].get_default(call_default_factory=True)


def _shown(value: Any) -> str:
    if value is None:
        return "`null`"
    if isinstance(value, float):
        return f"`{value:g}`"
    return f"`{value if isinstance(value, str) else json.dumps(value)}`"


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    cells = [[cell.replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)


TABLES = {
    "brdfs": brdf_tables,
    "scene": scene_tables,
    "stages": stage_tables,
    "qualities": quality_table,
}
"""What a page asks for by ``<!-- table: NAME -->``."""


def with_tables(markdown: str) -> str:
    """Put the tables where a page asks for them; an unknown name is a `KeyError`."""
    return re.sub(r"<!-- table: (\w+) -->", lambda found: TABLES[found[1]](), markdown)
