"""An ``asset`` job that is given ``max_error``: attempts until its pictures err by just less.

Attempts at the bake climb the ladder until the stored transfer leaves room, attempts at the light
until its fit does, and attempts at the compression spend what is left.  All are measured at tuning
views; the validation looks at others.
"""

from collections.abc import Callable
from dataclasses import replace
from math import ceil
from typing import Any

from prtbake_storage.contract.jobs import AssetRequest
from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import CompressSettings, ValidateSettings
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.jobs import bake, compress, fit_light, render, tuning, validate
from prtbake_workers.jobs.error_attempts import BY_BYTES, FINER, MENDED, Asked, Trail
from prtbake_workers.jobs.error_trail import ErrorDecisions
from prtbake_workers.jobs.lights import light_source
from prtbake_workers.jobs.search_stages import (
    AFTER,
    BAKE,
    Tried,
    attempt_view,
    check_least,
    done,
    held_predictions,
    limit,
    numbered,
    refusal,
    unshared,
    view,
    views_of,
)
from prtbake_workers.jobs.shared_stages import attempted
from prtbake_workers.jobs.work import asset_work, wall_seconds
from prtbake_workers.planning.error_search import MOST_COMPRESSIONS
from prtbake_workers.planning.time_search import kept_for

MOST_SAMPLES = 16384
"""Light samples a pixel and pass that the validation is given, where the request says nothing."""


