"""Job kind ``calibrate``: small assets made for the clock alone, and the rates that they tell.

They go through the stages of an asset job as any does, in children of workers, one asset after the
other; nothing of them is kept but the seconds.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from prtbake_storage.contract.rates import NewRates
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Finished, Results, Stage, Task
from prtbake_workers.jobs import asset
from prtbake_workers.jobs.register import PARSERS
from prtbake_workers.jobs.work import asset_work
from prtbake_workers.planning.fit_rates import Observation, fit_rates
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.planning.rates import Rates

_MODULE = "prtbake_workers.jobs.calibrate"
SECONDS = 80.0
"""All of it takes, about, on the machine that the shipped rates are of."""

NO_RESOURCE = "0" * 16
"""Stands in requests for what the service would have registered."""


@dataclass(frozen=True)
class Trial:
    """A small asset."""

    mesh: Mapping[str, Any]
    environment: Mapping[str, Any]
    request: Mapping[str, Any]


TRIALS = (
    Trial(
        {"name": "teapot", "tessellation": 5},
        {"name": "sun_sky", "width": 64},
        {
            "brdf": {"model": "cook_torrance", "m": 0.4},
            "quality": "draft",
            "receiver": {"resolution": 24},
            "settings": {
                "bake": {"n_terms": 8, "n_centres": 642, "cube_resolution": 24},
                "fit_light": {"n_lobes": 96},
                "render": {"width": 480, "height": 360},
                "validation": {"width": 96, "height": 72},
            },
        },
    ),
    Trial(
        {"name": "icosphere", "tessellation": 4},
        {"name": "sun_sky", "width": 256},
        {
            "brdf": {"model": "lambert", "albedo": 0.8},
            "quality": "draft",
            "receiver": {"resolution": 32},
            "effects": {"interreflection": "on"},
            "subsurface": {"medium": "marble", "mm_per_unit": 2.0},
            "settings": {
                "fit_light": {"n_lobes": 32},
                "render": {"width": 160, "height": 120},
                "validation": {"width": 64, "height": 48, "passes": 4},
            },
        },
    ),
    Trial(
        {"name": "teapot", "tessellation": 8},
        {"name": "hall", "width": 128},
        {
            "brdf": {"model": "ward", "alpha_x": 0.4, "alpha_y": 0.3, "kd": 0.2, "ks": 0.5},
            "quality": "draft",
            "effects": {"interreflection": "off"},
            "settings": {
                "bake": {"n_terms": 4, "cube_resolution": "auto", "n_centres": "auto"},
                "fit_light": {"n_lobes": 16},
                "render": {"width": 320, "height": 240, "turntable_frames": 4},
                "validation": {"width": 160, "height": 120, "passes": 2},
            },
        },
    ),
)  # fmt: skip
"""Between them every stage is met, most units by far more than their stage's start."""


def stages(context: dict[str, Any]) -> list[Stage]:
    """Register the inputs, make the trials one after the other, and fit.

    ``context`` holds a ``nonce``: tasks of an earlier calibration must not be remembered.
    """
    nonce = int(context["nonce"])

    def inputs(_: Results) -> list[Task]:
        return [
            Task(PARSERS[kind], {"builtin": dict(spec)}, label=kind)
            for trial in TRIALS
            for kind, spec in (("mesh", trial.mesh), ("environment", trial.environment))
        ]

    def fit(results: Results) -> list[Task]:
        seen = [
            {"stage": one.stage, "amounts": dict(one.amounts), "seconds": one.seconds}
            for one in _observations(results)
        ]
        return [Task(f"{_MODULE}:fit", {"observations": seen}, label="fit")]

    return [
        Stage("inputs", "files", 2.0, inputs),
        *(stage for index in range(len(TRIALS)) for stage in _trial_stages(index, nonce)),
        Stage("fit", "rates", 1.0, fit),
    ]


def finish(results: Results) -> Finished:
    """Give the rates: predictions go by them from now on."""
    (fitted,) = results["fit"]
    return Finished(result=fitted, rates=NewRates(seconds=fitted["seconds"]))


def fit(args: dict[str, Any], _context: TaskContext) -> dict[str, Any]:
    """Task: fit the rates, and tell by how much they miss what was measured."""
    observations = [Observation(**one) for one in args["observations"]]
    seconds = fit_rates(observations)
    fitted, shipped = Rates(seconds), Rates()
    return {
        "seconds": seconds,
        "stages": [
            {
                "stage": one.stage,
                "measured": one.seconds,
                "predicted": fitted.base_seconds(one.stage, one.amounts),
                "shipped": shipped.base_seconds(one.stage, one.amounts),
            }
            for one in observations
        ],
    }


def _trial_stages(index: int, nonce: int) -> list[Stage]:
    """Give the stages of a trial under names of its own."""
    # only names and weights are read of these: the context is known when the inputs are
    outline = asset.stages(_request(index, nonce), {
        "mesh": {"canonical": ""}, "brdf": {"spec": {}}, "environment": {"canonical": ""},
    })  # fmt: skip

    def stage(place: int, own: Stage) -> Stage:
        def tasks(results: Results) -> list[Task]:
            real = asset.stages(_request(index, nonce), _context(index, results))
            return real[place].tasks(_inner(index, results))

        return Stage(_name(index, own.name), own.unit, own.weight, tasks)

    return [stage(place, own) for place, own in enumerate(outline)]


def _request(index: int, nonce: int) -> dict[str, Any]:
    return {
        "kind": "asset",
        "mesh": f"mesh-{NO_RESOURCE}",
        "environment": f"environment-{NO_RESOURCE}",
        "seed": nonce,
        **TRIALS[index].request,
    }


def _context(index: int, results: Results) -> dict[str, Any]:
    mesh, environment = results["inputs"][2 * index : 2 * index + 2]
    return {
        "mesh": mesh,
        "environment": environment,
        "brdf": {"spec": TRIALS[index].request["brdf"]},
        "materials": {},
        "albedo_texture": None,
    }


def _name(index: int, stage: str) -> str:
    return f"{stage} {index + 1}"


def _inner(index: int, results: Results) -> Results:
    """Give what a trial's own stages left, under their own names."""
    found = Results()
    for name in results:
        stage, _, number = name.partition(" ")
        if number == str(index + 1):
            found.add(stage, results[name], results.measured(name))
    return found


def _observations(results: Results) -> Iterator[Observation]:
    for index in range(len(TRIALS)):
        inner = _inner(index, results)
        (planned,) = inner["plan"]
        settings = StageSettings.from_dict(planned["settings"])
        work = asset_work(planned["plan"], settings, _context(index, results))
        for stage, amounts in work.items():
            if stage in inner and any(amounts.values()) and inner.measured(stage):
                seconds = sum(one.seconds for one in inner.measured(stage))
                yield Observation(stage, amounts, seconds)
