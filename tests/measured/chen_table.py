"""Chen's tables beside ours: rows, the file that keeps them, what they prove, and the page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from measured.chen_thesis import METHODS, THESIS
from measured.effects_table import Statement
from measured.pages import table

HEADER = "<!-- Written by `make chen` (tests/measured): change that, not this page. -->"
TITLES = {
    "cpca": "clustered PCA",
    "reclassified": "moves",
    "coherent": "coherence, moves, superclusters",
    "both": "the same with a budget",
}


@dataclass(frozen=True, kw_only=True)
class ChenRow:
    """One method on one scene; ``drawn`` is the overdraw that a renderer of the method has.

    Attributes
    ----------
    seconds
        CPU seconds of clustering and fitting, and of what was done about overdraw.
    overdraw
        A cluster at a time.
    drawn
        A supercluster at a time where the method has these, else ``overdraw``.
    error
        Squared-error ratio in radiance norm, weighted by area.
    """

    scene: str
    clusters: int
    method: str
    vertices: int
    faces: int
    seconds: float
    overdraw: float
    drawn: float
    error: float


@dataclass(frozen=True)
class Beside:
    """A row relative to clustered PCA: the share of (overdraw - 1) left, and the rise in error."""

    left: float
    rise: float


def ours(rows: Sequence[ChenRow], scene: str, clusters: int) -> dict[str, Beside]:
    """Compare each method with our own clustered PCA."""
    own = {row.method: row for row in rows if (row.scene, row.clusters) == (scene, clusters)}
    base = own["cpca"]
    return {
        name: Beside((row.drawn - 1.0) / (base.overdraw - 1.0), row.error / base.error - 1.0)
        for name, row in own.items()
    }


def theirs(scene: str, clusters: int) -> dict[str, Beside]:
    """Compare each method of the thesis with its clustered PCA."""
    own = THESIS[scene, clusters].rows
    _, overdraw, error = own["cpca"]
    return {
        name: Beside((row[1] - 1.0) / (overdraw - 1.0), row[2] / error - 1.0)
        for name, row in own.items()
    }


def statements(rows: Sequence[ChenRow]) -> list[Statement]:
    """Judge every method against every table that has it."""
    found = []
    missing = [key for key in THESIS if all((row.scene, row.clusters) != key for row in rows)]
    found.append(
        Statement(
            f"all {len(THESIS)} tables are measured",
            not missing,
            f"missing: {missing}" if missing else "none is missing",
        )
    )
    measured = [key for key in THESIS if key not in missing]
    for method in METHODS[1:]:
        pairs = [
            (key, ours(rows, *key)[method], theirs(*key)[method])
            for key in measured
            if method in THESIS[key].rows
        ]
        if not pairs:
            continue
        fails = [
            THESIS[key].number
            for key, own, other in pairs
            if own.left > other.left or own.rise > other.rise
        ]
        nearest = max(own.left / other.left for _, own, other in pairs)
        slack = min(other.rise - own.rise for _, own, other in pairs)
        found.append(
            Statement(
                f"{TITLES[method]}: (overdraw - 1) falls by at least what the thesis shows, at no "
                "larger relative rise in error",
                not fails,
                f"in tables {', '.join(fails)} not"
                if fails
                else f"in all {len(pairs)} tables; what is left is at most {nearest:.2f} of what "
                f"the thesis leaves, and the rise below its own by at least {100 * slack:.2f} %",
            )
        )
    return found


def page(rows: Sequence[ChenRow], titles: Mapping[str, str], *, machine: str, about: str) -> str:
    """Return the page."""
    proved = table(
        ["", "statement", "measured"],
        (
            ["holds" if one.holds else "**FAILS**", one.text, one.evidence]
            for one in statements(rows)
        ),
    )
    scenes = [f"## {title[0].upper()}{title[1:]}\n\n{_scene(rows, name)}"
              for name, title in titles.items() if any(row.scene == name for row in rows)]  # fmt: skip
    return (
        "\n\n".join(
            [
                f"{HEADER}\n\n# Chen's tables",
                about,
                machine,
                f"## What the tables prove\n\n{proved}",
                *scenes,
            ]
        )
        + "\n"
    )


def _scene(rows: Sequence[ChenRow], scene: str) -> str:
    own = [row for row in rows if row.scene == scene]
    about = f"{own[0].vertices:,} vertices, {own[0].faces:,} triangles."
    lines = []
    for row in own:
        thesis = THESIS[scene, row.clusters]
        us = ours(rows, scene, row.clusters)[row.method]
        cells = [
            f"{row.clusters}", TITLES[row.method], f"{row.seconds:.1f}", f"{row.overdraw:.3f}",
            f"{row.drawn:.3f}", f"{100 * row.error:.4f} %", f"{us.left:.3f}", f"{100 * us.rise:+.2f} %",
        ]  # fmt: skip
        if row.method in thesis.rows:
            seconds, overdraw, error = thesis.rows[row.method]
            them = theirs(scene, row.clusters)[row.method]
            cells += [
                f"{seconds:.0f}", f"{overdraw:.3f}", f"{error:.4f}",
                f"{them.left:.3f}", f"{100 * them.rise:+.2f} %", thesis.number,
            ]  # fmt: skip
        else:
            cells += ["", "", "", "", "", thesis.number]
        lines.append(cells)
    heads = [
        "clusters", "method", "seconds", "overdraw", "drawn", "error", "left", "rise",
        "thesis: seconds", "overdraw", "error", "left", "rise", "table",
    ]  # fmt: skip
    return f"{about}\n\n{table(heads, lines)}"
