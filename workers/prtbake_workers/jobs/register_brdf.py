"""Task of ``register``: read a BRDF from JSON or from a measurement's file, and check it."""

from collections.abc import Callable
from typing import Any, NamedTuple

from pydantic import ValidationError

from prtbake_storage.blobs.base import canonical_json
from prtbake_storage.contract.brdf import (
    MeasuredFormat,
    MeasuredSpec,
    StoredBrdfSpec,
    brdf_adapter,
)
from prtbake_storage.contract.resources import BrdfRegistration
from prtbake_storage.errors import BrdfError
from prtbake_storage.hdf5.brdf import AXES, BrdfFile, write_brdf
from prtbake_storage.queue.context import TaskContext
from prtbake_workers.brdf.base import Brdf, is_isotropic
from prtbake_workers.brdf.checks import check_energy, check_reciprocity
from prtbake_workers.brdf.distance import brdf_distance
from prtbake_workers.brdf.fit_tables import is_fit_table, read_fit_table
from prtbake_workers.brdf.merl import is_merl, read_merl
from prtbake_workers.brdf.mirrors import check_mirrors
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.rgl import RglTensor
from prtbake_workers.brdf.rgl_fields import rgl_from_tensors
from prtbake_workers.brdf.rgl_oriented import OrientedRglTensor
from prtbake_workers.brdf.scattered import interpolate_scattered
from prtbake_workers.brdf.scattered_text import is_scattered_text, read_scattered_text
from prtbake_workers.brdf.symmetrised import Symmetrised, SymmetrisedOriented
from prtbake_workers.brdf.tensor_file import is_tensor_file, read_tensor_file
from prtbake_workers.jobs.inputs import measured_brdf
from prtbake_workers.jobs.keras_weights import is_hdf5, read_keras_weights

MAX_JSON_BYTES = 1 << 20
MAX_FILE_BYTES = 256 << 20
"""Largest file read; an isotropic measurement is a tenth of it."""

N_ANGLES, N_ANGLES_SYMMETRISED, N_ANGLES_ORIENTED = 17, 9, 5
"""Angles of light at which the albedo is taken: somebody waits for it, and a symmetrised BRDF takes
four evaluations for one; an anisotropic one takes ten times as many, up to eight for one.  Five
have 75 degrees among them, where an albedo may peak before it falls at grazing light."""


class Understood(NamedTuple):
    """A BRDF, what stands for it in jobs, and what its file held."""

    brdf: Brdf
    spec: StoredBrdfSpec
    canonical: str
    facts: dict[str, Any]


