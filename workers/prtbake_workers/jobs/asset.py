"""Job kind ``asset``: the main job, which chains all the others."""

from typing import Any

from prtbake_storage.contract.jobs import AssetRequest
from prtbake_storage.queue.stages import Results, Stage
from prtbake_workers.jobs import bake, compress, fit_light, render, validate
from prtbake_workers.jobs.lights import light_source
from prtbake_workers.planning.presets import resolve_stages


def stages(request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    """Bake, compress, fit, render, validate."""
    parsed = AssetRequest.model_validate(request)
    settings = resolve_stages(parsed.planned_quality, parsed.planned_settings)
    environment = light_source(context)

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
        *bake.stages(request, context, settings, parsed.planned_quality),
        *compress.stages(planned, settings.compress, parsed.seed, started=context.get("started")),
        *fit_light.stages(
            environment, settings.fit_light, parsed.seed, started=context.get("started")
        ),
        *render.stages(lit, settings.render),
        *validate.stages(held, environment, settings.validation, parsed.seed),
    ]
