"""Hold baked results against Mitsuba 3 and write what explains them into the documentation.

``python tests/measured/against_mitsuba.py [--quick] [--to FOLDER] [name ...]`` bakes the scenes of the
reference test in memory, at one setting after another, and writes ``measured/mitsuba-<name>.md``
into ``docs``.  Vertices that send the pictures no light are not baked.  ``--quick`` tries the command with settings whose figures mean nothing, and leaves
``docs`` alone.
"""

import os
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

# `pytest` is told this folder in pyproject.toml, a script is not
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import mitsuba as mi
import numpy as np

from benchmarks.run import cpu_name
from measured.mitsuba_pages import Measured, page
from measured.options import Options
from prtbake_storage import __version__
from prtbake_storage.contract.settings import AssetSettings, Quality, ValidateSettings
from prtbake_workers.planning.presets import resolve_stages
from support.agreement import Agreement, Explained
from support.baked_on_demand import BakedOnDemand
from support.baked_scene import pixel_chain, validation_of_baked
from support.finer_mesh import finer, shown
from support.mitsuba_render import by_mitsuba, by_paths
from support.mitsuba_scenes import bunny_on_a_plane, overcast_sky, shaderball, suzanne_in_a_box

N_PARTS = 8
"""Passes of our reference and independent pictures of Mitsuba's: they are differenced in pairs."""


@dataclass(frozen=True)
class Rung:
    """A quality's settings of the bake, some of them changed, on triangles cut so many times."""

    label: str
    quality: Quality = "medium"
    changes: dict[str, Any] = field(default_factory=dict)
    rounds: int = 0


@dataclass(frozen=True)
class MitsubaScene:
    """A scene of the reference test; ``fine_parts`` are those whose triangles rungs cut.

    Of these, with ``cut_shown``, the ones that any of ``per_side`` x ``per_side`` points of a pixel
    shows.  ``tracer_side`` is that of the cells which the path tracer's paths share.  ``n_points`` of ``per_side`` x ``per_side`` points of a pixel are shaded, each with ``samples`` of
    light and ``paths`` a pass: a scene whose outline stands before nothing needs to know it well.
    """

    name: str
    title: str
    make: Any
    n_bounces: int
    n_paths: int
    per_side: int
    n_points: int
    samples: int
    paths: int
    tracer_side: int
    fine_parts: tuple[int, ...]
    rungs: tuple[Rung, ...]
    cut_shown: bool = False


SCENES = (
    MitsubaScene(
        "suzanne", "Suzanne in an open box with coloured walls, diffuse", suzanne_in_a_box,
        n_bounces=3, n_paths=8192, per_side=6, n_points=36, samples=256, paths=16,
        tracer_side=4, fine_parts=(0, 1, 2, 3, 4),
        rungs=(
            Rung("draft", "draft"),
            Rung("medium"),
            Rung("medium, triangles in 4", rounds=1),
            Rung("medium, in 16", rounds=2),
            Rung("in 16, 162 centres", changes={"n_centres": 162}, rounds=2),
            Rung("in 16, 2,562 centres", changes={"n_centres": 2562}, rounds=2),
            Rung("in 16, 16 x 16 a face", changes={"cube_resolution": 16}, rounds=2),
            Rung("in 16, 64 x 64 a face", changes={"cube_resolution": 64}, rounds=2),
            Rung("in 16, 256 bounce rays", changes={"bounce_rays": 256}, rounds=2),
        ),
    ),
    MitsubaScene(
        "bunny", "Bunny of diffuse and rough metal on a diffuse plane", bunny_on_a_plane,
        n_bounces=2, n_paths=4608, per_side=16, n_points=64, samples=64, paths=4,
        tracer_side=8, fine_parts=(1,), cut_shown=True,
        rungs=(
            Rung("draft", "draft"),
            Rung("draft, 29 terms, plane in 16", "draft", {"term_energy_lost": 0.004}, rounds=2),
        ),
    ),
    MitsubaScene(
        "shaderball", "Shaderball of diffuse and rough metal", shaderball,
        n_bounces=2, n_paths=4608, per_side=16, n_points=64, samples=192, paths=4,
        tracer_side=8, fine_parts=(0,), cut_shown=True,
        rungs=(
            Rung("low", "low"),
            Rung("low, 35 terms, triangles in 16", "low", {"term_energy_lost": 0.004}, rounds=2),
        ),
    ),
)  # fmt: skip

