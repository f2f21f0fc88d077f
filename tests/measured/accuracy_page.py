"""The page on what accuracy costs, from what is kept of its studies."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from measured.accuracy_scenes import CENTRES, FIGURE_4, LADDER, LADDER_NAME, QUALITY, SCENES
from measured.accuracy_table import (
    SCATTERED,
    WAVELETS,
    Foretold,
    Kept,
    above,
    equals,
    foretold,
    rungs,
)
from measured.effects_table import Statement
from measured.pages import percent, seconds, size, table

HEADER = "<!-- Written by `make accuracy` (tests/measured): change that, not this page. -->"
INTRO = """\
# What accuracy costs

Error against seconds and bytes: four scenes at combinations of qualities, functions and ranks, each a
[study](../studies.md) given to a service with two workers; one scene at every quality; and lights of as many
numbers. `make accuracy PRTBAKE_DATA=...` measures all of it anew, `.venv/bin/python tests/measured/accuracy.py
teapot figure4` what is named, and the rest stays. Errors are the relative L2 of the delivered pictures against the
brute-force reference, over all pictures of two cameras, the same for every point. Seconds are those of the work that makes a point's
file, whichever point had it done; pictures and validation are not in them. Errors and bytes repeat, seconds do
not. [accuracy.csv](accuracy.csv) has every point."""
SHORT = {
    QUALITY: "quality",
    CENTRES: "SRBFs",
    "settings.compress.ranks": "ranks",
    "settings.compress.n_components": "components",
    "settings.compress.n_clusters": "clusters",
    "settings.fit_light.n_lobes": "lobes",
}
"""What a column of an axis is called."""


def page(kept: Mapping[str, Kept], found: Sequence[Statement]) -> str:
    """Write the whole page; what was not measured is left out."""
    sections = [
        f"{HEADER}\n\n{INTRO}",
        "\n".join(
            f"- {'holds' if one.holds else '**fails**'}: {one.text} ({one.evidence})"
            for one in found
        ),
    ]
    sections += [frontier(kept[scene.name]) for scene in SCENES if scene.name in kept]
    if LADDER_NAME in kept:
        sections.append(ladder(kept[LADDER_NAME]))
    if told := foretold(kept):
        sections.append(steps(told))
    if FIGURE_4 in kept:
        sections.append(lights(kept[FIGURE_4]))
    return "\n\n".join(sections) + "\n"


def frontier(study: Kept) -> str:
    """Show a scene's frontiers: picture, points on either, and where their errors lie."""
    paths = [axis["path"] for axis in study["axes"] if len(axis["values"]) > 1]
    points = [point for point in study["points"] if point["frontier"]]
    points.sort(key=lambda point: point["seconds"])
    rows = [
        [
            *(_value(point["values"][path]) for path in paths),
            percent(point["error"]), percent(point["noise"]), seconds(point["seconds"]),
            size(point["bytes"]), size(point["peak_memory_bytes"]), " and ".join(point["frontier"]),
        ]
        for point in points
    ]  # fmt: skip
    heads = [SHORT.get(path, path) for path in paths]
    return "\n\n".join(
        (
            f"## {study['title']}",
            f"{study['about']} {len(study['points'])} points; those on a frontier:",
            _picture(study),
            table([*heads, "error", "noise", "seconds", "asset.h5", "peak memory", "frontier of"],
                  rows),
            _lines(points[0], points[-1]),
            _measured(study),
        )
    )  # fmt: skip


def _picture(study: Kept) -> str:
    return (
        f"![Error against seconds and against bytes](../images/accuracy-{study['name']}.png)\n\n"
        f"[The same, to point at](accuracy/{study['name']}.html)."
    )


def _lines(cheapest: Mapping[str, Any], best: Mapping[str, Any]) -> str:
    """Say where the errors of the two ends of a frontier lie."""
    names = list(dict.fromkeys([*cheapest["lines"], *best["lines"]]))
    return (
        "Where the error of the cheapest and of the best of these lies, line by line:\n\n"
        + table(
            ["line of the budget", "cheapest", "best"],
            [
                [name, percent(cheapest["lines"].get(name)), percent(best["lines"].get(name))]
                for name in names
            ],
        )
    )