def parse_brdf(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: read a BRDF; check its energy, its reciprocity and its isotropy."""
    registration = BrdfRegistration.model_validate(args)
    if registration.spec is not None:
        found = _from_spec(registration.spec, context)
    else:
        assert registration.blob is not None  # the contract holds exactly one source
        try:
            found = _from_file(registration.blob, registration.material, context)
        except BrdfError as error:
            raise BrdfError(error.detail, pointer=error.pointer or "/blob") from error
    return {
        "understood": {
            "spec": found.spec.model_dump(mode="json"),
            **found.facts,
            **_as_given(found.brdf),
            "isotropic": is_isotropic(found.brdf),
            "energy": check_energy(found.brdf, n_angles=_n_angles(found.brdf)).to_dict(),
            "reciprocity": check_reciprocity(found.brdf).to_dict(),
        },
        "canonical": found.canonical,
    }


def _n_angles(brdf: Brdf) -> int:
    if isinstance(brdf, SymmetrisedOriented):
        return N_ANGLES_ORIENTED
    return N_ANGLES_SYMMETRISED if isinstance(brdf, Symmetrised) else N_ANGLES


def _as_given(brdf: Brdf) -> dict[str, Any]:
    """Tell what was averaged away of a BRDF that had to be made symmetric."""
    if not isinstance(brdf, Symmetrised):
        return {}
    asymmetry = brdf_distance(brdf.original, brdf).relative_l2
    reciprocity = check_reciprocity(brdf.original).to_dict()
    return {"as_given": {"asymmetry": asymmetry, "reciprocity": reciprocity}}


def _from_file(blob: str, material: str | None, context: TaskContext) -> Understood:
    """Tell the format from the bytes and read it."""
    size = context.store.size(blob)
    if size > MAX_FILE_BYTES:
        raise BrdfError(f"a BRDF file has at most {MAX_FILE_BYTES} bytes, this one {size}")
    data = context.store.read_bytes(blob)
    if is_fit_table(data):
        found = _from_spec(read_fit_table(data, material), context)
        return found._replace(facts={"format": "fit_table", "material": material})
    if material is not None:
        raise BrdfError("the file holds one BRDF: it has no materials", pointer="/material")
    for recognises, read in _READERS:
        if recognises(data):
            return read(data, context)
    raise BrdfError(
        "the file is none of JSON, a table of SGD or ABC fits (.csv), an nbrdf network (.h5), a "
        "MERL table (.binary), a tensor file (.bsdf) and scattered samples (.brdf, .dat)"
        if data
        else "the file is empty"
    )


def _is_json(data: bytes) -> bool:
    return data[:256].lstrip().startswith(b"{")


def _from_json(data: bytes, context: TaskContext) -> Understood:
    if len(data) > MAX_JSON_BYTES:
        raise BrdfError(f"a BRDF file holds JSON of at most {MAX_JSON_BYTES} bytes")
    try:
        spec = brdf_adapter.validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = "/".join(str(step) for step in first["loc"])
        raise BrdfError(f"{first['msg']} (at {place or 'the top'})") from error
    return _from_spec(spec, context)


def _from_spec(spec: Any, context: TaskContext) -> Understood:
    canonical = context.store.put_bytes(canonical_json(spec.model_dump(mode="json")).encode())
    return Understood(brdf_from_spec(spec), spec, canonical, {})


def _from_keras(data: bytes, context: TaskContext) -> Understood:
    return _from_spec(read_keras_weights(data), context)._replace(facts={"format": "nbrdf"})


def _from_merl(data: bytes, context: TaskContext) -> Understood:
    table, report = read_merl(data)
    file = BrdfFile("half_difference", {"values": table.values}, report.to_dict())
    return _measured("merl", table, file, context)


def _from_tensors(data: bytes, context: TaskContext) -> Understood:
    tensor, report = rgl_from_tensors(read_tensor_file(data))
    kind = "rgl" if isinstance(tensor, RglTensor) else "rgl_oriented"
    if isinstance(tensor, OrientedRglTensor) and tensor.mirror_images > 1:
        report["mirror_asymmetry"] = check_mirrors(tensor)
    file = BrdfFile(kind, {name: getattr(tensor, name) for name in AXES[kind]}, report)
    return _measured("rgl", measured_brdf(file), file, context)


def _from_scattered(data: bytes, context: TaskContext) -> Understood:
    table, report = interpolate_scattered(read_scattered_text(data))
    file = BrdfFile("half_difference", {"values": table.values}, report)
    return _measured("scattered", table, file, context)


def _measured(name: MeasuredFormat, brdf: Brdf, file: BrdfFile, context: TaskContext) -> Understood:
    """Write the canonical file and make the spec that names it."""
    path = context.scratch / "brdf.h5"
    write_brdf(path, file)
    canonical = context.store.put_file(path, move=True)
    spec = MeasuredSpec(format=name, data=canonical)
    return Understood(brdf, spec, canonical, {"format": name, "file": dict(file.report)})


_READERS: tuple[tuple[Callable[[bytes], bool], Callable[[bytes, TaskContext], Understood]], ...] = (
    (_is_json, _from_json),
    (is_hdf5, _from_keras),
    (is_tensor_file, _from_tensors),
    (is_merl, _from_merl),
    (is_scattered_text, _from_scattered),
)
