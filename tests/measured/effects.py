"""Hold planning against what effects cost and bring: 14 scenes, every effect both ways.

``python tests/measured/effects.py [--scenes a,b] [--to FOLDER]`` bakes the scenes and writes
``effects.csv``, which keeps the rows of scenes that are not named, and ``effects.md`` beside it.
It fails where a statement of the page does not hold.
"""

import platform
import sys
from collections.abc import Sequence
from pathlib import Path

# `pytest` is told this folder in pyproject.toml, a script is not
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from benchmarks.run import cpu_name
from measured.effect_runs import measure
from measured.effect_scenes import ABOUT_SETTINGS, SCENES, SETTINGS, WARM_UP, EffectScene
from measured.effects_table import Row, merged, page, statements
from measured.options import Page
from measured.rows import read_rows, write_rows
from prtbake_storage import __version__
from prtbake_storage.contract.settings import BakeSettings

ABOUT = """\
Is every effect simulated that a scene needs, and none that it does not? Each scene is baked as planning
decides, with every effect forced on, with every effect forced off, and for each effect once with only that
one forced the other way.

How to read the tables:

- **seconds** are CPU seconds of all tasks of a bake in one process, without starting workers' children:
  `plan`, `bake`, `scattering`, `bounces`, `add_bounces`, `join`. Only ratios within a scene mean anything.
- **error decided**, **on** and **off** are squared-error ratios in radiance norm, weighted by area, of the
  part that errs most, against the bake with everything forced on. Terms of a BRDF are orthonormal and their
  coefficients whitened, so that the norm is a sum of squares; where only one of two bakes has a channel for
  each colour, the other's one channel stands for all three, and channels are averaged.
- **measured** is what an effect changes by itself: the bake without it against the bake with it, all else as
  decided. **predicted** is what planning said of that before the first ray of the bake; **tolerance** is
  what it was held against: `bounce_tolerance`, for the view `term_energy_lost`, for light that scatters
  inside `subsurface_tolerance`.
- **verdict**: *needed* is taken and costs more than the tolerance when left; *rightly left* is left and
  costs less; *taken, little* is taken and would cost less. Shadows are of that kind by intention: a
  sparse probe may miss a dark corner, so they are left out only where a proof says that they are small.
  *Nothing to take*: no switch would change what is baked, such as a view dependence of a diffuse surface.

An effect forced on is simulated in full, with all of `bounce_rays` in every bounce; left to itself planning
takes as many rays as keep their noise below half of the tolerance, which is most of what *error decided*
shows where bounces are taken. Direct light is cheap here: few directions and few functions of the basis. Where both
are many, as at the full quality, it is a larger part of a bake, and what planning saves a smaller one."""


def measure_scenes(
    names: Sequence[str],
    folder: Path,
    data: Path,
    *,
    scenes: Sequence[EffectScene] = SCENES,
    settings: BakeSettings = SETTINGS,
    warm_up: EffectScene = WARM_UP,
) -> bool:
    """Measure scenes, write the table after each, and return whether all that it says holds."""
    folder.mkdir(parents=True, exist_ok=True)
    titles = {scene.name: scene.title for scene in scenes}
    store = folder / "effects.csv"
    # what is imported and compiled in the first bake is of no scene
    measure(warm_up, data, settings)
    for scene in scenes:
        if scene.name in names:
            rows = merged(read_rows(store, Row), measure(scene, data, settings), list(titles))
            write_rows(store, rows, Row, digits=4)
            sys.stdout.write(f"{scene.title}: {rows_line(rows, scene.name)}\n")
            sys.stdout.flush()
    # as the file keeps them, so that the page does not depend on which scenes were named
    rows = read_rows(store, Row)
    text = page(rows, titles, settings=ABOUT_SETTINGS, machine=machine_line(), about=ABOUT)
    (folder / "effects.md").write_text(text)
    found = statements(rows, list(titles))
    for one in found:
        sys.stdout.write(f"{'holds' if one.holds else 'FAILS'}: {one.text}: {one.evidence}\n")
    return all(one.holds for one in found)


def rows_line(rows: Sequence[Row], scene: str) -> str:
    """Say a scene's verdicts in a line."""
    own = [row for row in rows if row.scene == scene and row.is_effect]
    return ", ".join(f"{row.effect} {row.verdict}" for row in own)


def machine_line() -> str:
    """Say what kind of machine this is, and nothing of its paths."""
    return (
        f"Measured with prtbake {__version__}, Python {platform.python_version()} and numpy "
        f"{np.__version__} on {platform.system()} {platform.machine()}, {cpu_name()}."
    )


def main(arguments: list[str]) -> int:
    """Measure the scenes named, or all; 1 where a statement does not hold."""
    options = Page.read(arguments, "effects", [scene.name for scene in SCENES])
    return 0 if measure_scenes(options.names, options.to, options.data) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
