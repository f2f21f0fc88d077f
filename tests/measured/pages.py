"""A page of measured results: what a finished job says of itself, as Markdown tables.

Everything is taken from the job's own ``report.json``; nothing is measured anew.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

HEADER = "<!-- Written by `make results` (tests/measured): change that, not this page. -->"
Report = Mapping[str, Any]


@dataclass(frozen=True)
class Run:
    """A finished asset job: what it was, what it was typed as, where it ran, what it reported.

    ``seconds`` is the wall-clock time from the job's start to its end; ``images`` are the
    pictures' captions and their paths as seen from the page.
    """

    title: str
    about: str
    command: str
    machine: str
    seconds: float
    report: Report
    images: Mapping[str, str]


@dataclass(frozen=True)
class RankPair:
    """A compression of the same transfer; ``theirs`` is the size that the paper states."""

    ranks: tuple[int, int, int]
    report: Report
    theirs: str


def page(run: Run, pairs: Sequence[RankPair] = ()) -> str:
    """Return the whole page; sections of what the job did not do say so or are left out."""
    report = run.report
    sections = [
        f"{HEADER}\n\n# {run.title}\n\n{run.about}",
        f"```sh\n{run.command}\n```",
        f"{run.machine} The job took {seconds(run.seconds)} from start to end. Errors and bytes "
        "repeat from run to run, seconds do not.",
        *(f"![{caption}]({path})" for caption, path in run.images.items()),
        f"## Parts\n\n{_parts(report)}",
        "## Each stage's own error\n\nSquared-error ratios in radiance norm, weighted by area, of "
        "what the stage was given: `plan` cuts the BRDF to its terms, `bake` projects transport, "
        "`quantise` rounds the factors; that of `fit_light` is of the light itself.\n\n"
        f"{_errors(report)}",
        f"## What each stage cost\n\n{_costs(report)}",
        f"## Bounces\n\n{_bounces(report)}",
    ]
    if pairs:
        sections.append(f"## Ranks\n\n{_pairs(pairs)}")
    sections += [
        f"## End to end\n\n{_budget(report)}",
        f"## Picture by picture\n\n{_metrics(report)}",
        f"## Effects\n\n{_effects(report)}",
    ]
    if report["notes"]:
        sections.append("## Notes\n\n" + "\n".join(f"- {note}" for note in report["notes"]))
    return "\n\n".join(sections) + "\n"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; bars inside cells are escaped."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def percent(ratio: float | None) -> str:
    """Write a ratio to three digits; nothing where there is none."""
    return "" if ratio is None else f"{100 * ratio:.3g} %"


def hundredths(ratio: float) -> str:
    """Write a ratio to a hundredth of a percent, which is what the pictures' noise lets one tell."""
    return f"{100 * ratio:.2f} %"


