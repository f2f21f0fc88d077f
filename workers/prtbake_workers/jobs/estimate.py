"""Quick job ``estimate``: validate and plan a request without running it."""

from dataclasses import asdict
from typing import Any

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.jobs import (
    AssetRequest,
    BakeRequest,
    CompressRequest,
    Estimate,
    FitLightRequest,
    RenderRequest,
    StudyRequest,
    ValidateRequest,
    job_request_adapter,
)
from prtbake_storage.contract.settings import CompressSettings, ValidateSettings
from prtbake_storage.decode.transfer_basis import SphericalHarmonics, TransferBasis
from prtbake_storage.hdf5.light import read_light
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Finished, Results, Stage, Task
from prtbake_workers.jobs import study_estimate
from prtbake_workers.jobs.compress import spectrum_of
from prtbake_workers.jobs.inputs import load_environment
from prtbake_workers.jobs.plan import arguments, plan_scene
from prtbake_workers.jobs.validate import check_kinship
from prtbake_workers.planning.cost import (
    compress_memory_bytes,
    compress_seconds,
    fit_seconds,
    part_cost,
    validate_seconds,
)
from prtbake_workers.planning.presets import (
    PlannedBake,
    StageSettings,
    resolve_compression,
    resolve_stages,
)
from prtbake_workers.planning.scattering_cost import row_runs

_MODULE = "prtbake_workers.jobs.estimate"
MEMORY_BYTES = 6 << 30
CPU_SECONDS = 300
OneRequest = (
    BakeRequest | CompressRequest | FitLightRequest | RenderRequest | ValidateRequest | AssetRequest
)
BAKE_STAGES = ("plan", "bake", "scattering", "bounces")
BAKE_FILES = ("transfer.h5",)
"""What a lone bake runs and leaves, of the plan of a whole asset."""


