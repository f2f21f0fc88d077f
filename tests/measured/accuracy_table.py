"""What is kept of the studies of the accuracy page, as a table, and what it proves."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import pairwise
from math import log, sqrt
from typing import Any

from measured.accuracy_scenes import FIGURE_4, LADDER, LADDER_NAME, QUALITY, SCENES
from measured.effects_table import Statement
from measured.pages import percent
from prtbake_workers.planning.step_errors import Resolution, line_factors, scaled_total
from prtbake_workers.report.steps import DECIDED_BY

Kept = dict[str, Any]
"""A study's points with what was kept beside them; or the lights of figure 4."""

DIGITS = 5
COSTS = ("seconds", "bytes")
COLUMNS = ("error", "noise", "seconds", "shared_seconds", "check_seconds", "bytes",
           "peak_memory_bytes")  # fmt: skip
LEAST_SPAN = 10.0
"""Of the seconds on a frontier, its dearest point over its cheapest: a decade."""
N_LIGHTS = 6
NOTHING = "not measured"

SCATTERED = "scattered SRBF"
FUNCTIONS = ("SH", "uniform SRBF")
WAVELETS = ("area-weighted wavelets", "largest wavelets")


def rounded(value: Any) -> Any:
    """Cut every float of JSON to `DIGITS` digits: more were never measured."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, Mapping):
        return {name: rounded(own) for name, own in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(own) for own in value]
    return value


def csv_text(kept: Mapping[str, Kept]) -> str:
    """Write every point of every study, a row each."""
    file = StringIO()
    rows = csv.writer(file, lineterminator="\n")
    rows.writerow(["scene", "point", "values", *COLUMNS, *(f"{cost}_frontier" for cost in COSTS)])
    for name, study in studies(kept).items():
        for point in study["points"]:
            rows.writerow(
                [name, point["point"], json.dumps(point["values"]),
                 *("" if point[column] is None else point[column] for column in COLUMNS),
                 *(int(cost in point["frontier"]) for cost in COSTS)]
            )  # fmt: skip
    return file.getvalue()


def studies(kept: Mapping[str, Kept]) -> dict[str, Kept]:
    """Give what is kept of studies."""
    return {name: own for name, own in kept.items() if name != FIGURE_4}


def on_frontier(study: Kept, cost: str) -> list[dict[str, Any]]:
    """Give the points of a frontier by rising cost."""
    points = {point["point"]: point for point in study["points"]}
    return [points[number] for number in study["frontier"][cost]]


def dominated(study: Kept, cost: str) -> list[int]:
    """Name points of a frontier that another point beats, each held against each."""
    known = [point for point in study["points"] if point["error"] is not None]
    return [
        own["point"]
        for own in on_frontier(study, cost)
        if any(
            other[cost] <= own[cost]
            and other["error"] <= own["error"]
            and (other[cost], other["error"]) != (own[cost], own["error"])
            for other in known
        )
    ]


def span(study: Kept, cost: str = "seconds") -> float:
    """Give the dearest over the cheapest of a frontier."""
    points = on_frontier(study, cost)
    return float(points[-1][cost] / points[0][cost])


def statements(kept: Mapping[str, Kept]) -> list[Statement]:
    """Judge what is kept; a statement about what is not there does not hold."""
    scenes = {scene.name: kept[scene.name] for scene in SCENES if scene.name in kept}
    missing = [scene.name for scene in (*SCENES, LADDER) if scene.name not in kept]
    missing += [] if FIGURE_4 in kept else [FIGURE_4]
    # of an earlier definition, or a part of it
    other = [
        scene.name
        for scene in (*SCENES, LADDER)
        if scene.name in kept
        and {axis["path"]: axis["values"] for axis in kept[scene.name]["axes"]} != dict(scene.axes)
    ]
    beaten = {name: dominated(own, cost) for name, own in scenes.items() for cost in COSTS}
    spans = {name: span(own) for name, own in scenes.items()}
    return [
        Statement(
            "all scenes, the ladder and figure 4 are measured, at all values of their axes",
            not missing and not other,
            f"missing: {', '.join(missing) or 'none'}; at others: {', '.join(other) or 'none'}",
        ),
        Statement(
            "no point of a frontier is beaten by another in error and cost, held one by one",
            bool(scenes) and not any(beaten.values()),
            f"{sum(map(len, beaten.values()))} are beaten",
        ),
        Statement(
            f"every frontier of seconds spans a factor {LEAST_SPAN:g}",
            bool(spans) and min(spans.values()) >= LEAST_SPAN,
            ", ".join(f"{name} {value:.3g}" for name, value in spans.items()) or NOTHING,
        ),
        *_of_ladder(kept.get(LADDER_NAME)),
        _of_steps(foretold(kept)),
        *_of_lights(kept.get(FIGURE_4)),
    ]


def rungs(study: Kept) -> list[dict[str, Any]]:
    """Give the ladder's points from the lowest quality to the highest."""
    order = list(LADDER.axes[QUALITY])
    return sorted(study["points"], key=lambda point: order.index(point["values"][QUALITY]))


