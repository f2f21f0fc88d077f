"""What was measured beside [Sloan2003]: the file that keeps it, what it proves, and the page."""

from collections.abc import Sequence
from dataclasses import dataclass

from measured.effects_table import Statement
from measured.pages import size, table

HEADER = "<!-- Written by `make sloan` (tests/measured): change that, not this page. -->"
TABLE_1, FIGURE_2, FIGURE_3 = "table 1", "figure 2", "figure 3"


@dataclass(frozen=True, kw_only=True)
class Result:
    """One compression.

    Attributes
    ----------
    of
        The table or figure of the paper that it stands beside.
    row, theirs
        Our signal, and the paper's that it stands for.
    method
        ``static``, ``iterative`` or ``adaptive``; ``vq`` for means alone.
    error
        Squared error over squared norm, by area.
    median, p99, worst
        Squared error of single vertices over the mean squared norm, by area.
    nbytes
        Of the float32 factors.
    their_ratio
        Iterative over static squared error in the paper; 0 where it states none.
    overdraw, their_overdraw
        How often a triangle is drawn, ours and in the paper; 0 where that is not looked at.
    """

    of: str
    row: str
    theirs: str = ""
    vertices: int
    matrix: str
    clusters: int
    components: int
    method: str
    error: float
    median: float = 0.0
    p99: float = 0.0
    worst: float = 0.0
    nbytes: int
    seconds: float
    their_ratio: float = 0.0
    overdraw: float = 0.0
    their_overdraw: float = 0.0


def trios(results: Sequence[Result]) -> list[tuple[Result, Result, Result]]:
    """Give static, iterative and adaptive of the same signal and size."""
    cells: dict[tuple[str, str, int, int], dict[str, Result]] = {}
    for one in results:
        key = (one.of, one.row, one.clusters, one.components)
        cells.setdefault(key, {})[one.method] = one
    return [
        (cell["static"], cell["iterative"], cell["adaptive"])
        for cell in cells.values()
        if {"static", "iterative", "adaptive"} == set(cell)
    ]


def statements(results: Sequence[Result]) -> list[Statement]:
    """Judge: iterative below static, adaptive not above iterative, at equal storage."""
    found = trios(results)
    gains = [iterative.error / static.error for static, iterative, _ in found]
    more = [adaptive.error / iterative.error for _, iterative, adaptive in found]
    larger = [
        max(iterative.nbytes / static.nbytes, adaptive.nbytes / static.nbytes)
        for static, iterative, adaptive in found
    ]
    return [
        Statement(
            "iterative is below static in squared error on every row",
            bool(gains) and max(gains) < 1.0,
            _range(gains) + " of static",
        ),
        Statement(
            "adaptive is not above iterative in squared error on any row",
            bool(more) and max(more) <= 1.0,
            _range(more) + " of iterative",
        ),
        Statement(
            "neither takes more bytes than static",
            bool(larger) and max(larger) <= 1.0,
            f"at most {max(larger, default=0.0):.4f} of static",
        ),
    ]


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.3f} to {max(values):.3f}" if values else "none was measured,"


def page(
    results: Sequence[Result],
    *,
    machine: str,
    about: str,
    proved: Sequence[Statement],
    overdraw: str,
) -> str:
    """Return the page, with what was ``proved`` and the section on ``overdraw``."""
    held = table(
        ["", "statement", "measured"],
        (["holds" if one.holds else "**FAILS**", one.text, one.evidence] for one in proved),
    )
    sections = [
        f"{HEADER}\n\n# Clustered PCA beside Sloan et al.",
        f"{about} {machine}",
        f"## What the tables prove\n\n{held}",
        f"## Table 1\n\n{_table_1(results)}",
        f"## Figure 2: static, by clusters and components\n\n{_figure_2(results)}",
        f"## Figures 3 and 4: the three methods by components\n\n{_figure_3(results)}",
        overdraw,
    ]
    return "\n\n".join(sections) + "\n"


def _of(results: Sequence[Result], what: str) -> list[Result]:
    return [one for one in results if one.of == what]


def _table_1(results: Sequence[Result]) -> str:
    return table(
        ["row", "theirs", "vertices", "matrix", "clusters", "components", "bytes", "static",
         "iterative", "adaptive", "iterative / static", "theirs", "seconds"],
        (
            [
                static.row, static.theirs, f"{static.vertices:,}", static.matrix,
                str(static.clusters), str(static.components), size(static.nbytes),
                _error(static), _error(iterative), _error(adaptive),
                f"{iterative.error / static.error:.2f}", f"{static.their_ratio:.2f}",
                f"{static.seconds:.1f}, {iterative.seconds:.1f}, {adaptive.seconds:.1f}",
            ]
            for static, iterative, adaptive in trios(_of(results, TABLE_1))
        ),
    )  # fmt: skip


def _figure_2(results: Sequence[Result]) -> str:
    own = _of(results, FIGURE_2)
    counts = sorted({one.components for one in own})
    cells = {(one.clusters, one.components): one for one in own}
    return table(
        [
            "clusters",
            *("means only" if n == 0 else f"{n} component{'s' * (n > 1)}" for n in counts),
        ],
        (
            [
                str(clusters),
                *(
                    f"{_error(cells[clusters, n])} ({size(cells[clusters, n].nbytes)})"
                    for n in counts
                ),
            ]
            for clusters in sorted({one.clusters for one in own})
        ),
    )


def _figure_3(results: Sequence[Result]) -> str:
    text = (
        "Figure 4 draws the error of every vertex at 3 components. Here are, of each "
        "method, the squared errors that one vertex in a hundred exceeds and of the worst one, over the mean squared "
        "norm.\n\n"
    )
    return text + table(
        ["components", "clusters", "bytes", "static", "iterative", "adaptive",
         "one vertex in a hundred above", "worst vertex", "seconds"],
        (
            [
                str(trio[0].components), str(trio[0].clusters), size(trio[0].nbytes),
                *map(_error, trio),
                ", ".join(f"{100 * one.p99:.3g}" for one in trio) + " %",
                ", ".join(f"{100 * one.worst:.3g}" for one in trio) + " %",
                ", ".join(f"{one.seconds:.1f}" for one in trio),
            ]
            for trio in trios(_of(results, FIGURE_3))
        ),
    )  # fmt: skip


def _error(result: Result) -> str:
    return f"{100 * result.error:.3g} %"