def size(count: float) -> str:
    """Write bytes in decimal units, as the papers do."""
    for unit in ("B", "kB", "MB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def seconds(count: float) -> str:
    """Write a duration."""
    return f"{count:.1f} s" if count < 120 else f"{count / 60:.1f} min"


def _parts(report: Report) -> str:
    text = table(
        ["part", "vertices", "terms", "method", "clusters", "ranks", "compression"],
        (
            [
                part["name"], f"{part['vertices']:,}", str(part["terms"]), part["method"].upper(),
                str(part["clusters"]), part["ranks"], f"{part['compression_ratio']:.3g} : 1",
            ]
            for part in report["parts"]
        ),
    )  # fmt: skip
    falls = [
        f"{part['name']} {_fall(part['objective'])}"
        for part in report["parts"]
        # clustered PCA ends with the components, whose step is no iteration
        if part["method"] == "cta" and part["objective"][0] > 0
    ]
    if not falls:
        return text
    return f"{text}\n\nObjective in every step, of the first: {'; '.join(falls)}."


def _fall(objective: Sequence[float]) -> str:
    return ", ".join(f"{value / objective[0]:.4f}" for value in objective)


def _errors(report: Report) -> str:
    return table(
        ["stage", "of", "error"],
        (
            [stage["name"], name, percent(error)]
            for stage in report["stages"]
            for name, error in stage["errors"].items()
        ),
    )


def _costs(report: Report) -> str:
    text = table(
        ["stage", "tasks", "seconds of work", "bytes left", "peak memory of a process"],
        [
            *(
                [
                    stage["name"], str(stage["tiles"]), f"{stage['seconds']:.1f}",
                    size(stage["bytes"]), size(stage["peak_memory_bytes"]),
                ]
                for stage in report["stages"]
            ),
            ["**total**", "", f"**{report['seconds']['total']:.1f}**", "",
             f"**{size(report['peak_memory_bytes'])}**"],
        ],
    )  # fmt: skip
    files = ", ".join(f"{name} {size(count)}" for name, count in report["bytes"].items())
    return f"{text}\n\nFiles: {files}."


def _bounces(report: Report) -> str:
    bounces = report["bounces"]
    if bounces is None:
        return "None were baked; the table of effects says why."
    text = table(
        ["bounce", *(f"energy added to the {name}" for name in bounces["added"])],
        (
            [str(k), *map(percent, added)]
            for k, added in enumerate(zip(*bounces["added"].values(), strict=True), start=1)
        ),
    )
    channels = "one channel" if bounces["channels"] == 1 else f"{bounces['channels']} channels"
    left = ", ".join(f"{percent(v)} to the {name}" for name, v in bounces["left_out"].items())
    rest = (
        "nothing bounds what later bounces would add"
        if not bounces["left_out"]
        else f"later bounces would add {left} ({bounces['left_out_is']})"
    )
    return f"{text}\n\nIn {channels}; {rest}."


def _pairs(pairs: Sequence[RankPair]) -> str:
    return (
        "The rank pairs of Tsai and Shih's figure 5, each with eight view ranks, from this job's "
        "transfer; an asset's bytes hold mesh, plane and view textures too.\n\n"
    ) + table(
        ["ranks (view, light, vert)", "error of the object", "asset.h5", "seconds of compression",
         "theirs, 61k vertices, 170 clusters"],
        (
            [
                ", ".join(map(str, pair.ranks)),
                percent(pair.report["errors"]["compress"]["object"]),
                size(pair.report["bytes"]["asset.h5"]),
                f"{pair.report['seconds']['compress']:.1f}",
                pair.theirs,
            ]
            for pair in pairs
        ),
    )  # fmt: skip


def _budget(report: Report) -> str:
    budget = report["budget"]
    text = table(
        ["line", "error", "noise"],
        [
            *(
                [f"+ {line['name']}", _starred(line["error"], line["below_noise"]),
                 _noise(line["noise"])]
                for line in budget["lines"]
            ),
            ["sum of the lines", hundredths(budget["sum_of_lines"]), ""],
            ["**measured**", f"**{_starred(budget['total'], budget['total_below_noise'])}**",
             _noise(budget["total_noise"])],
        ],
    )  # fmt: skip
    of = "the brightest picture" if budget["black_reference"] else "the reference"
    return (
        f"Relative L2 over all validation pictures, of {of}; a star says that a line is below its "
        f"own noise.\n\n{text}"
    )


def _starred(error: float, below_noise: bool) -> str:
    return hundredths(error) + (" \\*" if below_noise else "")


def _noise(noise: float) -> str:
    # the difference of two pictures without samples has none but rounding
    return hundredths(noise) if noise > 1e-12 else ""


def _metrics(report: Report) -> str:
    return table(
        ["picture", "relative L2", "PSNR", "FLIP"],
        (
            [
                one["picture"],
                percent(one["relative_l2"]),
                "" if one["psnr_db"] is None else f"{one['psnr_db']:.1f} dB",
                f"{one['flip']:.3f}",
            ]
            for one in report["metrics"]
        ),
    )


def _effects(report: Report) -> str:
    return table(
        ["effect", "decided", "why", "error the other way"],
        (
            [
                effect["effect"].replace("_", " "),
                ("taken" if effect["taken"] else "left") + (", forced" if effect["forced"] else ""),
                effect["reason"],
                percent(effect["predicted_error_otherwise"]),
            ]
            for effect in report["effects"]
        ),
    )
