"""The account of a job: what every stage cost, what error it left, and where the total comes from.

Everything here is plain JSON from the stages' results; nothing is measured anew.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from prtbake_workers.validation.budget import Budget, BudgetLine, pool_budgets

ERRORS_ARE = {
    "plan": "what the K terms leave of the BRDF, over all pairs of directions with weight "
    "cos² cos², over the BRDF's own norm",
    "bake": "what the projection leaves of the transport in the directions of the fit and in "
    "others, and what 16 bits change of its coefficients: weighted by area, over the transport "
    "sampled in the same directions; over that of the fit for the 16 bits",
    "bounces": "what the number of rays leaves to chance and means over neighbours blur, what 16 "
    "bits change of the bounces, what later bounces would add, and what clusters leave of the "
    "light that scatters inside: weighted by area, over the transport with its bounces",
    "compress": "what clusters and ranks leave of the stored coefficients: weighted by area, over "
    "these coefficients",
    "quantise": "of a part: what rounding its factors changes of the compressed coefficients, "
    "weighted by area, over the transport as it was baked; of a view texture's rounding: what it "
    "changes of the radiance, over the same; of a view texture: what its lookup changes of the "
    "BRDF's terms, over all pairs of directions with weight cos² cos², over these terms; of what "
    "is left out for its bytes: what columns that max_bytes had no room for add to the error",
    "fit_light": "what the light leaves of the environment, over the sphere, over the environment",
}
"""Norm and denominator of each stage's own errors; all are ratios of squared radiance."""


@dataclass(frozen=True)
class StageAccount:
    """One stage: seconds of work summed over tiles, the largest tile's memory, its own errors.

    ``bytes`` are those of the files it left, equal ones counted once.
    """

    name: str
    tiles: int
    seconds: float
    peak_memory_bytes: int
    bytes: int
    predicted_seconds: float | None = None
    errors: dict[str, float] = field(default_factory=dict)


def projection_errors(
    parts: Sequence[Mapping[str, Any]], tiles: Sequence[Mapping[str, Any]]
) -> dict[str, float]:
    """Return each part's squared-error ratios over its tiles.

    Of the projection in the directions that it was fitted in, in others, and of 16-bit rounding.
    """
    done = iter(tiles)
    errors = {}
    for part in parts:
        own = [next(done) for _ in part["tiles"]]
        name = part["name"]
        for label, error, signal in (
            (name, "residual", "signal"),
            (f"{name} in other directions", "held_out_residual", "held_out_signal"),
            (f"{name} 16-bit", "rounding", "signal"),
        ):
            whole = sum(tile[signal] for tile in own)
            errors[label] = sum(tile[error] for tile in own) / whole if whole else 0.0
    return errors


def part_accounts(
    parts: Sequence[Mapping[str, Any]],
    compressed: Sequence[Mapping[str, Any]],
    precision: Sequence[Mapping[str, Any]] = (),
    superclusters: Sequence[Mapping[str, Any] | None] = (),
) -> list[dict[str, Any]]:
    """Say of each part how it was compressed, how far, in how many bits, and how often drawn."""
    accounts = []
    held = precision or [{"bits": {}, "error": None}] * len(parts)
    grouped = superclusters or [None] * len(parts)
    for part, factors, rounded, groups in zip(parts, compressed, held, grouped, strict=True):
        start, stop = part["vertex_range"]
        compression = part["compression"]
        cta = factors["method"] == "cta"
        accounts.append(
            {
                "name": part["name"],
                "role": part["role"],
                "vertices": stop - start,
                "terms": part["n_terms"],
                "method": factors["method"],
                "clusters": factors["clusters"],
                "ranks": " x ".join(map(str, compression["ranks"]))
                if cta
                else str(compression["n_components"]),
                "compression_ratio": factors["transfer_bytes"] / max(1, factors["factor_bytes"]),
                "bits": dict(rounded["bits"]),
                "quantisation_error": rounded["error"],
                "overdraw": factors["overdraw"],
                "superclusters": None if groups is None else dict(groups),
                "objective": factors["objective"],
                "notes": factors["notes"],
            }
        )
    return accounts