@dataclass(frozen=True)
class Foretold:
    """The error of a point a step beside another, all else equal: as predicted, as measured."""

    scene: str
    start: str
    to: str
    before: float
    predicted: float
    measured: float

    @property
    def factor(self) -> float:
        """Predicted over measured."""
        return self.predicted / self.measured


def foretold(kept: Mapping[str, Kept]) -> list[Foretold]:
    """Predict each point from those a quality beside it, as a report does."""
    found = []
    order = list(LADDER.axes[QUALITY])
    for name, study in studies(kept).items():
        by_values = {
            json.dumps(point["values"], sort_keys=True): point for point in study["points"]
        }
        for point in study["points"]:
            at = order.index(point["values"][QUALITY])
            for other in order[max(0, at - 1) : at + 2]:
                values = point["values"] | {QUALITY: other}
                beside = by_values.get(json.dumps(values, sort_keys=True))
                if beside is not None and beside is not point:
                    found.append(
                        Foretold(name, order[at], other, point["error"], _foretell(point, beside),
                                 beside["error"])
                    )  # fmt: skip
    return found


def _foretell(point: Mapping[str, Any], beside: Mapping[str, Any]) -> float:
    factors = line_factors(Resolution(**point["resolution"]), Resolution(**beside["resolution"]))
    lines = {line: factors[kind] for line, kind in DECIDED_BY.items()}
    return scaled_total(point["error"], point["lines"], lines)[0]


def _of_ladder(study: Kept | None) -> list[Statement]:
    points = [] if study is None else rungs(study)
    found = []
    for figure, text in (
        ("error", "the error falls at every rung of the ladder"),
        ("seconds", "seconds rise at every rung"),
        ("bytes", "bytes rise at every rung"),
    ):
        sign = -1 if figure == "error" else 1
        values = [sign * point[figure] for point in points]
        said = [percent(p["error"]) if figure == "error" else f"{p[figure]:.3g}" for p in points]
        holds = len(values) > 1 and all(a < b for a, b in pairwise(values))
        found.append(Statement(text, holds, ", ".join(said) or NOTHING))
    return found


def _of_steps(told: Sequence[Foretold]) -> Statement:
    """Hold predictions against saying that nothing changes."""
    predicted, unchanged = (
        root_mean_square([log(factor) for factor in factors])
        for factors in ([one.factor for one in told], [one.before / one.measured for one in told])
    )
    return Statement(
        "what a report foretells of the error a step away is nearer to it than the asset's own",
        predicted < unchanged,
        f"off by {percent(predicted)} against {percent(unchanged)}, root mean square of logarithms "
        f"of {len(told)}"
        if told
        else NOTHING,
    )


def root_mean_square(values: Sequence[float]) -> float:
    """0 of none."""
    return sqrt(sum(value**2 for value in values) / max(1, len(values)))


def equals(figure: Kept) -> dict[str, list[str]]:
    """Give, by kind of function, the methods of figure 4 of no more numbers than the lobes."""
    (lobes,) = (one for one in figure["methods"] if one["name"].startswith(SCATTERED))
    return {
        kind: [
            one["name"]
            for one in figure["methods"]
            if one["name"].startswith(kind) and one["numbers"] <= lobes["numbers"]
        ]
        for kind in (SCATTERED, *FUNCTIONS, *WAVELETS)
    }


def above(figure: Kept, kinds: Sequence[str], place: int) -> list[str]:
    """Name the lights of which scattered lobes leave more than another kind of as many numbers."""
    methods = equals(figure)
    (lobes,) = methods[SCATTERED]
    others = [name for kind in kinds for name in methods[kind]]
    return [
        light
        for light, errors in figure["lights"].items()
        if any(errors[lobes][place] >= errors[other][place] for other in others)
    ]


def _of_lights(figure: Kept | None) -> list[Statement]:
    lights = [] if figure is None else list(figure["lights"])
    found = [
        Statement(f"figure 4 is of {N_LIGHTS} lights", len(lights) == N_LIGHTS, str(len(lights)))
    ]
    for place, where in enumerate(("over the sphere", "as transfer sees it")):
        wrong = lights if figure is None else above(figure, FUNCTIONS, place)
        found.append(
            Statement(
                "of no more numbers scattered SRBFs leave less than harmonics and uniform SRBFs, "
                f"on every light, {where}",
                bool(lights) and not wrong,
                f"more on {', '.join(wrong)}"
                if wrong
                else f"less on all {len(lights)}"
                if lights
                else NOTHING,
            )
        )
    return found
