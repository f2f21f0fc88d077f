"""Figure 7 of [Sloan2003], measured: 16 x 25 least squares against 25 x 25 zero-hemisphere.

``PYTHONPATH=tests python -m figures.figure7`` prints one table a BRDF and writes them, with a
picture, to a folder.  The scene is the teapot on a plane; where ``PRTBAKE_DATA`` names the
real-data folder, the bunny on one as well.
"""

import argparse
import os
import sys
from pathlib import Path

import numpy as np

from figures.comparison import COARSER, FITTED, LIGHT_ORDER, Sizes, compare
from figures.exit_radiance import vertex_points
from figures.picture import picture_strip
from figures.projections import COMPARED, ZERO_25
from prtbake_storage.contract.brdf import CookTorranceSpec, GgxSpec, PhongSpec
from prtbake_workers.basis.sh import sh_light
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.environment.hall import hall
from prtbake_workers.environment.sky import sun_sky
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.receiver import receiver_plane
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.teapot import teapot
from support.quadrature import sphere_quadrature

SEED = 0
BRDFS = {
    "Phong, exponent 4": PhongSpec(kd=0.0, ks=1.0, exponent=4),
    "Phong, exponent 16": PhongSpec(kd=0.0, ks=1.0, exponent=16),
    "Phong, exponent 64": PhongSpec(kd=0.0, ks=1.0, exponent=64),
    "GGX, alpha 0.3": GgxSpec(kd=0.3, ks=0.7, alpha=0.3, f0=0.1),
    "Cook-Torrance, m 0.5": CookTorranceSpec(kd=0.3, ks=0.7, m=0.5, f0=0.1),
    "Cook-Torrance, m 0.3": CookTorranceSpec(kd=0.3, ks=0.7, m=0.3, f0=0.1),
    "Cook-Torrance, m 0.3, no diffuse part": CookTorranceSpec(kd=0.0, ks=1.0, m=0.3, f0=0.05),
}
PICTURED = "GGX, alpha 0.3"
LAMPS = (
    ((0.8, 0.2, -0.6), (2.0, 0.3, 0.2)),
    ((-0.8, 0.2, -0.6), (0.2, 0.4, 2.0)),
    ((0.2, 0.9, 0.4), (0.3, 0.3, 0.3)),
)
"""Towards each lamp, and its colour: red and blue from behind, as in the figure, and a dim white."""

HEADER = (
    "stored", "bytes", "all lights", "solid angle", "silhouettes", "sky", "hall", "lamps", "better",
)  # fmt: skip


def lights():
    """Give lights of 25 coefficients, (25, 3): two environments cut off there, and three lamps."""
    result = {}
    for name, environment in (("sky", sun_sky(128, 40.0, 30.0)), ("hall", hall(128))):
        radiance = environment.radiance.reshape(-1, 3).astype(np.float64)
        result[name] = sh_light(
            LIGHT_ORDER, environment.directions(), environment.solid_angles(), radiance
        )
    directions, weights = sphere_quadrature(LIGHT_ORDER)
    radiance = np.zeros((len(directions), 3))
    for towards, colour in LAMPS:
        axis = np.array(towards) / np.linalg.norm(towards)
        # a polynomial of degree 4: nothing is cut off, and it is nowhere negative
        radiance += (0.5 + 0.5 * directions @ axis)[:, None] ** (LIGHT_ORDER - 1) * colour
    result["lamps"] = sh_light(LIGHT_ORDER, directions, weights, radiance)
    return result


def scenes(tessellation):
    """Give each object on a plane, by name, with the number of its own vertices."""
    meshes = {"teapot": teapot(tessellation)}
    if folder := os.environ.get("PRTBAKE_DATA"):
        data = (Path(folder) / "meshes" / "stanford-bunny.obj").read_bytes()
        meshes["bunny"] = load_mesh(data, "obj")[0]
    for name, mesh in meshes.items():
        plane = receiver_plane(mesh.bounds, resolution=16, extent=3.0, gap=0.0)
        yield name, Scene.from_parts([mesh, plane]), mesh.n_vertices


def table(tallies, areas, lit):
    """Lay the errors of one BRDF out: relative RMS over views and area, in per cent.

    The columns of the lights, (25, 3) each, weight views by their cosine, as does "all lights".
    """
    reference = tallies["reference"]
    zero = tallies[ZERO_25.name]
    stored = {p.name: str(p.n_bytes(LIGHT_ORDER**2)) for p in COMPARED}
    rows = [HEADER]
    for name in (*stored, FITTED, COARSER):
        tally = tallies[name]
        errors = [
            tally.relative(reference, measure)
            for measure in ("cosine", "solid angle", "silhouette")
        ]
        errors += [tally.relative(reference, "cosine", light) for light in lit.values()]
        judged = name in stored and tally is not zero
        share = f"{tally.better_share(zero, reference, areas):.0%}" if judged else ""
        rows.append((name, stored.get(name, ""), *(f"{100 * e:.1f}" for e in errors), share))
    return rows


def markdown(rows):
    """Write rows as a table of Markdown, its columns aligned."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines) + "\n"


def main(arguments, sizes=None):
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description="Compare hemispherical projections.")
    parser.add_argument("--to", type=Path, default=Path("figure7-output"), help="folder")
    parser.add_argument("--vertices", type=int, default=256, help="drawn from each object")
    parser.add_argument("--tessellation", type=int, default=16, help="of the teapot")
    parser.add_argument("--width", type=int, default=240, help="of each picture, in pixels")
    options = parser.parse_args(arguments)
    options.to.mkdir(parents=True, exist_ok=True)
    sizes = sizes or Sizes()
    brdfs = {name: brdf_from_spec(spec) for name, spec in BRDFS.items()}
    lit = lights()
    with (options.to / "figure7.md").open("w") as file:
        for name, scene, n_own in scenes(options.tessellation):
            accelerator = Accelerator(scene.positions, scene.faces)
            draw = np.random.default_rng(SEED).permutation(n_own)[: options.vertices]
            points = vertex_points(scene, np.sort(draw))
            for brdf, tallies in compare(points, accelerator, brdfs, sizes).items():
                share = tallies["reference"].silhouette_share()
                text = (
                    f"## {name}, {brdf}\n\n"
                    f"{share:.1%} of the squared radiance is at silhouettes.\n\n"
                    f"{markdown(table(tallies, points.areas, lit))}\n"
                )
                file.write(text)
                sys.stdout.write(text)
                sys.stdout.flush()
            if name == "teapot":
                strip = picture_strip(
                    scene, accelerator, brdfs[PICTURED], lit["lamps"], sizes, options.width
                )
                (options.to / "figure7.png").write_bytes(strip)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
