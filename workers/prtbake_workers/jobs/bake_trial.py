"""Task ``trial`` of a bake with a budget: the scene planned small, projections tried at vertices.

Nothing is baked.  What it leaves is all that `prtbake_workers.planning.bake_model` predicts from.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import ceil, sqrt
from typing import Any

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.bake_budget import BakeBudget
from prtbake_storage.contract.settings import BakeSettings
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Task
from prtbake_workers.jobs.plan import CPU_SECONDS, MEMORY_BYTES, arguments, plan_scene
from prtbake_workers.jobs.scene_file import PlannedScene
from prtbake_workers.jobs.search_stages import BAKE
from prtbake_workers.percent import percent
from prtbake_workers.planning.bake_model import Cut, effects_left_out, sized
from prtbake_workers.planning.bake_search import BOUNCE_SHARE, NEARLY
from prtbake_workers.planning.file_bytes import term_bytes
from prtbake_workers.planning.ladder_steps import terms_at
from prtbake_workers.planning.light_resolution import (
    Candidate,
    candidates,
    try_light_resolutions,
)
from prtbake_workers.planning.plan import DIRECTIONS_A_FUNCTION
from prtbake_workers.planning.planned import Plan
from prtbake_workers.planning.presets import PlannedBake, StageSettings
from prtbake_workers.planning.rates import Rates
from prtbake_workers.planning.trial_bounds import TrialTime, is_enough

_MODULE = "prtbake_workers.jobs.bake_trial"

TRIED_TERMS = 16
"""K of the trial, at most, where the request gives none: more hold little of the energy."""

MOST_TERMS, TERM_STEP, COARSEST, FINEST = 126, 0.8, 0.5, 1e-5
"""Terms that are chosen from, and the shares of energy that they may lose: a geometric series."""

SMALLEST = {"n_centres": 12, "cube_resolution": 8}
"""Numbers that the scene is planned with for the trial, where the request gives none."""


def task(request: dict[str, Any], context: dict[str, Any], budget: BakeBudget) -> Task:
    """Make the task; ``request`` is of a bake."""
    given = {
        name: value
        for name, value in request.get("settings", {}).items()
        if value is not None and value != "auto"
    }
    fields = SMALLEST | given
    if budget.max_error is not None:
        tolerance = BOUNCE_SHARE * budget.max_error**2
        fields |= {"bounce_tolerance": tolerance, "subsurface_tolerance": tolerance}
    if not _own_terms(given):
        fields["n_terms"] = TRIED_TERMS
    settings = StageSettings.for_bake(BakeSettings.model_validate(fields))
    args: dict[str, Any] = {
        "plan": arguments(request, context, settings, "medium"),
        "given": given,
        "budget": budget.model_dump(mode="json"),
    }
    if budget.max_seconds is not None:
        args["rates"] = context.get("rates")
    return Task(
        f"{_MODULE}:run",
        args,
        label="trial",
        memory_bytes=MEMORY_BYTES,
        cpu_seconds=CPU_SECONDS,
    )


def _own_terms(given: Mapping[str, Any]) -> bool:
    """Tell whether a request says itself how many terms its BRDFs get."""
    return "n_terms" in given or given.get("factorisation") == "sh"


def run(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: try the scene."""
    return tried(args, context.store)


def tried(args: dict[str, Any], store: BlobStore) -> dict[str, Any]:
    """Plan the scene small, and measure what projections of some vertices leave."""
    given, budget = args["given"], BakeBudget.model_validate(args["budget"])
    planned, plan = plan_scene(args["plan"], store)
    bake = StageSettings.from_dict(args["plan"]["settings"]).planned_bake
    found: dict[str, Any] = {
        "parts": [
            {
                "name": part.name,
                "n_verts": part.vertex_range[1] - part.vertex_range[0],
                "shadows": bool(part.occluders),
                "even": part.role == "receiver" or not part.occluders,
                "scattered": plan.bounces is not None and index in plan.bounces.scattering,
                "term_bytes": term_bytes(planned.factorisations[index]),
            }
            for index, part in enumerate(plan.parts)
        ],
        "n_channels": 1 if plan.bounces is None else plan.bounces.n_channels,
        "own": {"n_centres": bake.n_coeffs, "terms": [part.n_terms for part in plan.parts]},
        "bake": bake.model_dump(mode="json"),
        "work": {stage: plan.work[stage] for stage in BAKE if stage in plan.work},
        "left_out": effects_left_out([one.to_dict() for one in plan.effects]),
        "options": _options(planned, plan, bake, given),
        "fixed_bytes": 0,
        **_bounces(plan),
    }
    _check_terms(found, budget.max_error)
    known = plan.artefact_bytes["transfer.h5"]
    found["fixed_bytes"] = known - sized(found, bake.n_coeffs, found["own"]["terms"])
    pairs, cut = _candidates(planned, found, args["plan"]["seed"], given, budget, args)
    found["candidates"] = [
        {
            "n_centres": one.n_centres,
            "cube_resolution": one.cube_resolution,
            "errors": list(one.errors),
        }
        for one in pairs
    ]
    found["cut"] = None if cut is None else asdict(cut)
    return found


