"""The work of a job's stages, for estimates, reports and what later jobs are predicted by."""

from collections.abc import Iterable, Mapping
from typing import Any

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.rates import NewRates
from prtbake_storage.queue.stages import Results
from prtbake_workers.planning.later_stages import (
    DEFAULT_TEXELS,
    REPORT_WORK,
    later_memory,
    later_work,
)
from prtbake_workers.planning.light_pieces import FitSamples
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.planning.rates import BETWEEN_STAGES_S, Rates
from prtbake_workers.planning.seen_pixels import SeenPixels
from prtbake_workers.planning.uncounted import untaught

Work = dict[str, dict[str, float]]


def n_texels(context: Mapping[str, Any]) -> int:
    """Count the texels of the light that a job's context names, of the sum of several."""
    lights = [context.get("environment", {}), *context.get("lights", [])]
    understood = [light.get("understood", {}) for light in lights]
    if any("width" not in own for own in understood):
        return DEFAULT_TEXELS
    return max(int(own["width"]) for own in understood) * max(
        int(own["height"]) for own in understood
    )


def fit_samples(settings: FitLightSettings, context: Mapping[str, Any]) -> FitSamples | None:
    """Say in how many samples a light is fitted; None where its registration did not count them.

    Nor does one of several lights say it of their sum.
    """
    if context.get("lights"):
        return None
    found = context.get("environment", {}).get("understood", {}).get("statistics", {})
    kind = "number" if settings.max_error is None else "error"
    return FitSamples(*found["samples"][kind]) if "samples" in found else None


def asset_work(
    plan: Mapping[str, Any], settings: StageSettings, context: Mapping[str, Any]
) -> Work:
    """Count the work of all stages of an asset job.

    ``plan`` is as `Plan.to_dict` gives it, ``settings`` have no number left open.
    """
    known: Work = plan["work"]
    return known | later_work(
        settings,
        n_verts=[part["vertex_range"][1] - part["vertex_range"][0] for part in plan["parts"]],
        part_terms=[part["n_terms"] for part in plan["parts"]],
        seen=[SeenPixels(**one) for one in plan["seen"]],
        n_texels=n_texels(context),
        samples=fit_samples(settings.fit_light, context),
        baked_bounces=_bounced(plan),
    )


def asset_memory(
    plan: Mapping[str, Any], settings: StageSettings, context: Mapping[str, Any]
) -> dict[str, int]:
    """Predict the memory of all stages of an asset job."""
    known: dict[str, int] = plan["memory_bytes"]
    return known | later_memory(
        settings,
        part_terms=[part["n_terms"] for part in plan["parts"]],
        lobes=[part["lobe"] for part in plan["parts"]],
        seen=[SeenPixels(**one) for one in plan["seen"]],
        n_texels=n_texels(context),
        samples=fit_samples(settings.fit_light, context),
        baked_bounces=_bounced(plan),
    )


def _bounced(plan: Mapping[str, Any]) -> bool:
    return plan["bounces"] is not None and plan["bounces"]["max_bounces"] > 0


def done_work(kind: str, results: Results, context: Mapping[str, Any]) -> Work:
    """Count the work of a job that has done it; nothing of kinds that plan nothing."""
    if "plan" not in results:
        return {}
    (planned,) = results["plan"]
    if kind == "asset":
        settings = StageSettings.from_dict(planned["settings"])
        return asset_work(planned["plan"], settings, context)
    return {**planned["plan"]["work"], "report": REPORT_WORK}


def rates_of(context: Mapping[str, Any]) -> Rates:
    """Give the rates as they were when the job was submitted."""
    return Rates.from_dict(context.get("rates"))


def slots_of(context: Mapping[str, Any]) -> int:
    """Count the slots for tasks that lived at submission, one at least."""
    return max(1, int(context.get("tile_slots", 1)))


def wall_seconds(
    work: Mapping[str, Mapping[str, float]], context: Mapping[str, Any], stages: Iterable[str]
) -> float:
    """Predict by the clock: the tasks of a stage share the slots that live at submission."""
    rates, slots = rates_of(context), slots_of(context)
    return sum(
        rates.stage_seconds(stage, work[stage]) / max(1.0, min(slots, work[stage].get("tasks", 1)))
        + BETWEEN_STAGES_S
        for stage in stages
        if stage in work and any(work[stage].values())
    )


def learnt(kind: str, results: Results, context: Mapping[str, Any]) -> NewRates | None:
    """Say what a finished job's stages took over what the rates alone predict.

    Stages of which a task had run before are left out: their seconds are another time's, perhaps
    another machine's.  So are those whose work goes by what they find.
    """
    rates = rates_of(context)
    ratios = {}
    left_out = _uncounted(kind, results)
    for stage, amounts in done_work(kind, results, context).items():
        if stage not in results or stage in left_out or results.recalled(stage):
            continue
        predicted = rates.base_seconds(stage, amounts)
        measured = sum((one.seconds for one in results.measured(stage)), start=0.0)
        if predicted > 0.0 and measured > 0.0:
            ratios[stage] = measured / predicted
    return NewRates(ratios=ratios, calibration=rates.calibration) if ratios else None


def _uncounted(kind: str, results: Results) -> set[str]:
    """Name the stages whose counts may not be what they did.

    Planning a compression traces nothing.
    """
    if "plan" not in results:
        return set()
    (planned,) = results["plan"]
    if kind == "asset":
        settings = StageSettings.from_dict(planned["settings"])
        return untaught(settings.compress, settings.fit_light)
    own = set(planned["plan"].get("uncounted", ()))
    return own | {"plan"} if kind == "compress" else own