def stages(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    """Plan in one limited task."""
    args = {"request": request["request"], "context": context}

    def plan(_: Results) -> list[Task]:
        return [
            Task(
                f"{_MODULE}:estimate",
                args,
                label="estimate",
                memory_bytes=MEMORY_BYTES,
                cpu_seconds=CPU_SECONDS,
            )
        ]

    return [Stage("estimate", "plan", 1.0, plan)]


def finish(results: Results) -> Finished:
    """Give the estimate."""
    return Finished(result=results["estimate"][0])


def estimate(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: check what the request refers to, and predict what the job would cost."""
    request = job_request_adapter.validate_python(args["request"])
    if isinstance(request, StudyRequest):
        return study_estimate.predict(request, args["context"], context.store, predict)
    return predict(request, args["request"], args["context"], context.store).model_dump(mode="json")


def predict(
    request: OneRequest, body: dict[str, Any], given: dict[str, Any], store: BlobStore
) -> Estimate:
    """Predict a job of any kind but a study."""
    match request:
        case AssetRequest() | BakeRequest():
            return _scene(request, body, given, store)
        case CompressRequest():
            return _compress(request.settings, given, store)
        case FitLightRequest():
            load_environment(store, given["environment"]["canonical"])
            return _only("fit_light", fit_seconds(request.settings), 1, given)
        case RenderRequest():
            for name, read in (("asset", read_asset), ("light", read_light)):
                read(store.local_path(given["artefacts"][name]["digest"]))
            return _only("render", None, 1, given)
        case ValidateRequest():
            return _validate(request.settings, given, store)


def _scene(
    request: AssetRequest | BakeRequest,
    body: dict[str, Any],
    given: dict[str, Any],
    store: BlobStore,
) -> Estimate:
    """Plan the scene: also gives the errors that are known before the first ray."""
    settings, quality = _settings(request)
    planned, plan = plan_scene(arguments(body, given, settings, quality), store)
    alone = isinstance(request, BakeRequest)
    stages = tuple(name for name in plan.seconds if name in BAKE_STAGES or not alone)
    seconds = {name: plan.seconds[name] for name in stages}
    files = BAKE_FILES if alone else tuple(plan.artefact_bytes)
    tasks = {
        "bake": sum(len(part.tiles) for part in plan.parts),
        "scattering": sum(
            len(row_runs(part.vertex_range[1] - part.vertex_range[0]))
            for index, part in enumerate(plan.parts)
            if plan.bounces is not None and index in plan.bounces.scattering
        ),
        "bounces": 0 if plan.bounces is None else len(plan.bounces.blocks),
        "compress": len(plan.parts),
        "validate": len(settings.validation.cameras),
    }
    return Estimate(
        plan=plan.to_dict(),
        seconds=seconds,
        total_seconds=_duration(seconds, tasks, given),
        artefact_bytes={name: plan.artefact_bytes[name] for name in files},
        peak_memory_bytes=max(
            count for stage, count in plan.memory_bytes.items() if stage in stages
        ),
        errors={
            f"K terms ({part['name']})": factorisation.energy_lost
            for part, factorisation in zip(
                planned.header["parts"], planned.factorisations, strict=True
            )
        },
        warnings=list(plan.notes),
    )


def _compress(settings: CompressSettings, given: dict[str, Any], store: BlobStore) -> Estimate:
    """Predict from the header of the transfer."""
    with open_transfer(store.local_path(given["artefacts"]["transfer"]["digest"])) as transfer:
        header = transfer.header
    bake, n_coeffs = _bake_of(header.basis), header.basis.n_coeffs
    plan: dict[str, Any] = {"kind": "compress", "parts": []}
    costs = []
    for part in header.parts:
        compression = resolve_compression(
            settings,
            "medium",
            n_verts=part.n_vertices,
            n_terms=part.n_terms,
            n_coeffs=n_coeffs,
            n_channels=part.n_channels,
            singular_values=spectrum_of(part),
        )
        plan["parts"].append({"name": part.name, "compression": asdict(compression)})
        costs.append(
            part_cost(
                bake,
                compression,
                n_verts=part.n_vertices,
                n_terms=part.n_terms,
                shadows=False,
                iterations=settings.max_iterations,
                n_channels=part.n_channels,
            )
        )
    seconds = {"compress": compress_seconds(costs)}
    return Estimate(
        plan=plan,
        seconds=seconds,
        total_seconds=_duration(seconds, {"compress": len(costs)}, given),
        artefact_bytes={"asset.h5": sum(cost.asset_bytes for cost in costs)},
        peak_memory_bytes=compress_memory_bytes(costs),
        errors={},
    )


def _bake_of(basis: TransferBasis) -> PlannedBake:
    """Give settings whose basis has as many functions."""
    if isinstance(basis, SphericalHarmonics):
        return PlannedBake(basis="sh", sh_order=basis.order)
    return PlannedBake.model_validate({"n_centres": basis.n_coeffs})


def _validate(settings: ValidateSettings, given: dict[str, Any], store: BlobStore) -> Estimate:
    """Check that the artefacts belong together, and predict from the header of the transfer."""
    digests = {name: artefact["digest"] for name, artefact in given["artefacts"].items()}
    check_kinship(digests | {"environment": given["environment"]["canonical"]}, store)
    with open_transfer(store.local_path(digests["transfer"])) as transfer:
        header = transfer.header
    seconds = validate_seconds(
        settings,
        n_terms=max(part.n_terms for part in header.parts),
        n_dirs=3 * header.provenance["bake"]["cube_resolution"] ** 2,
        baked_bounces=bool(header.provenance.get("interreflection")),
        media=any(part.subsurface is not None for part in header.parts),
    )
    return _only("validate", seconds, len(settings.cameras), given)


def _only(kind: str, seconds: float | None, n_tasks: int, given: dict[str, Any]) -> Estimate:
    """Predict the seconds of a job of one stage, or nothing."""
    work = {} if seconds is None else {kind: seconds}
    return Estimate(
        plan={"kind": kind},
        seconds=work,
        total_seconds=_duration(work, {kind: n_tasks}, given) if work else None,
        artefact_bytes={},
        peak_memory_bytes=None,
        errors={},
    )


def _duration(seconds: dict[str, float], tasks: dict[str, int], given: dict[str, Any]) -> float:
    """Predict how long a job lasts: the tasks of a stage share the slots of all live workers."""
    slots = max(1, int(given.get("tile_slots", 1)))
    return sum(work / min(slots, tasks.get(stage, 1)) for stage, work in seconds.items())


def _settings(request: AssetRequest | BakeRequest) -> tuple[StageSettings, Any]:
    if isinstance(request, AssetRequest):
        return resolve_stages(request.quality, request.settings), request.quality
    return StageSettings.for_bake(request.settings), "medium"
