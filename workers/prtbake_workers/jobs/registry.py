"""The job kinds, as the engine asks for them: stages of a request, then what they left."""

from collections.abc import Callable
from typing import Any

from prtbake_storage.contract.jobs import (
    BakeRequest,
    CompressRequest,
    FitLightRequest,
    RenderRequest,
    ValidateRequest,
)
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Finished, Results, Stage
from prtbake_workers.jobs import (
    asset,
    bake,
    budget,
    calibrate,
    compress,
    estimate,
    fit_light,
    register,
    render,
    report,
    study,
    validate,
)
from prtbake_workers.jobs.lights import light_source
from prtbake_workers.jobs.work import done_work, learnt, rates_of
from prtbake_workers.planning.presets import StageSettings, below_quality

Build = Callable[[dict[str, Any], dict[str, Any]], list[Stage]]


def _bake(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    parsed = BakeRequest.model_validate(request)
    settings = StageSettings.for_bake(parsed.settings, parsed.quality)
    return bake.stages(request, context, settings, parsed.quality or "medium")


def _compress(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    parsed = CompressRequest.model_validate(request)
    transfer = context["artefacts"]["transfer"]["digest"]
    settings = below_quality("compress", parsed.settings, parsed.quality)
    return compress.standalone_stages(
        transfer,
        settings,
        parsed.seed,
        quality=parsed.quality or "medium",
        started=context.get("started"),
    )


def _fit_light(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    parsed = FitLightRequest.model_validate(request)
    settings = below_quality("fit_light", parsed.settings, parsed.quality)
    return fit_light.stages(
        light_source(context),
        settings,
        parsed.seed,
        settings_at="/settings",
        started=context.get("started"),
    )


def _render(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    parsed = RenderRequest.model_validate(request)
    inputs = {name: context["artefacts"][name]["digest"] for name in ("asset", "light")}
    return render.stages(lambda _: inputs, parsed.settings)


def _validate(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    parsed = ValidateRequest.model_validate(request)
    given = context["artefacts"]
    inputs = {name: artefact["digest"] for name, artefact in given.items()}
    return validate.stages(lambda _: inputs, light_source(context), parsed.settings, parsed.seed)


KINDS: dict[str, Build] = {
    "bake": _bake,
    "compress": _compress,
    "fit_light": _fit_light,
    "render": _render,
    "validate": _validate,
    "asset": asset.stages,
}
QUICK: dict[str, Build] = {"register": register.stages, "estimate": estimate.stages}


class Registry:
    """What the engine's workers are started with."""

    def stages(self, kind: str, request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
        """List the stages of a job."""
        if kind in QUICK:
            return QUICK[kind](request, context)
        if kind == "study":
            return study.stages(request, context, KINDS)
        if kind == "calibrate":
            return calibrate.stages(context)
        if kind not in KINDS:
            raise SettingsError(f"there is no job kind {kind!r}", pointer="/kind")
        title = request.get("label") or f"{kind} job"
        if budget.has_one(kind, request):
            return budget.stages(title, request, context)

        def predicted(results: Results) -> dict[str, float]:
            return rates_of(context).all_seconds(done_work(kind, results, context))

        return [*KINDS[kind](request, context), report.stage(title, predicted)]

    def finish(
        self, kind: str, request: dict[str, Any], context: dict[str, Any], results: Results
    ) -> Finished:
        """Name the files and the summary that the stages left."""
        if kind == "register":
            return register.finish(results)
        if kind == "estimate":
            return estimate.finish(results)
        if kind == "study":
            return study.finish(results)
        if kind == "calibrate":
            return calibrate.finish(results)
        if budget.has_one(kind, request):
            return budget.finish(request, context, results)
        return Finished(
            result=report.summary(results),
            artefacts=report.artefacts(results),
            rates=learnt(kind, results, context),
        )


REGISTRY = Registry()