def _check_terms(found: Mapping[str, Any], asked: float | None) -> None:
    """Refuse an error that terms alone exceed: no projection mends what they leave.

    Raises
    ------
    SettingsError
        Telling what the most terms leave, and of which part.
    """
    best = min(found["options"], key=lambda option: max(option["lost"]))
    left = max(best["lost"])
    if asked is None or left <= (NEARLY * asked) ** 2:
        return
    part = best["lost"].index(left)
    raise SettingsError(
        f"an error of {percent(asked)} cannot be met: {best['terms'][part]} terms, the most that "
        f"are tried, leave {percent(sqrt(left))} of the BRDF of {found['parts'][part]['name']}, "
        "whatever directions and functions there are; a smoother BRDF would lower it",
        pointer="/budget/max_error",
    )


def _bounces(plan: Plan) -> dict[str, Any]:
    (decided,) = (one for one in plan.effects if one.effect == "interreflection")
    return {
        "bounced": decided.taken,
        "variances": list(decided.evidence["variances"]) if decided.taken else [],
    }


def _options(
    planned: PlannedScene, plan: Plan, bake: PlannedBake, given: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """List numbers of terms: what share may be lost or how many, terms and losses of each part.

    Neither is named where the request or the BRDFs leave nothing to choose.
    """
    own = [part.n_terms for part in plan.parts]
    taken = {one.effect: one for one in plan.effects}["view_dependence"]
    lost = [factorisation.energy_lost for factorisation in planned.factorisations]
    fixed = {"term_energy_lost": None, "n_terms": None, "terms": own, "lost": lost}
    constant = all(own.is_constant_phi for own in planned.factorisations)
    if constant or _own_terms(given) or (taken.forced and not taken.taken):
        return [fixed]
    spectra = [factorisation.singular_values for factorisation in planned.factorisations]
    found: dict[tuple[int, ...], dict[str, Any]] = {}
    share = COARSEST
    while share > FINEST:
        asked = bake.model_copy(update={"n_terms": None, "term_energy_lost": share})
        terms = tuple(terms_at(1, values, asked, view_dependent=True) for values in spectra)
        if max(terms) <= MOST_TERMS and terms not in found:
            found[terms] = {"term_energy_lost": share, "n_terms": None} | _lost(spectra, terms)
        share *= TERM_STEP
    if not found:
        # the coarsest share takes more terms than are chosen
        asked = bake.model_copy(update={"n_terms": MOST_TERMS})
        terms = tuple(terms_at(1, values, asked, view_dependent=True) for values in spectra)
        return [{"term_energy_lost": None, "n_terms": MOST_TERMS} | _lost(spectra, terms)]
    return list(found.values())


def _lost(spectra: Sequence[Any], terms: Sequence[int]) -> dict[str, Any]:
    lost = [_left(values, k) for values, k in zip(spectra, terms, strict=True)]
    return {"terms": list(terms), "lost": lost}


def _left(values: Any, n_terms: int) -> float:
    energy = values**2
    whole = float(energy.sum())
    return float(energy[n_terms:].sum()) / whole if whole > 0.0 else 0.0


def _candidates(
    planned: PlannedScene,
    found: Mapping[str, Any],
    seed: int,
    given: Mapping[str, Any],
    budget: BakeBudget,
    args: Mapping[str, Any],
) -> tuple[list[Candidate], Cut | None]:
    """Try centres from few to many, until they are enough or more than the budget allows.

    Returns
    -------
    list of Candidate
        What was tried.
    Cut or None
        What of the budget allows no more, if that ended it.

    Raises
    ------
    SettingsError
        Trying the fewest takes more than its share of the time.
    """
    opened = BakeSettings.model_validate(
        {
            name: value
            for name, value in found["bake"].items()
            if name not in SMALLEST and value is not None
        }
        | {name: given.get(name, "auto") for name in SMALLEST}
    )
    resolutions = {
        count: tuple(sorted({coarsest(count), *fine})) if "cube_resolution" not in given else fine
        for count, fine in candidates(opened).items()
    }
    fewest = [min(terms) for terms in zip(*(o["terms"] for o in found["options"]), strict=True)]
    seconds = budget.max_seconds
    rates = Rates.from_dict(args.get("rates"))
    time = None if seconds is None else TrialTime(seconds, rates, found["work"]["plan"])
    cut: Cut | None = None

    def worth_trying(
        n_centres: int, before: Sequence[Candidate], work: Mapping[str, float]
    ) -> bool:
        nonlocal cut
        if not before:
            if time is not None and not time.holds(work):
                raise SettingsError(time.refusal(n_centres, work), pointer="/budget/max_seconds")
            return True
        if is_enough(found, before, budget.max_error):
            return False
        size = sized(found, n_centres, fewest)
        if budget.max_bytes is not None and size > NEARLY * budget.max_bytes:
            cut = Cut("max_bytes", n_centres, ceil(size / NEARLY))
        elif time is not None and not time.holds(work):
            cut = Cut("max_seconds", n_centres, time.least(work))
        return cut is None

    pairs = try_light_resolutions(
        planned.scene,
        [planned.occluders(part) for part in range(len(planned.factorisations))],
        planned.factorisations,
        opened,
        resolutions=resolutions,
        worth_trying=worth_trying,
        seed=seed + 6,
    )
    return pairs, cut


def coarsest(n_centres: int) -> int:
    """Give the coarsest even cube map that tells so many functions apart: see `MirroredProduct`."""
    return 2 * ceil(0.5 * sqrt(DIRECTIONS_A_FUNCTION * n_centres / 6.0))
