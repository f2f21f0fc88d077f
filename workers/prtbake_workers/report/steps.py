"""Where an asset lies on the frontier of what accuracy costs, and what a step beside it would give.

The asset's own figures are measured; those of the steps beside it are predicted from them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from prtbake_workers.planning.step_errors import scaled_total
from prtbake_workers.validation.chain import (
    BASIS_LINES,
    MERGED_LINE,
)

DECIDED_BY: Mapping[str, str] = {
    "K terms": "terms",
    "visibility sampling": "visibility",
    BASIS_LINES["srbf"]: "basis",
    BASIS_LINES["sh"]: "basis",
    "light fit": "light",
    "compression": "compression",
    "rounded factors": "compression",
    MERGED_LINE: "compression",
}
"""Line of the error budget -> its kind in `POWERS`."""

PREDICTED_BY = (
    "Seconds and bytes of a step are those that planning predicts, times what this asset measured "
    "over what was predicted of it. Its error is this asset's, each line of the error budget "
    "multiplied by a power of the ratio of the number that decides it (energy that terms leave, "
    "directions, functions of the basis, functions of the light, vectors of the compression), the "
    "others as they are; how far lines cancel is taken to stay."
)


def frontier(
    ladder: Sequence[Mapping[str, Any]], budget: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """Put an asset, as measured, beside the steps next to it, as predicted.

    Parameters
    ----------
    ladder
        Of the report: the asset's own entry has no ``quality``; the others have ``error_factors``.
    budget
        Of all pictures; nothing can be said without one, or of a black reference.
    """
    if budget is None or budget["black_reference"] or not ladder:
        return None
    (own,) = (step for step in ladder if step["quality"] is None)
    lines = {line["name"]: line["error"] for line in budget["lines"]}
    dearer = own["measured_seconds"] / own["seconds"] if own["seconds"] else 1.0
    larger = own["measured_bytes"] / own["asset_bytes"] if own["asset_bytes"] else 1.0
    steps = []
    for step in ladder:
        if step["quality"] is None:
            continue
        factors = {
            line: step["error_factors"][kind]
            for line, kind in DECIDED_BY.items()
            if kind in step["error_factors"]
        }
        error, scaled = scaled_total(budget["total"], lines, factors)
        steps.append(
            {
                "quality": step["quality"],
                "error": error,
                "seconds": dearer * step["seconds"],
                "bytes": larger * step["asset_bytes"],
                "lines": scaled,
            }
        )
    return {
        "asset": {
            "quality": None,
            "error": budget["total"],
            "noise": budget["total_noise"],
            "seconds": own["measured_seconds"],
            "bytes": own["measured_bytes"],
            "lines": lines,
        },
        "steps": steps,
        "predicted_by": PREDICTED_BY,
    }


def drawn(own: Mapping[str, Any]) -> tuple[list[dict[str, Any]], dict[str, list[int]]]:
    """Give the points of `frontier` and what stands out of them, as `frontier_png` takes them."""
    points = [{"point": 0, "label": "this asset", **own["asset"]}]
    points += [
        {"point": place, "label": step["quality"], **step}
        for place, step in enumerate(own["steps"], start=1)
    ]
    return points, {"seconds": [0], "bytes": [0]}
