"""What a study would cost: its points' estimates, with work that they share counted once."""

import json
from collections.abc import Callable
from typing import Any

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.jobs import Estimate, Studied, StudyPoint, StudyRequest
from prtbake_storage.contract.study import describe
from prtbake_storage.errors import InputError, SettingsError

MOST_SCENES = 16
"""Points that are planned for an estimate where that traces rays: seconds each."""
MOST_FILES = 64
"""The same where it reads a file at the most."""
TRACED = ("bake", "asset")
"""Kinds whose planning does."""
AFTER_BAKING = ("compress", "fit_light", "render", "validation")
"""Settings of an asset job that its bake does not depend on."""

Predict = Callable[[Studied, dict[str, Any], dict[str, Any], BlobStore], Estimate]


def predict(
    request: StudyRequest, given: dict[str, Any], store: BlobStore, one: Predict
) -> dict[str, Any]:
    """Predict every point by ``one``; what is skipped for its inputs is listed with the reason.

    Raises
    ------
    InputError
        Naming the point, where one is refused and refused ones are not skipped, or all are.
    """
    shown: list[dict[str, Any]] = []
    skipped: list[dict[str, Any]] = []
    work: dict[tuple[str, str], float] = {}
    peaks: list[int] = []
    unknown = tried = 0
    most = MOST_SCENES if request.base.kind in TRACED else MOST_FILES
    for point, place in zip(request.points(), given["points"], strict=True):
        refused = point.refused or place.get("refused")
        if point.request is None or refused is not None:
            skipped.append({"values": point.values, "reason": refused})
            continue
        if tried == most:
            unknown += 1
            continue
        tried += 1
        body = point.request.model_dump(mode="json")
        try:
            found = one(point.request, body, given["contexts"][place["context"]], store)
        except InputError as error:
            if not request.skip_illegal:
                detail = f"point of {describe(point.values)}: {error.detail}"
                raise SettingsError(detail, pointer=error.pointer) from error
            skipped.append({"values": point.values, "reason": error.detail})
            continue
        for stage, value in found.seconds.items():
            work[stage, _shared(stage, point, body)] = value
        if found.peak_memory_bytes is not None:
            peaks.append(found.peak_memory_bytes)
        shown.append(
            {
                "values": point.values,
                "seconds": sum(found.seconds.values()),
                "artefact_bytes": found.artefact_bytes,
                "errors": found.errors,
            }
        )
    if not shown:
        raise SettingsError(f"no point can be run: {skipped[0]['reason']}", pointer="/axes")
    seconds: dict[str, float] = {}
    for (stage, _), value in work.items():
        seconds[stage] = seconds.get(stage, 0.0) + value
    slots = max(1, int(given.get("tile_slots", 1)))
    return Estimate(
        plan={"kind": "study", "points": shown, "skipped": skipped},
        seconds=seconds,
        # points run beside each other
        total_seconds=None if unknown else sum(seconds.values()) / min(slots, len(shown)),
        artefact_bytes={},
        peak_memory_bytes=max(peaks, default=None),
        errors={},
        warnings=[
            f"{len(shown)} points are predicted, {unknown} more are not: planning each takes long"
        ]
        if unknown
        else [],
    ).model_dump(mode="json")


def _shared(stage: str, point: StudyPoint, body: dict[str, Any]) -> str:
    """Name the work of a stage: points with the same name for it share it."""
    if point.request is None or body["kind"] != "asset" or stage in ("plan", "render", "validate"):
        return str(point.index)
    depends = dict(body)
    if stage == "fit_light":
        depends = {name: body[name] for name in ("environment", "lights", "quality", "seed")}
        depends["settings"] = body["settings"]["fit_light"]
    else:
        dropped = AFTER_BAKING[1:] if stage in ("compress", "quantise") else AFTER_BAKING
        depends["settings"] = {
            name: value for name, value in body["settings"].items() if name not in dropped
        }
    return json.dumps(depends, sort_keys=True)