def pooled_budget(views: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Pool the budgets of all pictures into one."""
    budgets = [
        Budget(
            lines=tuple(BudgetLine(**line) for line in view["budget"]["lines"]),
            **{
                name: view["budget"][name]
                for name in (
                    "total",
                    "total_noise",
                    "total_below_noise",
                    "reference_noise",
                    "squared_norm",
                    "black_reference",
                )
            },
        )
        for view in views
    ]
    return pool_budgets(budgets).to_dict()


def make_report(
    *,
    title: str,
    stages: Sequence[StageAccount],
    parts: Sequence[Mapping[str, Any]] = (),
    effects: Sequence[Mapping[str, Any]] = (),
    views: Sequence[Mapping[str, Any]] = (),
    settings: Mapping[str, Any] | None = None,
    sizes: Mapping[str, int] | None = None,
    renderer: Mapping[str, Any] | None = None,
    counters: Mapping[str, int | float] | None = None,
    numerics: Mapping[str, Any] | None = None,
    bounces: Mapping[str, Any] | None = None,
    transfer: Mapping[str, Any] | None = None,
    ladder: Sequence[Mapping[str, Any]] = (),
    frontier: Mapping[str, Any] | None = None,
    search: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    overdraw: float | None = None,
) -> dict[str, Any]:
    """Put the account together; every key is there whatever the job did.

    ``overdraw`` is that of all parts of the asset together, None where none was made.
    """
    budget = pooled_budget(views) if views else None
    seconds = sum(stage.seconds for stage in stages)
    peak = max((stage.peak_memory_bytes for stage in stages), default=0)
    summary = f"{seconds:.0f} s of work, at most {peak / 2**30:.2f} GiB in one process."
    if budget is not None:
        shown = sum(view["hits"] > 0 for view in views)
        unseen = f" ({len(views) - shown} more show nothing)" if shown < len(views) else ""
        noisy = (
            f", below the {100 * budget['total_noise']:.2g} % that the reference's noise hides"
            if budget["total_below_noise"]
            else ""
        )
        summary += (
            f" Over {shown} pictures{unseen} the reference is black or lost in its noise: there is "
            "no relative error of the delivered asset."
            if budget["black_reference"]
            else f" Over {shown} pictures{unseen} the delivered asset is "
            f"{100 * budget['total']:.2g} % from the reference (relative L2){noisy}."
        )
    if overdraw is not None:
        summary += f" A cluster at a time, a triangle is drawn {overdraw:.2f} times on average."
    return {
        "title": title,
        "summary": summary,
        "stages": [
            asdict(stage) | {"errors_are": ERRORS_ARE.get(stage.name) if stage.errors else None}
            for stage in stages
        ],
        "errors": {stage.name: stage.errors for stage in stages if stage.errors},
        "seconds": {stage.name: stage.seconds for stage in stages} | {"total": seconds},
        "bytes": dict(sizes or {}),
        "peak_memory_bytes": peak,
        "parts": list(parts),
        "overdraw": overdraw,
        "effects": list(effects),
        "bounces": dict(bounces) if bounces else None,
        "budget": budget,
        "views": [
            {name: view[name] for name in ("picture", "hits", "budget", "metrics", "exposure")}
            for view in views
        ],
        "metrics": [{"picture": view["picture"], **view["metrics"]} for view in views],
        "renderer": dict(renderer) if renderer else None,
        "counters": dict(counters or {}),
        "transfer": dict(transfer) if transfer else None,
        "numerics": dict(numerics or {}),
        "settings": dict(settings or {}),
        "ladder": [dict(step) for step in ladder],
        "frontier": dict(frontier) if frontier else None,
        "search": dict(search) if search else None,
        "notes": list(notes),
    }
