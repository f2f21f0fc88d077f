"""Overdraw of [Sloan2003] section 7 anew: vertices moved, clusters drawn together, and both.

His table has anisotropic glossy transfer of the Buddha and the bird; the bunny stands for the bird.
Meshes are whole, in all 256 clusters: every eighth vertex would have no triangles.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from measured.effects_table import Statement
from measured.pages import table
from measured.sloan_scenes import ROWS, Row, transfer
from measured.sloan_table import Result
from prtbake_storage.decode.overdraw import average_overdraw
from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.less_overdraw import less_overdraw_cpca
from prtbake_workers.compress.reclassify_overdraw import BUDGET
from prtbake_workers.compress.superclusters import make_superclusters, registers_of_clusters

OVERDRAW = "overdraw"
KINDS = ("original", "rec", "sc", "sc+rec")
TITLES = {"rec": "moves", "sc": "superclusters", "sc+rec": "both"}
REGISTERS = 256
"""Of section 6.2: a cluster of 24 numbers of the view, a mean and 8 components takes 54 of them."""

ABOUT = f"""\
Triangles are drawn once for every cluster that their corners lie in, or every group of clusters. Original is static
clustered PCA of the whole mesh, what jobs do unless asked otherwise (the paper does not say which it drew); **moves** bring vertices to neighbours' clusters within
{100 * BUDGET:.0f} % of the squared error ("rec"), **superclusters** are drawn together as far as {REGISTERS} registers hold
them ("sc"). Left is (overdraw - 1) over that of the original; the error is beside the original's. Their Buddha has bounces."""


@dataclass(frozen=True)
class Drawn:
    """A row of the paper's table: average overdraw of each of `KINDS`."""

    row: Row
    theirs: str
    overdraw: tuple[float, float, float, float]


TABLE = (
    Drawn(ROWS[1], "Buddha", (1.93, 1.72, 1.61, 1.48)),
    Drawn(ROWS[2], "bird", (1.25, 1.23, 1.14, 1.138)),
)


def overdraw_table(
    drawn: Sequence[Drawn], data: Path, *, seed: int, max_iterations: int
) -> Iterator[Result]:
    """Compress every row's whole mesh, and draw it in the four ways."""
    for one in drawn:
        row = one.row
        signal, areas = transfer(row, data, 1)
        weights, faces = areas / areas.sum(), row.mesh(data).faces
        start = time.process_time()
        model = compress_cpca(
            signal,
            row.n_clusters,
            row.n_components,
            method="static",
            seed=seed,
            max_iterations=max_iterations,
            vertex_weights=weights,
        )
        fitted = time.process_time()
        moved = less_overdraw_cpca(model, signal, faces, budget=BUDGET, vertex_weights=weights)
        searched = time.process_time()
        base = Result(
            of=OVERDRAW,
            row=row.name,
            theirs=one.theirs,
            vertices=len(signal),
            matrix=row.matrix,
            clusters=model.n_clusters,
            components=row.n_components,
            method="original",
            error=model.squared_error_ratio,
            nbytes=model.nbytes,
            seconds=fitted - start,
            overdraw=average_overdraw(faces, model.labels),
            their_overdraw=one.overdraw[0],
        )
        yield base
        yield replace(
            base,
            method="rec",
            error=moved.squared_error_ratio,
            nbytes=moved.nbytes,
            seconds=searched - start,
            overdraw=average_overdraw(faces, moved.labels),
            their_overdraw=one.overdraw[1],
        )
        for method, own, theirs in (
            ("sc", model, one.overdraw[2]),
            ("sc+rec", moved, one.overdraw[3]),
        ):
            began = time.process_time()
            grouped = _grouped(own, faces, row.view)
            yield replace(
                base,
                method=method,
                error=own.squared_error_ratio,
                nbytes=own.nbytes,
                seconds=(fitted if own is model else searched)
                - start
                + time.process_time()
                - began,
                overdraw=grouped,
                their_overdraw=theirs,
            )


def _grouped(model: CpcaModel, faces: np.ndarray, view: int) -> float:
    """Return how often a triangle is drawn where clusters are drawn together."""
    ranks = np.zeros((model.n_clusters, 3), np.int32)
    ranks[:, 0], ranks[:, 2] = view, model.ranks
    needs = registers_of_clusters(ranks, with_mean=True)
    return len(make_superclusters(faces, model.labels, needs, REGISTERS).indices) / len(faces)


def quartets(results: Sequence[Result]) -> list[dict[str, Result]]:
    """Give the rows of each mesh by their kind."""
    cells: dict[str, dict[str, Result]] = {}
    for one in results:
        if one.of == OVERDRAW:
            cells.setdefault(one.row, {})[one.method] = one
    return [cell for cell in cells.values() if set(cell) == set(KINDS)]


def left(cell: dict[str, Result], kind: str) -> tuple[float, float]:
    """Return what a kind leaves of (overdraw - 1), ours and theirs."""
    own, base = cell[kind], cell["original"]
    return (
        (own.overdraw - 1.0) / (base.overdraw - 1.0),
        (own.their_overdraw - 1.0) / (base.their_overdraw - 1.0),
    )


def overdraw_statements(results: Sequence[Result]) -> list[Statement]:
    """Judge: each kind leaves no more of the overdraw than theirs, at an error within the budget."""
    cells = quartets(results)
    found = []
    for kind in KINDS[1:]:
        shares = [left(cell, kind) for cell in cells]
        rises = [cell[kind].error / cell["original"].error - 1.0 for cell in cells]
        found.append(
            Statement(
                f"{TITLES[kind]}: (overdraw - 1) falls by at least what the paper shows, at an error "
                "within its budget",
                bool(cells)
                and all(ours <= theirs for ours, theirs in shares)
                and max(rises) <= (BUDGET if "rec" in kind else 0.0),
                "; ".join(
                    f"{cell['original'].row}: {ours:.3f} is left, theirs {theirs:.3f}, the error "
                    f"changes by {100 * rise:+.2f} %"
                    for cell, (ours, theirs), rise in zip(cells, shares, rises, strict=True)
                )
                or "none was measured",
            )
        )
    return found


def overdraw_section(results: Sequence[Result]) -> str:
    """Return the page's section."""
    lines = []
    for cell in quartets(results):
        for kind in KINDS:
            own, (ours, theirs) = cell[kind], left(cell, kind)
            rise = own.error / cell["original"].error - 1.0
            lines.append(
                [
                    own.row, f"{own.vertices:,}", TITLES.get(kind, kind), f"{own.overdraw:.3f}",
                    f"{ours:.3f}", f"{100 * own.error:.3g} %", f"{100 * rise:+.2f} %",
                    f"{own.seconds:.1f}", own.theirs, f"{own.their_overdraw:.3f}", f"{theirs:.3f}",
                ]
            )  # fmt: skip
    heads = [
        "row", "vertices", "drawn", "overdraw", "left", "error", "rise", "seconds",
        "theirs", "overdraw", "left",
    ]  # fmt: skip
    return f"## Overdraw\n\n{ABOUT}\n\n{table(heads, lines)}"
