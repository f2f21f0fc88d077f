"""The job kinds, as the engine asks for them: stages of a request, then what they left."""

from collections.abc import Callable
from typing import Any

from prtbake_storage.contract.jobs import (
    AssetRequest,
    BakeRequest,
    CompressRequest,
    FitLightRequest,
    RenderRequest,
    ValidateRequest,
)
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Finished, Results, Stage
from prtbake_workers.jobs import (
    bake,
    compress,
    estimate,
    fit_light,
    register,
    render,
    report,
    study,
    validate,
)
from prtbake_workers.planning.presets import StageSettings, resolve_stages

Build = Callable[[dict[str, Any], dict[str, Any]], list[Stage]]


def _bake(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    settings = StageSettings.for_bake(BakeRequest.model_validate(request).settings)
    return bake.stages(request, context, settings, "medium")


def _compress(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    parsed = CompressRequest.model_validate(request)
    transfer = context["artefacts"]["transfer"]["digest"]
    return compress.standalone_stages(transfer, parsed.settings, parsed.seed)


def _fit_light(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    parsed = FitLightRequest.model_validate(request)
    return fit_light.stages(context["environment"]["canonical"], parsed.settings, parsed.seed)


def _render(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    parsed = RenderRequest.model_validate(request)
    inputs = {name: context["artefacts"][name]["digest"] for name in ("asset", "light")}
    return render.stages(lambda _: inputs, parsed.settings)


def _validate(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    parsed = ValidateRequest.model_validate(request)
    given = context["artefacts"]
    inputs = {name: artefact["digest"] for name, artefact in given.items()}
    return validate.stages(
        lambda _: inputs, context["environment"]["canonical"], parsed.settings, parsed.seed
    )


def _asset(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    """Chain all kinds: the main job."""
    parsed = AssetRequest.model_validate(request)
    settings = resolve_stages(parsed.quality, parsed.settings)
    environment = context["environment"]["canonical"]

    def planned(results: Results) -> tuple[str, list[dict[str, Any]]]:
        parts = results["plan"][0]["plan"]["parts"]
        return results["join"][0]["transfer"], [part["compression"] for part in parts]

    def lit(results: Results) -> dict[str, Any]:
        return {
            "asset": results["quantise"][0]["asset"],
            "light": results["fit_light"][0]["light"],
        }

    def held(results: Results) -> dict[str, Any]:
        return {
            **lit(results),
            "exact": results["quantise"][0]["exact"],
            "transfer": results["join"][0]["transfer"],
        }

    return [
        *bake.stages(request, context, settings, parsed.quality),
        *compress.stages(planned, settings.compress, parsed.seed),
        *fit_light.stages(environment, settings.fit_light, parsed.seed),
        *render.stages(lit, settings.render),
        *validate.stages(held, environment, settings.validation, parsed.seed),
    ]


KINDS: dict[str, Build] = {
    "bake": _bake,
    "compress": _compress,
    "fit_light": _fit_light,
    "render": _render,
    "validate": _validate,
    "asset": _asset,
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
        if kind not in KINDS:
            raise SettingsError(f"there is no job kind {kind!r}", pointer="/kind")
        title = request.get("label") or f"{kind} job"
        return [*KINDS[kind](request, context), report.stage(title)]

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
        return Finished(result=report.summary(results), artefacts=report.artefacts(results))


REGISTRY = Registry()