QUICK = Rung("draft", "draft", changes={"n_centres": 42, "cube_resolution": 8, "n_terms": 3})
N_LOBES = 162


def measured(scene: MitsubaScene, data: Path) -> tuple[Agreement, list[Measured]]:
    """Compare the path tracer, and a bake at every rung, with one picture of Mitsuba's."""
    meshes, brdfs, view = scene.make(data)
    light = overcast_sky(data)
    theirs, corners = by_mitsuba(
        meshes, brdfs, light, view, scene.n_bounces, n_paths=scene.n_paths, n_parts=N_PARTS
    )
    ours, _ = by_paths(
        meshes, brdfs, light, view, scene.n_bounces, corners,
        n_paths=scene.n_paths, per_side=scene.tracer_side,
    )  # fmt: skip
    tracer = Agreement.between(ours, theirs)
    sys.stderr.write(f"{scene.name}: path tracer: {tracer}\n")
    sampling = ValidateSettings(
        passes=N_PARTS, samples=scene.samples, bounces=scene.n_bounces, bounce_samples=scene.paths
    )
    where = shown(meshes, view, scene.per_side) if scene.cut_shown else [None] * len(meshes)
    found = []
    for rung in scene.rungs:
        bake = resolve_stages(rung.quality, AssetSettings(bake=rung.changes)).bake
        # as many bounces as Mitsuba has, whatever they add
        bake = bake.model_copy(update={"max_bounces": scene.n_bounces, "bounce_tolerance": 0.0})
        cut = [
            finer(mesh, rung.rounds if index in scene.fine_parts else 0, where[index])
            for index, mesh in enumerate(meshes)
        ]
        own = BakedOnDemand(cut, brdfs, bake)
        chain = pixel_chain(
            validation_of_baked(own, light, N_LOBES), view, scene.per_side, sampling,
            n_points=scene.n_points,
        )  # fmt: skip
        explained = Explained.of(theirs, chain[:-1])
        fitted = Explained.of(theirs, chain)
        found.append(
            Measured(
                label=rung.label,
                n_centres=bake.n_centres,
                n_directions=6 * bake.cube_resolution**2,
                bounce_rays=bake.bounce_rays,
                vertices=own.scene.n_vertices,
                baked=own.n_baked,
                terms=own.factorisations[0].n_terms,
                seconds=own.seconds,
                explained=explained,
                fitted=fitted,
            )
        )
        sys.stderr.write(f"{scene.name}: {rung.label}: {own.seconds:.0f} s: {fitted}\n")
    return tracer, found


def about(scene: MitsubaScene, data: Path) -> str:
    """Say what was compared, and where."""
    view = scene.make(data)[2]
    return (
        f"Both hold {scene.n_bounces} bounces under uffizi.hdr at 16 x 32 texels. Mitsuba "
        f"{mi.__version__}: {view.width} x {view.height} pixels, {scene.n_paths:,} paths each, as many as "
        "the path tracer. The chain of the budget: "
        f"{scene.n_points} of {scene.per_side} x {scene.per_side} points a pixel; the reference takes {N_PARTS} x "
        f"{scene.samples} light samples and {N_PARTS} x {scene.paths} paths from each. Measured "
        f"with prtbake {__version__}, numpy {np.__version__}, on one core of {cpu_name()}, load "
        f"{os.getloadavg()[0]:.1f} before the start."
    )


def main(arguments: list[str]) -> int:
    """Measure the scenes named, or all, and write their pages."""
    known = [scene.name for scene in SCENES]
    options = Options.read(arguments, "Hold baked results against Mitsuba 3, anew.", known)
    data = options.data
    (options.to / "measured").mkdir(parents=True, exist_ok=True)
    for scene in SCENES:
        if scene.name not in options.names:
            continue
        own = scene
        if options.quick:
            own = replace(
                scene,
                n_paths=512,
                per_side=2,
                n_points=4,
                samples=8,
                paths=1,
                tracer_side=2,
                rungs=(QUICK,),
            )
        said = about(own, data) + (" Tried with `--quick`: no result." if options.quick else "")
        path = options.to / "measured" / f"mitsuba-{scene.name}.md"
        path.write_text(page(scene.title, said, *measured(own, data)))
        sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
