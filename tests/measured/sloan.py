"""Redo tables and figures of [Sloan2003]: static, iterative and adaptive clustered PCA, overdraw.

``python tests/measured/sloan.py [--full] [--to FOLDER]`` writes ``sloan.csv`` and ``sloan.md``; it
fails where iterative is not below static, or adaptive above iterative, at equal storage, or where
overdraw does not fall by what the paper shows.
"""

import argparse
import os
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

# `pytest` is told this folder in pyproject.toml, a script is not
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from numpy.typing import NDArray

from benchmarks.run import cpu_name
from measured.rows import write_rows
from measured.sloan_overdraw import (
    TABLE,
    Drawn,
    overdraw_section,
    overdraw_statements,
    overdraw_table,
)
from measured.sloan_scenes import FIGURE, ROWS, Row, transfer
from measured.sloan_table import (
    FIGURE_2,
    FIGURE_3,
    TABLE_1,
    Result,
    page,
    statements,
)
from prtbake_storage import __version__
from prtbake_workers.compress.cpca import METHODS, CpcaModel, compress_cpca

DOCS = Path(__file__).resolve().parents[2] / "docs" / "measured"
SEED = 0
MAX_ITERATIONS = 20
"""As the paper has for VQ, and at most for each number of components."""
FIGURE_2_CLUSTERS = (1, 4, 16, 64, 256)
FIGURE_2_COMPONENTS = (1, 2, 4, 8, 16)
FIGURE_3_COMPONENTS = (1, 2, 3, 4, 6)

ABOUT = """\
Table 1, figures 2 to 4 and the overdraw of Sloan, Hall, Hart and Snyder (2003), redone on meshes at hand: the bunny for their
bird, the horse for their head, and no scattering Buddha. Transfer is shadowed, its glossy matrices are in
hemispherical harmonics of the view (the best sum of products for the brushed metal), its light in spherical
harmonics. Errors are squared, by area, over the squared norm of the transfer; theirs are absolute sums, so the
ratio of the two methods stands beside theirs. {thinned}

Bytes are those of the float32 means, components and weights; all three methods have as many, up to what no
component fits into any more. Seconds are CPU seconds and include the clustering that each begins with, of
adaptive all of iterative."""
THINNED = """Of the glossy signals every eighth vertex is compressed, of the diffuse
ones every second, in as many times fewer clusters, so that clusters are as large as theirs; `--full` takes all."""


def measured(
    signal: NDArray[np.float32],
    areas: NDArray[np.float64],
    row: Row,
    of: str,
    n_clusters: int,
    n_components: int,
    method: str,
) -> tuple[Result, CpcaModel]:
    """Compress once, and say what came of it."""
    start = time.process_time()
    model = compress_cpca(
        signal,
        n_clusters,
        n_components,
        method=method,
        seed=SEED,
        max_iterations=MAX_ITERATIONS,
        vertex_weights=areas / areas.sum(),
    )
    seconds = time.process_time() - start
    spread = model.squared_error_per_vertex / model.initial_energy
    result = Result(
        of=of,
        row=row.name,
        theirs=row.theirs,
        vertices=len(signal),
        matrix=row.matrix,
        clusters=n_clusters,
        components=n_components,
        method=method,
        error=model.squared_error_ratio,
        median=float(np.median(spread)),
        p99=float(np.quantile(spread, 0.99)),
        worst=float(spread.max()),
        nbytes=model.nbytes,
        seconds=seconds,
        their_ratio=row.their_iterative / row.their_static if row.their_static else 0.0,
    )
    return result, model


def table_1(rows: Sequence[Row], data: Path, *, full: bool) -> Iterator[Result]:
    """Compress every row by the three methods."""
    for row in rows:
        thin = 1 if full else row.thin
        signal, areas = transfer(row, data, thin)
        n_clusters = row.n_clusters // thin
        for method in METHODS:
            yield measured(
                signal, areas, row, TABLE_1, n_clusters, row.n_components, method
            )[0]  # fmt: skip


def figures(
    row: Row,
    data: Path,
    clusters: Sequence[int] = FIGURE_2_CLUSTERS,
    components: Sequence[int] = FIGURE_2_COMPONENTS,
    by_method: Sequence[int] = FIGURE_3_COMPONENTS,
) -> Iterator[Result]:
    """Compress the figures' signal by clusters and components, and by method."""
    signal, areas = transfer(row, data, row.thin)
    for n_clusters in clusters:
        for n_components in components:
            result, model = measured(
                signal, areas, row, FIGURE_2, n_clusters, n_components, "static"
            )
            if n_components == components[0]:
                # the last entry but one is of the means alone
                yield Result(
                    of=FIGURE_2, row=row.name, vertices=len(signal), matrix=row.matrix,
                    clusters=n_clusters, components=0, method="vq",
                    error=model.objective[-2] / model.initial_energy,
                    nbytes=model.means.nbytes, seconds=0.0,
                )  # fmt: skip
            yield result
    for n_components in by_method:
        for method in METHODS:
            yield measured(
                signal, areas, row, FIGURE_3, row.n_clusters // row.thin, n_components, method
            )[0]  # fmt: skip


def measure(
    rows: Sequence[Row],
    figure: Row,
    drawn: Sequence[Drawn],
    folder: Path,
    data: Path,
    *,
    full: bool,
    **options: object,
) -> bool:
    """Measure everything, write it, and return whether all that the page says holds."""
    folder.mkdir(parents=True, exist_ok=True)
    results = []
    for result in chain(
        overdraw_table(drawn, data, seed=SEED, max_iterations=MAX_ITERATIONS),
        table_1(rows, data, full=full),
        figures(figure, data, **options),
    ):
        results.append(result)
        sys.stdout.write(f"{result.of}, {result.row}, {result.method}: {result.error:.3%}\n")
        sys.stdout.flush()
    write_rows(folder / "sloan.csv", results, Result, digits=5)
    about = ABOUT.format(thinned="" if full else THINNED)
    found = [*statements(results), *overdraw_statements(results)]
    text = page(
        results,
        machine=machine_line(),
        about=about,
        proved=found,
        overdraw=overdraw_section(results),
    )
    (folder / "sloan.md").write_text(text)
    for one in found:
        sys.stdout.write(f"{'holds' if one.holds else 'FAILS'}: {one.text}: {one.evidence}\n")
    return all(one.holds for one in found)


def machine_line() -> str:
    """Say what kind of machine this is, and nothing of its paths."""
    return (
        f"Measured with prtbake {__version__}, Python {platform.python_version()} and numpy "
        f"{np.__version__} on {platform.system()} {platform.machine()}, {cpu_name()}."
    )


def main(arguments: list[str]) -> int:
    """Measure all; 1 where a statement does not hold."""
    parser = argparse.ArgumentParser(description="Measure docs/measured/sloan.md anew.")
    parser.add_argument("--full", action="store_true", help="all vertices and clusters")
    parser.add_argument("--to", type=Path, default=DOCS, help="folder of sloan.csv and .md")
    options = parser.parse_args(arguments)
    data = Path(os.environ.get("PRTBAKE_DATA", "")).resolve()
    if not (data / "meshes").is_dir():
        parser.error("PRTBAKE_DATA must name the folder of the real data")
    return 0 if measure(ROWS, FIGURE, TABLE, options.to, data, full=options.full) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
