"""Hold the cost model against jobs: what `:estimate` predicts beside what they took.

``python tests/measured/cost_model.py`` starts a service with two workers, calibrates it, and runs
60 random small jobs one after the other, each estimated before.  Every job's rows are appended to
``cost-model.csv`` as it ends, and jobs that are there already are passed over: what was interrupted
goes on, and ``--first N --count M`` does it in pieces; ``--anew`` begins the table again.  With
``--data FOLDER`` the service's data outlives a piece: only the first one calibrates, and
``--count 0`` does nothing else.  At the end ``cost-model.md`` is written over all rows of the
table; it fails where what must hold does not.

``--shipped`` leaves the rates as they are shipped, ``--training`` draws other jobs, which the model
may be mended by.
"""

import argparse
import os
import platform
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

# `pytest` is told this folder in pyproject.toml, a script is not
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from benchmarks.run import cpu_name
from measured.cost_jobs import FIRST_SEED, TRAINING_SEED, Draw
from measured.cost_table import (
    BYTES,
    MEMORY,
    SECONDS,
    STAGES,
    Row,
    page,
    statements,
)
from measured.rows import append_rows, read_rows
from prtbake.cli.serve import raise_interrupt
from prtbake.client import Client
from prtbake.launch import LocalService
from prtbake_storage import __version__
from prtbake_storage.contract.jobs import Estimate, Job, JobState
from prtbake_storage.contract.resources import EnvironmentRegistration, MeshRegistration

DOCS = Path(__file__).resolve().parents[2] / "docs" / "measured"
N_WORKERS = 2
FIRST = 122
"""Jobs before were looked at while the model was made and mended."""

ABOUT = """\
What `POST /v1/jobs:estimate` says of a job before it runs, beside what it took: random small jobs of
procedural scenes, qualities, BRDFs, effects and settings (`tests/measured/cost_jobs.py`), none of them
among those that rates are made from. *seconds* is how long the job lasted from its start to its end,
*stage seconds* the work of each stage, *bytes* each file, *peak memory* that of the largest process. A
job counts as predicted where all of its files are. Each job also teaches the factors of its stages, for
the jobs after it."""


def measure(client: Client, draw: Draw) -> list[Row]:
    """Estimate a job, run it, and return its rows."""
    mesh = client.register(MeshRegistration.model_validate({"builtin": draw.mesh}))
    sky = client.register(EnvironmentRegistration.model_validate({"builtin": draw.environment}))
    request = draw.request | {"mesh": mesh.id, "environment": sky.id}
    estimate = client.estimate(request)
    job = client.wait(client.submit(request).id)
    scene = (
        f"{draw.mesh['name']} {draw.mesh['tessellation']}, {draw.request['brdf']['model']}, "
        f"{draw.request['quality']}"
    )
    return [
        Row(draw.number, scene, what, of, predicted, measured)
        for what, of, predicted, measured in pairs(estimate, job)
    ]


def pairs(estimate: Estimate, job: Job) -> list[tuple[str, str, float, float]]:
    """Pair what was predicted with what came, where both are there."""
    assert job.result is not None
    assert job.started is not None
    assert job.finished is not None
    found = [
        (SECONDS, "job", estimate.total_seconds or 0.0,
         (job.finished - job.started).total_seconds()),
        (MEMORY, "job", float(estimate.peak_memory_bytes or 0),
         float(job.result["peak_memory_bytes"])),
    ]  # fmt: skip
    seconds = job.result["seconds"]
    found += [
        (STAGES, stage, predicted, float(seconds[stage]))
        for stage, predicted in estimate.seconds.items()
        if seconds.get(stage)
    ]
    sizes = {artefact.name: artefact.size for artefact in job.artefacts}
    found += [
        (BYTES, name, float(predicted), float(sizes[name]))
        for name, predicted in estimate.artefact_bytes.items()
    ]
    return found


def machine_line() -> str:
    """Say what kind of machine this is and what else it does, and nothing of its paths."""
    return (
        f"Measured with prtbake {__version__}, {N_WORKERS} workers, Python "
        f"{platform.python_version()} and numpy {np.__version__} on {platform.system()} "
        f"{platform.machine()}, {cpu_name()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} "
        "before the start."
    )


@contextmanager
def home_of(kept: Path | None) -> Iterator[Path]:
    """Give the folder that was asked for, or one that is removed in the end."""
    if kept is not None:
        yield kept
        return
    with tempfile.TemporaryDirectory(prefix="prtbake-cost-") as temporary:
        yield Path(temporary)


def calibrate(client: Client) -> None:
    """Measure the machine, unless that is done."""
    done = client.page(state=[JobState.succeeded.value], kind="calibrate").items
    if not done:
        client.wait(client.submit({"kind": "calibrate"}).id)
        sys.stdout.write("calibrated\n")
        sys.stdout.flush()


def main(arguments: Sequence[str]) -> int:
    """Measure, write, and return the exit code."""
    parser = argparse.ArgumentParser(description="Hold the cost model against random jobs.")
    parser.add_argument("--first", type=int, default=FIRST, help=f"number of the first; {FIRST}")
    parser.add_argument("--count", type=int, default=60, help="how many; 60")
    parser.add_argument("--to", type=Path, default=DOCS, help="docs/measured")
    parser.add_argument("--data", type=Path, help="keep the service's data here for the next piece")
    parser.add_argument("--anew", action="store_true", help="forget the table that is there")
    parser.add_argument("--shipped", action="store_true", help="do not calibrate")
    parser.add_argument("--training", action="store_true", help="not the jobs that are held out")
    given = parser.parse_args(arguments)
    # from here on SIGTERM unwinds like Ctrl-C, so that the service is stopped
    signal.signal(signal.SIGTERM, raise_interrupt)
    machine = machine_line()
    given.to.mkdir(parents=True, exist_ok=True)
    table = given.to / "cost-model.csv"
    if given.anew:
        table.unlink(missing_ok=True)
    done = {row.job for row in read_rows(table, Row)}
    left = [one for one in range(given.first, given.first + given.count) if one not in done]
    with (
        home_of(given.data) as home,
        LocalService(home, n_workers=N_WORKERS, embedded=True),
        Client(data_dir=home) as client,
    ):
        if not given.shipped:
            calibrate(client)
        for number in left:
            seed = TRAINING_SEED if given.training else FIRST_SEED
            own = measure(client, Draw.of(number, first_seed=seed))
            append_rows(table, own, Row)
            told = ", ".join(f"{row.of} {row.factor:.2f}" for row in own if row.what != STAGES)
            sys.stdout.write(f"{number} {own[0].scene}: {told}\n")
            sys.stdout.flush()
    rows = read_rows(table, Row)
    if not rows:
        return 0
    (given.to / "cost-model.md").write_text(page(rows, about=ABOUT, machine=machine))
    for text, holds in statements(rows):
        sys.stdout.write(f"{'holds' if holds else 'FAILS'}: {text}\n")
    return 0 if all(holds for _, holds in statements(rows)) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
