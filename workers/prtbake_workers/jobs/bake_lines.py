"""What a bake says of its own errors, line by line: squared-error ratios of each part."""

from collections.abc import Mapping
from math import inf, isfinite, sqrt
from typing import Any

from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs import bounce
from prtbake_workers.planning.bake_model import Numbers, Told, effects_left_out
from prtbake_workers.report.account import projection_errors

TERMS, PROJECTION = "terms", "directions and functions"

OF_BOUNCES = {
    "rays": "rays of bounces",
    "left out": "later bounces",
    "16-bit": "16 bits of bounces",
    "scattering": "scattering inside",
}
"""Lines of the stage of bounces, as it names them and as an account of a bake does."""

Lines = dict[str, dict[str, float]]
"""Part -> line -> squared-error ratio."""


def lines_of(results: Results) -> Lines:
    """List the lines of each part of a finished bake.

    Terms are over the BRDF's norm, the projection and its 16 bits over the direct transport,
    bounces and scattering over the transport with them; effects that planning left out are those
    that it predicts to cost most on any part.  A line that nothing bounds is infinite; those of
    black parts are nothing, as nothing of them is seen.
    """
    (planned,) = results["plan"]
    plan = planned["plan"]
    projected = projection_errors(plan["parts"], results["bake"])
    bounced = bounce.errors(results)
    left_out = effects_left_out(plan["effects"])
    found: Lines = {}
    for index, part in enumerate(plan["parts"]):
        name = part["name"]
        lines = {
            TERMS: planned["errors"][name],
            PROJECTION: projected[f"{name} in other directions"],
            "16 bits": projected[f"{name} 16-bit"],
            "effects left out": left_out,
        }
        for label, line in OF_BOUNCES.items():
            if f"{name} {label}" in bounced:
                lines[line] = bounced[f"{name} {label}"]
        if _unbounded(results, plan, index):
            lines[OF_BOUNCES["left out"]] = inf
        black = planned["black"][index]
        found[name] = {line: 0.0 if black else float(error) for line, error in lines.items()}
    return found


def _unbounded(results: Results, plan: Mapping[str, Any], part: int) -> bool:
    """Tell whether nothing bounds what a part's bounces leave out."""
    if plan["bounces"] is None or not plan["bounces"]["max_bounces"]:
        return False
    blocks = results["bounces"]
    return any(block["left_out"] is None and block["total"][part] > 0.0 for block in blocks)


def told_of(results: Results, numbers: Numbers, seconds: float | None) -> Told:
    """Tell a search of a finished bake, seen as a job of its own."""
    lines = list(lines_of(results).values())
    return Told(
        numbers=numbers,
        projection=tuple(own[PROJECTION] for own in lines),
        terms=tuple(own[TERMS] for own in lines),
        rest=tuple(
            sum(error for line, error in own.items() if line not in (PROJECTION, TERMS))
            for own in lines
        ),
        size=int(results["join"][0]["bytes"]),
        seconds=seconds,
    )


def account_of(lines: Lines) -> dict[str, Any]:
    """Give a figure and where it comes from, as JSON.

    ``error`` is the root of the sum of a part's lines, of the part where it is largest; ``binds``
    the largest of its lines.  None stands for what nothing bounds.
    """
    part = max(lines, key=lambda name: sum(lines[name].values()))
    return {
        "error": finite(sqrt(sum(lines[part].values()))),
        "part": part,
        "binds": max(lines[part], key=lambda line: lines[part][line]),
        "lines": {
            name: {line: finite(error) for line, error in own.items()}
            for name, own in lines.items()
        },
    }


def finite(error: float) -> float | None:
    """Give what JSON can hold."""
    return error if isfinite(error) else None
