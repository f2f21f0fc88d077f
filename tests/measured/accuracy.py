"""Measure what accuracy costs: frontiers of four scenes, the ladder, and figure 4 of [Tsai2006].

``python tests/measured/accuracy.py [--quick] [--to FOLDER] [name ...]`` starts a service with two
workers in a temporary folder (``TMPDIR`` says where: some gigabytes) and gives it a study a scene
through the client; ``figure4`` is measured in this process.  What is measured is kept in
``measured/accuracy/<name>.json``, with a page to point at beside it and a picture in ``images``;
``measured/accuracy.md`` and ``.csv`` are written from all that is kept, so that names may be
measured one at a time.  It fails where a statement of the page does not hold.  ``--quick`` tries
the command with settings whose figures mean nothing, and leaves ``docs`` alone.
"""

import json
import signal
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

# `pytest` is told this folder in pyproject.toml, a script is not
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from figures import figure4
from measured.accuracy_page import page
from measured.accuracy_scenes import ALL, FIGURE_4, Scene
from measured.accuracy_table import Kept, csv_text, rounded, statements
from measured.options import Options
from measured.run import machine_line
from prtbake.cli.serve import raise_interrupt
from prtbake.client import Client
from prtbake.launch import LocalService
from prtbake_storage.contract.jobs import Job
from prtbake_workers.report.frontier_picture import frontier_png
from prtbake_workers.report.study_page import study_page

N_WORKERS = 2
LEFT_OUT = ("base", "title")
"""Of ``study.json``: what only the service that made it can read, and what the scene says."""


def measured(client: Client, scene: Scene, data: Path, *, quick: bool) -> Kept:
    """Run a scene's study, and give what is kept of it."""
    machine = machine_line()
    job = client.wait(client.submit(scene.registered(client, data, quick=quick)).id)
    with tempfile.TemporaryDirectory(prefix="prtbake-study-") as folder:
        study = json.loads(client.download(job.id, "study.json", Path(folder)).read_text())
    points = [
        {name: value for name, value in point.items() if name != "request"}
        for point in study["points"]
    ]
    kept = {name: value for name, value in study.items() if name not in LEFT_OUT}
    about = scene.about + (" Tried with `--quick`: no result." if quick else "")
    own = {"name": scene.name, "title": scene.title, "about": about}
    own |= {"machine": machine, "wall_seconds": lasted(job)}
    return rounded(own | kept | {"points": points})


def lasted(job: Job) -> float:
    """Give the seconds between a job's start and its end."""
    assert job.started is not None
    assert job.finished is not None
    return (job.finished - job.started).total_seconds()


def lights(*, quick: bool) -> Kept:
    """Measure figure 4, and give what is kept of it."""
    machine = machine_line()
    sizes = figure4.Sizes(12, (12, 42), (6, 10), (24, 72), 1) if quick else figure4.Sizes()
    maps = dict(list(figure4.environments().items())[: 2 if quick else None])
    compared = figure4.methods(sizes)
    found, spent, _ = figure4.measure(maps, compared)
    return rounded(
        {
            "name": FIGURE_4,
            "machine": machine,
            "methods": [
                {"name": method.name, "numbers": method.numbers, "seconds": spent[method.name]}
                for method in compared
            ],
            "lights": {
                name: {method: list(errors) for method, errors in own.items()}
                for name, own in found.items()
            },
        }
    )


def keep(to: Path, kept: Kept) -> None:
    """Write what is kept of a name, its picture, and the page to point at."""
    folder = to / "measured" / "accuracy"
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(kept, indent=1, allow_nan=False)
    (folder / f"{kept['name']}.json").write_text(f"{text}\n")
    if kept["name"] == FIGURE_4:
        return
    (folder / f"{kept['name']}.html").write_text(study_page(kept))
    images = to / "images"
    images.mkdir(parents=True, exist_ok=True)
    picture = frontier_png(kept["points"], kept["frontier"])
    (images / f"accuracy-{kept['name']}.png").write_bytes(picture)


def all_kept(to: Path) -> dict[str, Kept]:
    """Read what is kept, in the order of the page."""
    paths = (
        (name, to / "measured" / "accuracy" / f"{name}.json")
        for name in (*(scene.name for scene in ALL), FIGURE_4)
    )
    return {name: json.loads(path.read_text()) for name, path in paths if path.exists()}


def write(to: Path, kept: Mapping[str, Kept]) -> bool:
    """Write page and table of all that is kept, and say whether what must hold does."""
    found = statements(kept)
    (to / "measured" / "accuracy.md").write_text(page(kept, found))
    (to / "measured" / "accuracy.csv").write_text(csv_text(kept))
    for one in found:
        sys.stdout.write(f"{'holds' if one.holds else 'FAILS'}: {one.text}: {one.evidence}\n")
    return all(one.holds for one in found)


def measure(names: Iterable[str], to: Path, data: Path, *, quick: bool) -> bool:
    """Measure what is named, keeping each as it comes, and write the page."""
    chosen = [scene for scene in ALL if scene.name in names]
    if FIGURE_4 in names:
        keep(to, lights(quick=quick))
    if chosen:
        with (
            tempfile.TemporaryDirectory(prefix="prtbake-accuracy-") as temporary,
            LocalService(Path(temporary), n_workers=N_WORKERS, embedded=True),
            Client(data_dir=Path(temporary)) as client,
        ):
            for scene in chosen:
                keep(to, measured(client, scene, data, quick=quick))
                sys.stdout.write(f"{scene.name} is measured\n")
                sys.stdout.flush()
    return write(to, all_kept(to))


def main(arguments: list[str]) -> int:
    """Measure; 1 where a statement does not hold (with ``--quick`` none is asked to)."""
    known = [*(scene.name for scene in ALL), FIGURE_4]
    options = Options.read(arguments, "Measure what accuracy costs, anew.", known)
    # from here on SIGTERM unwinds like Ctrl-C, so that the service is stopped
    signal.signal(signal.SIGTERM, raise_interrupt)
    held = measure(options.names, options.to, options.data, quick=options.quick)
    return 0 if held or options.quick else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