class ErrorSearch:
    """The search of one job."""

    def __init__(self, request: dict[str, Any], context: dict[str, Any]) -> None:
        self.request, self.context = request, context
        self.parsed = AssetRequest.model_validate(request)
        self._decisions = own = ErrorDecisions(self.parsed)
        self.budget, self.target, self.rungs, self.lights = (
            own.budget,
            own.target,
            own.rungs,
            own.lights,
        )
        self._bakes = [
            {
                stage.name: stage
                for stage in bake.stages(request, context, rung.settings, rung.quality)
            }
            for rung in self.rungs
        ]
        self._environment = light_source(context)

    def aim(self, results: Results) -> float | None:
        """Give the error that is aimed at, at tuning views."""
        return self._decisions.trail(results).aim

    def tried(self, results: Results) -> list[Tried]:
        """List the attempts."""
        return self._decisions.trail(results).tried

    def stages(self) -> list[Stage]:
        """List the stages of all attempts, then render."""
        listed: list[Stage] = []
        for attempt in range(len(self.rungs)):
            listed += self._bake_stages(attempt)
        for attempt in range(len(self.lights) - 1):
            listed += self._light_stages(attempt)
        for attempt in range(MOST_COMPRESSIONS):
            listed += self._compress_stages(attempt, "compress")
            listed.append(self._measured_asset(attempt))
        if self.budget.max_bytes is not None:
            listed += self._stages_of_bytes()
        mended = self._compress_stages(MENDED, "mend")
        (rendered,) = render.stages(
            lambda own: self._lit(self.delivered(own)), self.rungs[0].settings.render
        )
        # the first plan says whether there is time at all
        first, *others = [*listed, *mended]
        limited = [first, *(limit(stage, self._until, self.context) for stage in others)]
        return [*limited[:-2], self._validation(0), *limited[-2:], self._validation(1), rendered]

    def _until(self, results: Results) -> float | None:
        """Tell when tasks of the search leave: while there is time for what comes after it."""
        seconds = self.budget.max_seconds
        if seconds is None:
            return None
        least = self.rungs[0]
        work = asset_work(results["plan 1"][0]["plan"], least.settings, self.context)
        check_least(seconds, work, self.context, least.quality)
        rest = self.rest_seconds(results)
        return float(self.context.get("started", 0.0)) + seconds - rest

    def rest_seconds(self, results: Results) -> float:
        """Say what is kept for previews, validation and report after the search."""
        trail = self._decisions.trail(results)
        planned = results["plan 1"][0]["plan"]
        settings = replace(
            self.rungs[trail.rung].settings,
            validation=self._validate_settings(results, trail),
        )
        work = asset_work(planned, settings, self.context)
        return kept_for(wall_seconds(work, self.context, AFTER))

    def _stages_of_bytes(self) -> list[Stage]:
        """List the attempts at all bytes: of the bake that is settled on, and of a finer one."""

        def finer(results: Results) -> int | None:
            trail = self._decisions.trail(results)
            return trail.finer if trail.stage == "finer" else None

        return [
            *self._compress_stages(BY_BYTES, "compress"),
            self._measured_asset(BY_BYTES),
            *self._baked_stages(len(self.rungs), finer),
            *self._compress_stages(FINER, "finer"),
            self._measured_asset(FINER),
        ]

    def _baked_stages(
        self, attempt: int, under_way: Callable[[Results], int | None]
    ) -> list[Stage]:
        """List the stages of an attempt at the bake; ``under_way`` is its step, if it is made."""

        def baked(name: str) -> Stage:
            def tasks(results: Results) -> list[Task]:
                rung = under_way(results)
                if rung is None:
                    return []
                return self._bakes[rung][name].tasks(attempt_view(results, attempt))

            own = self._bakes[0][name]
            return Stage(numbered(name, attempt), own.unit, own.weight, tasks)

        return [baked(name) for name in BAKE]

    def _bake_stages(self, attempt: int) -> list[Stage]:
        def under_way(results: Results) -> int | None:
            trail = self._decisions.trail(results)
            own = trail.stage == "bake" and len(trail.rungs) - 1 == attempt
            return trail.rungs[-1] if own else None

        def lit(results: Results) -> list[Task]:
            rung = under_way(results)
            return [] if rung is None else self._fit(self.lights[self.rungs[rung].light])

        def measured(results: Results) -> dict[str, Any] | None:
            if under_way(results) is None:
                return None
            return {
                "transfer": results[numbered("join", attempt)][0]["transfer"],
                "light": results[numbered("fit_light", attempt)][0]["light"],
                "references": self._references(results),
            }

        return [
            *self._baked_stages(attempt, under_way),
            Stage(numbered("fit_light", attempt), "fit", 10.0, lit),
            self._measure(numbered("measure", attempt), measured),
        ]

    def _light_stages(self, attempt: int) -> list[Stage]:
        def under_way(results: Results) -> int | None:
            trail = self._decisions.trail(results)
            own = trail.stage == "light" and len(trail.lights) - 2 == attempt
            return trail.lights[-1] if own else None

        def lit(results: Results) -> list[Task]:
            step = under_way(results)
            return [] if step is None else self._fit(self.lights[step])

        def measured(results: Results) -> dict[str, Any] | None:
            if under_way(results) is None:
                return None
            return {
                "transfer": self._transfer(results),
                "light": results[numbered("fit_light", len(self.rungs) + attempt)][0]["light"],
                "references": self._references(results),
            }

        return [
            Stage(numbered("fit_light", len(self.rungs) + attempt), "fit", 10.0, lit),
            self._measure(numbered("measure light", attempt), measured),
        ]

    def _compress_stages(self, attempt: int, phase: str) -> list[Stage]:
        def planned(results: Results) -> tuple[str, list[dict[str, Any]]]:
            own = self._baked(results)
            return own["join"][0]["transfer"], unshared(own["plan"][0]["plan"])

        def own_stages(results: Results) -> list[Stage] | None:
            trail = self._decisions.trail(results)
            if trail.stage != phase or list(trail.asked)[-1] != attempt:
                return None
            return compress.stages(
                lambda _: planned(results),
                self._compression(trail, trail.asked[attempt]),
                self.parsed.seed,
                started=self.context.get("started"),
            )

        def parts(results: Results) -> list[Task]:
            own = own_stages(results)
            if own is None:
                return []
            return [attempted(task) for task in own[0].tasks(Results())]

        def assembled(results: Results) -> list[Task]:
            own = own_stages(results)
            name = numbered("compress", attempt)
            if own is None or refusal(results, name) is not None:
                return []
            seen = Results()
            seen.add("compress", done(results[name]), results.measured(name))
            tasks = own[1].tasks(seen)
            # mesh and tables may take more than all bytes
            held = attempt in (BY_BYTES, FINER, MENDED)
            return [attempted(task) for task in tasks] if held else tasks

        return [
            Stage(numbered("compress", attempt), "parts", 30.0, parts),
            Stage(numbered("quantise", attempt), "asset", 2.0, assembled),
        ]

    def _measured_asset(self, attempt: int) -> Stage:
        def measured(results: Results) -> dict[str, Any] | None:
            name = numbered("quantise", attempt)
            if not results[name] or refusal(results, name) is not None:
                return None
            (quantised,) = done(results[name])
            return {
                "transfer": self._transfer(results),
                "light": self._light(results),
                "asset": quantised["asset"],
                "references": self._references(results),
            }

        return self._measure(numbered("measure asset", attempt), measured)

    def _validation(self, attempt: int) -> Stage:
        def tasks(results: Results) -> list[Task]:
            trail = self._decisions.trail(results)
            if trail.stage != ("validate", "mend")[attempt]:
                return []
            at = trail.delivered if attempt == 0 else MENDED
            (quantised,) = done(results[numbered("quantise", at or 0)])
            inputs = {
                "transfer": self._transfer(results),
                "light": self._light(results),
                "asset": quantised["asset"],
                "exact": quantised["exact"],
            }
            (stage,) = validate.stages(
                lambda _: inputs,
                self._environment,
                self._validate_settings(results, trail),
                self.parsed.seed,
            )
            return stage.tasks(results)

        return Stage(numbered("validate", attempt), "cameras", 15.0, tasks)

    def _measure(self, name: str, inputs_of: Callable[[Results], dict[str, Any] | None]) -> Stage:
        return tuning.stage(
            name,
            inputs_of,
            self._environment,
            self.rungs[0].settings.validation,
            self.target,
            self.parsed.seed,
        )

    def _fit(self, settings: FitLightSettings) -> list[Task]:
        started = self.context.get("started")
        (stage,) = fit_light.stages(self._environment, settings, self.parsed.seed, started=started)
        return stage.tasks(Results())

    def _compression(self, trail: Trail, asked: Asked) -> CompressSettings:
        own = self.rungs[trail.rung].settings.compress
        return CompressSettings.model_validate(own.model_dump() | asked)

    def _validate_settings(self, results: Results, trail: Trail) -> ValidateSettings:
        """Give the validation samples enough for an error of this size, unless they are given."""
        settings = self.rungs[trail.rung].settings.validation
        given = {"samples", "passes"} & set(self.parsed.settings.validation)
        # before the first measurement nothing tells how many are needed
        if given or not trail.transfers:
            return settings
        views = views_of(results, "measure 1") or []
        n_samples = tuning.PASSES * sum(view["samples"] for view in views) / max(len(views), 1)
        needed = n_samples * (trail.transfers[0].noise / (tuning.NOISE_SHARE * self.target)) ** 2
        samples = min(max(ceil(needed / settings.passes), settings.samples), MOST_SAMPLES)
        return settings.model_copy(update={"samples": samples})

    def _references(self, results: Results) -> list[str] | None:
        if not (first := results.get("measure 1")):
            return None
        return [camera["reference"] for camera in first]

    def _baked(self, results: Results) -> Results:
        return attempt_view(results, self._bake_at(self._decisions.trail(results)))

    def _bake_at(self, trail: Trail) -> int:
        """Give the number of the attempt at the bake that the compression under way is of."""
        return len(trail.rungs) - 1 if trail.finer is None else len(self.rungs)

    def _transfer(self, results: Results) -> str:
        digest: str = self._baked(results)["join"][0]["transfer"]
        return digest

    def _light(self, results: Results) -> str:
        digest: str = results[self._decisions.light_stage(self._decisions.trail(results))][0][
            "light"
        ]
        return digest

    def _lit(self, delivered: Results) -> dict[str, Any]:
        return {
            "asset": delivered["quantise"][0]["asset"],
            "light": delivered["fit_light"][0]["light"],
        }

    def is_delivered(self, name: str, results: Results) -> bool:
        """Tell whether a stage made something of what is delivered."""
        return name in self._names(self._decisions.trail(results)).values()

    def _names(self, trail: Trail) -> dict[str, str]:
        bake_at, at = self._bake_at(trail), trail.delivered or 0
        names = {name: numbered(name, bake_at) for name in BAKE}
        names |= {name: numbered(name, at) for name in ("compress", "quantise")}
        names |= {
            "fit_light": self._decisions.light_stage(trail),
            "render": "render",
            "validate": "validate 2" if at == MENDED else "validate 1",
            "report": "report",
        }
        return names

    def delivered(self, results: Results) -> Results:
        """Give the stages behind what is delivered, by the names that they have in other jobs."""
        trail = self._decisions.trail(results)
        seen = view(results, self._names(trail))
        found = Results()
        for name in seen:
            values = done(seen[name])
            if name == "plan":
                values = [self._as_delivered(values[0], trail)]
            found.add(name, values, seen.measured(name), recalled=seen.recalled(name))
        return found

    def _as_delivered(self, planned: dict[str, Any], trail: Trail) -> dict[str, Any]:
        """Enter what was found into the settings that the report shows."""
        if trail.delivered is None:
            raise ValueError("nothing is delivered yet")
        light, asked = self.lights[trail.lights[-1]], trail.asked[trail.delivered]
        settings = planned["settings"] | {
            "compress": self._compression(trail, asked).model_dump(mode="json"),
            "fit_light": light.model_dump(mode="json"),
        }
        # beside it stand other bakes, with the light and the error of compression that were found
        settled = {"light", "compression"}
        ladder = [
            step
            | {
                "error_factors": {
                    kind: factor
                    for kind, factor in step["error_factors"].items()
                    if kind not in settled
                }
            }
            for step in planned["plan"]["ladder"]
        ]
        found = planned | {"settings": settings, "plan": planned["plan"] | {"ladder": ladder}}
        return held_predictions(found, self.budget.max_bytes)
