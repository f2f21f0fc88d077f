"""Quick job ``estimate``: validate and plan a request without running it."""

from typing import Any

from prtbake_storage.contract.jobs import AssetRequest, BakeRequest, Estimate, job_request_adapter
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Finished, Results, Stage, Task
from prtbake_workers.jobs.bake import plan_scene
from prtbake_workers.planning.presets import StageSettings, resolve_stages

_MODULE = "prtbake_workers.jobs.estimate"
MEMORY_BYTES = 6 << 30
CPU_SECONDS = 300


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
    """Task: predict seconds, bytes, memory and the errors that are known before the first ray."""
    request = job_request_adapter.validate_python(args["request"])
    given = args["context"]
    if not isinstance(request, AssetRequest | BakeRequest):
        return Estimate(
            plan={"kind": request.kind},
            seconds={},
            total_seconds=0.0,
            artefact_bytes={},
            peak_memory_bytes=0,
            errors={},
            warnings=["only bake and asset jobs are predicted; the request itself is valid"],
        ).model_dump(mode="json")
    settings, quality = _settings(request)
    planned, plan = plan_scene(
        {
            "mesh": given["mesh"]["canonical"],
            "brdf": given["brdf"]["spec"],
            "albedo_texture": given.get("albedo_texture"),
            "receiver": args["request"].get("receiver"),
            "effects": args["request"].get("effects", {}),
            "settings": settings.to_dict(),
            "quality": quality,
            "seed": request.seed,
        },
        context.store,
    )
    stages = set(plan.seconds)
    if isinstance(request, BakeRequest):
        stages &= {"plan", "bake"}
    seconds = {name: plan.seconds[name] for name in plan.seconds if name in stages}
    return Estimate(
        plan=plan.to_dict(),
        seconds=seconds,
        total_seconds=sum(seconds.values()),
        artefact_bytes=plan.artefact_bytes,
        peak_memory_bytes=plan.peak_memory_bytes,
        errors={
            f"K terms ({part['name']})": factorisation.energy_lost
            for part, factorisation in zip(
                planned.header["parts"], planned.factorisations, strict=True
            )
        },
        warnings=list(plan.notes),
    ).model_dump(mode="json")


def _settings(request: AssetRequest | BakeRequest) -> tuple[StageSettings, Any]:
    if isinstance(request, AssetRequest):
        return resolve_stages(request.quality, request.settings), request.quality
    return StageSettings.for_bake(request.settings), "medium"
