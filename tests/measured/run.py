"""Measure the bunny and spot anew and write the pages and pictures of the documentation.

``python tests/measured/run.py [--quick] [--to FOLDER] [name ...]`` starts a service with two workers
in a temporary folder (``TMPDIR`` says where: some gigabytes) and gives it the jobs through the
command line.  It writes ``measured/<name>.md`` and ``images/<name>-*.png`` into ``docs``; reports
and pictures as they came stay in ``results-output``.  ``--quick`` tries the command with settings
whose figures mean nothing, and leaves ``docs`` alone.
"""

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
from datetime import datetime
from pathlib import Path
from typing import Any

# `pytest` is told this folder in pyproject.toml, a script is not
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from benchmarks.run import cpu_name
from measured.options import DOWNLOADS, Options
from measured.pages import RankPair, Run, page
from measured.scenes import DATA, MAX_ITERATIONS, N_CLUSTERS, RANK_PAIRS, SCENES, Scene
from prtbake.cli.serve import raise_interrupt
from prtbake.launch import LocalService
from prtbake_storage import __version__

N_WORKERS = 2
PICTURES = {
    "validation": ("reference, asset, difference (white is a quarter of the exposed range)",
                   "validation-front.png"),
    "preview": ("preview", "preview-front.png"),
}  # fmt: skip


def prtbake(home: Path, *arguments: object) -> dict[str, Any]:
    """Run ``prtbake`` on the service of ``home`` and return the JSON that it prints.

    Raises
    ------
    SystemExit
        The command failed: with its code, after what it said.
    """
    line = [sys.executable, "-m", "prtbake.cli.main", "--data-dir", home, *arguments, "-o", "json"]
    done = subprocess.run([*map(str, line)], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        sys.stderr.write(done.stdout)
        raise SystemExit(done.returncode)
    return dict(json.loads(done.stdout))


def downloaded(home: Path, job: dict[str, Any], folder: Path, *names: str) -> dict[str, Any]:
    """Download files of a job and its report, and return the report."""
    # of an earlier run, perhaps
    shutil.rmtree(folder, ignore_errors=True)
    prtbake(home, "get", job["id"], "report.json", "report.html", *names, "--to", folder)
    return dict(json.loads((folder / "report.json").read_text()))


def measured(home: Path, scene: Scene, data: Path, *, quick: bool) -> tuple[str, dict[str, Path]]:
    """Run a scene's jobs, and return its page and the pictures that it shows, by their new names."""
    machine = machine_line()
    given = [word.replace(DATA, str(data)) for word in scene.arguments(quick=quick)]
    job = prtbake(home, "submit", "asset", *given, "--label", scene.title, "--wait")
    folder = DOWNLOADS / scene.name
    files = [file for _, file in PICTURES.values()]
    report = downloaded(home, job, folder, *files)
    run = Run(
        title=scene.title,
        about=scene.about + (" Tried with `--quick`: no result." if quick else ""),
        command=scene.command(quick=quick),
        machine=machine,
        seconds=wall_seconds(job),
        report=report,
        images={
            caption: f"../images/{scene.name}-{kind}.png"
            for kind, (caption, _) in PICTURES.items()
        },
    )  # fmt: skip
    pairs = rank_pairs(home, scene, job["id"]) if scene.rank_pairs and not quick else []
    pictures = {
        f"{scene.name}-{kind}.png": folder / file for kind, (_, file) in PICTURES.items()
    }  # fmt: skip
    return page(run, pairs), pictures


def rank_pairs(home: Path, scene: Scene, job_id: str) -> list[RankPair]:
    """Compress a job's transfer with each of the paper's rank pairs, one after the other."""
    pairs = []
    for ranks, theirs in RANK_PAIRS.items():
        comma_separated = ",".join(map(str, ranks))
        job = prtbake(
            home, "submit", "compress", "--transfer", f"{job_id}/transfer.h5",
            "--set", f"ranks={comma_separated}", "--set", f"n_clusters={N_CLUSTERS}",
            "--set", f"max_iterations={MAX_ITERATIONS}", "--wait",
        )  # fmt: skip
        folder = DOWNLOADS / f"{scene.name}-{comma_separated.replace(',', '-')}"
        pairs.append(RankPair(ranks, downloaded(home, job, folder), theirs))
    return pairs


def wall_seconds(job: dict[str, Any]) -> float:
    """Return the time between a job's start and its end."""
    started, finished = (datetime.fromisoformat(job[name]) for name in ("started", "finished"))
    return (finished - started).total_seconds()


def machine_line() -> str:
    """Say what kind of machine this is and what else it does, and nothing of its paths."""
    return (
        f"Measured with prtbake {__version__}, {N_WORKERS} workers, Python "
        f"{platform.python_version()} and numpy {np.__version__} on {platform.system()} "
        f"{platform.machine()}, {cpu_name()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} "
        "before the start."
    )


def main(arguments: list[str]) -> int:
    """Measure the scenes named, or all, write what came of them, and return the exit code."""
    known = [scene.name for scene in SCENES]
    options = Options.read(arguments, "Measure what docs/measured says, anew.", known)
    # from here on SIGTERM unwinds like Ctrl-C, so that the service is stopped
    signal.signal(signal.SIGTERM, raise_interrupt)
    with tempfile.TemporaryDirectory(prefix="prtbake-results-") as temporary:
        home = Path(temporary)
        with LocalService(home, n_workers=N_WORKERS, embedded=True):
            for scene in SCENES:
                if scene.name in options.names:
                    text, pictures = measured(home, scene, options.data, quick=options.quick)
                    write(options.to, scene.name, text, pictures)
    return 0


def write(to: Path, name: str, text: str, pictures: dict[str, Path]) -> None:
    """Put a page and its pictures where the documentation looks for them."""
    for folder in ("measured", "images"):
        (to / folder).mkdir(parents=True, exist_ok=True)
    (to / "measured" / f"{name}.md").write_text(text)
    for picture, source in pictures.items():
        shutil.copyfile(source, to / "images" / picture)
    sys.stdout.write(f"{to / 'measured' / f'{name}.md'}\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