def _measured(study: Kept) -> str:
    return f"{study['machine']} The study took {seconds(study['wall_seconds'])}: {study['summary']}"


def _value(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def ladder(study: Kept) -> str:
    """Show the rungs beside each other."""
    rows = [
        [
            point["values"][QUALITY], percent(point["error"]), percent(point["noise"]),
            seconds(point["seconds"]), seconds(point["check_seconds"]), size(point["bytes"]),
            size(point["peak_memory_bytes"]),
        ]
        for point in rungs(study)
    ]  # fmt: skip
    return "\n\n".join(
        (
            f"## {study['title']}",
            study["about"],
            table(
                ["quality", "error", "noise", "seconds", "seconds of validation", "asset.h5",
                 "peak memory"], rows,
            ),
            _picture(study),
            _lines(rungs(study)[0], rungs(study)[-1]),
            _measured(study),
        )
    )  # fmt: skip


def steps(told: Sequence[Foretold]) -> str:
    """Hold what reports say of the qualities beside an asset's own against what was measured."""
    rows = []
    for name in dict.fromkeys(one.scene for one in told):
        for text, sign in (("more", 1), ("less", -1)):
            own = [one for one in told if one.scene == name and _direction(one) == sign]
            if own:
                rows.append([name, text, str(len(own)), *_quantiles(own)])
    rows.append(["all", "", str(len(told)), *_quantiles(told)])
    return "\n\n".join(
        (
            "## A step more or less, as predicted",
            "What [a report predicts](../studies.md#a-step-more-or-less) of the error at the "
            "qualities beside its own, made for every point above that has such a neighbour with all "
            "else equal, over what that neighbour measured; and, to compare, the point's own error "
            "over the neighbour's, which is what one would say who knew of no change.",
            table(
                ["scene", "a step", "pairs", "predicted over measured: median", "least", "most",
                 "unchanged over measured: median", "least", "most"],
                rows,
            ),
        )
    )  # fmt: skip


def _direction(one: Foretold) -> int:
    order = list(LADDER.axes[QUALITY])
    return order.index(one.to) - order.index(one.start)


def _quantiles(told: Sequence[Foretold]) -> list[str]:
    found = []
    for factors in ([one.factor for one in told], [one.before / one.measured for one in told]):
        found += [f"{value:.2f}" for value in (median(factors), min(factors), max(factors))]
    return found


def lights(figure: Kept) -> str:
    """Show figure 4 at equal numbers, and say where the paper's order does not hold."""
    methods = [name for names in equals(figure).values() for name in names]
    by_name = {one["name"]: one for one in figure["methods"]}
    found = [
        "## Lights of as many numbers",
        "Figure 4 of [Tsai2006] on six environments, each merged into a cube map of 32 x 32 texels a face: what a "
        "sum of functions of no more numbers than 162 scattered SRBFs leaves of it, squared. "
        "[Measured, lights](figure4.md) shows them, says how they are counted, and has three times as many "
        "numbers too.",
    ]
    for place, where in enumerate(("over the sphere", "as transfer sees it")):
        rows = [
            [light, *(percent(errors[name][place]) for name in methods)]
            for light, errors in figure["lights"].items()
        ]
        rows.append(["numbers", *(str(by_name[name]["numbers"]) for name in methods)])
        rows.append(["CPU seconds", *(f"{by_name[name]['seconds']:.1f}" for name in methods)])
        found += [f"Error {where}:", table(["light", *methods], rows)]
        worse = above(figure, WAVELETS, place)
        lobes = equals(figure)[SCATTERED][0]
        found.append(
            f"{lobes} leaves less than wavelets on every light."
            if not worse
            else f"The paper's pictures have scattered SRBFs above area-weighted wavelets. In squared "
            f"error {where} that does not hold here: wavelets of one kind or both leave less than "
            f"{lobes} on {len(worse)} of {len(figure['lights'])} lights ({', '.join(worse)}). They "
            "live on the very texels of the map, where a lamp is a handful of coefficients."
        )
    return "\n\n".join([*found, figure["machine"]])
