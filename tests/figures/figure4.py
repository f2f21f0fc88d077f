"""Figure 4 of [Tsai2006], measured: environments by as many numbers of every kind.

``PYTHONPATH=tests python -m figures.figure4`` prints the page of tables and writes it to a folder,
with a strip of pictures a light.  Where ``PRTBAKE_DATA`` names the real-data folder the
lights are six of its maps, else four procedural ones.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from figures.figure7 import markdown
from prtbake_storage.decode.cube_map import cube_texel_of, cube_texels
from prtbake_storage.decode.light import Light, LightFit
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_workers.environment.environment import Environment, lat_long_directions
from prtbake_workers.environment.fit import fit_scattered_srbf
from prtbake_workers.environment.fit.cells import Cells
from prtbake_workers.environment.hall import hall
from prtbake_workers.environment.light_error import squared_error_ratio
from prtbake_workers.environment.procedural import one_texel_sun
from prtbake_workers.environment.reading import read_environment
from prtbake_workers.environment.sh_projection import project_sh
from prtbake_workers.environment.sky import sun_sky
from prtbake_workers.environment.uniform_srbf import fit_uniform_srbf
from prtbake_workers.environment.wavelet_projection import (
    cube_map_of,
    project_wavelet,
    wavelet_samples,
)
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.render.images import GAP, auto_exposure, png_bytes, side_by_side, to_srgb8

SEED = 0
RESOLUTION = 32
"""Of the cube map, as in the paper."""
FITTED_PARTS, JUDGED_PARTS = 4, 6
"""Along the edge of a texel: samples in which lights are fitted, and in which errors are taken."""
MAPS = (
    "grace_probe.hdr", "rnl_probe.hdr", "uffizi.hdr", "ennis.hdr", "kloppenheim_05_1k.hdr",
    "st_peters_square_night_1k.hdr",
)  # fmt: skip
SEEN_BY = WhitenedSrbfs(icosphere(3), 60.0)
"""The basis that transfer is projected on by default."""


@dataclass(frozen=True)
class Sizes:
    """Functions of every kind; the last ones of harmonics and wavelets have three times as many
    numbers."""

    lobes: int = 162
    centres: tuple[int, int] = (162, 642)
    orders: tuple[int, int] = (18, 31)
    wavelets: tuple[int, int] = (324, 972)
    max_iterations: int = 6


@dataclass(frozen=True)
class Method:
    """A kind of light: its name, how many numbers it takes, and the fit."""

    name: str
    numbers: int
    fit: Callable[[Cells], Light]
    pictured: bool = False


def methods(sizes: Sizes) -> list[Method]:
    """List what is compared."""

    def scattered(texels: Cells) -> Light:
        fit = fit_scattered_srbf(
            texels.radiance, texels.directions, texels.solid_angles, sizes.lobes,
            seed=SEED, max_iterations=sizes.max_iterations,
        )  # fmt: skip
        return LightFit(
            centres=fit.centres, bandwidths=fit.bandwidths, coefficients=fit.coefficients
        )

    listed = [Method(f"scattered SRBF, {sizes.lobes}", 6 * sizes.lobes, scattered, pictured=True)]
    for k, (order, kept, centres) in enumerate(
        zip(sizes.orders, sizes.wavelets, sizes.centres, strict=True)
    ):
        first = k == 0
        listed += [
            Method(
                f"SH, order {order}", 3 * order**2,
                lambda texels, n=order: project_sh(texels, n), first,
            ),
            Method(
                f"area-weighted wavelets, {kept}", 3 * kept,
                lambda texels, n=kept: project_wavelet(texels, RESOLUTION, n, area_weighted=True),
                first,
            ),
            Method(
                f"largest wavelets, {kept}", 3 * kept,
                lambda texels, n=kept: project_wavelet(texels, RESOLUTION, n), first,
            ),
            Method(
                f"uniform SRBF, {centres}", 3 * centres,
                lambda texels, n=centres: fit_uniform_srbf(texels, n), first,
            ),
        ]  # fmt: skip
    return listed


def environments() -> dict[str, Environment]:
    """Give the lights by name."""
    if folder := os.environ.get("PRTBAKE_DATA"):
        found = {}
        for name in MAPS:
            path = Path(folder) / "environments" / name
            found[name], _ = read_environment(path.read_bytes(), filename=name)
        return found
    return {
        "sky": sun_sky(128, 40.0, 30.0),
        "hall": hall(128),
        "sun of one texel": one_texel_sun(64),
        "dawn": sun_sky(128, 5.0, -100.0),
    }


def cube_of(environment: Environment) -> np.ndarray:
    """Merge a map into the cube map: the radiance of its texels."""
    return cube_map_of(wavelet_samples(environment, RESOLUTION), RESOLUTION)


def texels_of(cube: np.ndarray, parts: int) -> Cells:
    """Cut the texels of the cube map into parts of one radiance each."""
    directions, solid_angles, owners = cube_texels(RESOLUTION, parts)
    return Cells(directions, cube[owners], solid_angles)


def judge(cube: np.ndarray) -> Callable[[Light], tuple[float, float]]:
    """Give what tells a light's squared-error ratios over the sphere and in transfer's basis."""
    texels = texels_of(cube, JUDGED_PARTS)
    truth = SEEN_BY.light_of_samples(texels.directions, texels.solid_angles, texels.radiance)

    def errors(light: Light) -> tuple[float, float]:
        seen = light.on_basis(SEEN_BY) - truth
        return squared_error_ratio(light, texels), float((seen**2).sum() / (truth**2).sum())

    return errors


def picture(values: np.ndarray, height: int, exposure: float) -> np.ndarray:
    """Show radiance on a lat-long picture."""
    image = np.maximum(values, 0.0).astype(np.float32).reshape(height, 2 * height, 3)
    return to_srgb8(image, exposure)


Errors = dict[str, dict[str, tuple[float, float]]]
"""Light -> method -> squared-error ratios over the sphere and in transfer's basis."""


def measure(
    maps: Mapping[str, Environment], compared: Sequence[Method], height: int | None = None
) -> tuple[Errors, dict[str, float], list[np.ndarray]]:
    """Fit every light by every method: errors, CPU seconds a light by method, strips of pictures.

    Without a ``height`` of the pictures none are drawn.
    """
    found: Errors = {}
    spent = dict.fromkeys((method.name for method in compared), 0.0)
    strips = []
    for name, environment in maps.items():
        cube = cube_of(environment)
        texels, errors = texels_of(cube, FITTED_PARTS), judge(cube)
        fitted = {}
        for method in compared:
            start = time.process_time()
            fitted[method.name] = method.fit(texels)
            spent[method.name] += time.process_time() - start
        found[name] = {method: errors(light) for method, light in fitted.items()}
        if height is not None:
            shown = [fitted[method.name] for method in compared if method.pictured]
            strips.append(strip(cube, shown, height))
    return found, {name: seconds / len(maps) for name, seconds in spent.items()}, strips


def strip(cube: np.ndarray, lights: Sequence[Light], height: int) -> np.ndarray:
    """Show a cube map and lights beside each other, at one exposure."""
    directions = lat_long_directions(height, 2 * height)
    shown = [cube[cube_texel_of(directions, RESOLUTION)]]
    shown += [light.radiance(directions) for light in lights]
    exposure = auto_exposure(
        shown[0].astype(np.float32).reshape(height, -1, 3),
        np.ones((height, 2 * height), np.float32),
    )
    return side_by_side([picture(one, height, exposure) for one in shown])


def main(arguments: list[str], sizes: Sizes | None = None) -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description="Compare lights of as many numbers.")
    parser.add_argument("--to", type=Path, default=Path("figure4-output"), help="folder")
    parser.add_argument("--height", type=int, default=96, help="of each picture, in pixels")
    options = parser.parse_args(arguments)
    options.to.mkdir(parents=True, exist_ok=True)
    compared = methods(sizes or Sizes())
    found, seconds, strips = measure(environments(), compared, options.height)
    gap = np.full((GAP, strips[0].shape[1], 3), 255, np.uint8)
    stacked = [piece for strip in strips for piece in (gap, strip)][1:]
    (options.to / "figure4.png").write_bytes(png_bytes(np.concatenate(stacked)))
    rows = {
        heading: [
            (name, *(f"{100 * own[method.name][place]:.2f}" for method in compared))
            for name, own in found.items()
        ]
        for place, heading in enumerate(("over the sphere", "as transfer sees it"))
    }
    text = page(compared, rows, seconds)
    (options.to / "figure4.md").write_text(text)
    sys.stdout.write(text)
    return 0


def page(
    compared: list[Method],
    rows: dict[str, list[tuple[str, ...]]],
    seconds: dict[str, float],
) -> str:
    """Write the page."""
    names = [method.name for method in compared]
    counted = ("numbers", *(str(method.numbers) for method in compared))
    spent = ("CPU seconds a light", *(f"{seconds[name]:.1f}" for name in names))
    lines = [
        "# Lights of as many numbers",
        "Figure 4 of [Tsai2006], measured by `make figure4`: environments merged into a cube map "
        f"of {RESOLUTION} x {RESOLUTION} texels a face, and what sums of functions leave of it. A "
        "scattered lobe is six numbers (two of its centre, a bandwidth, three coefficients), any "
        "other function three; which wavelets are kept is not counted, as in the paper. Its text "
        "does not say whether its 972 coefficients of harmonics and wavelets are those of all "
        "three channels (324 functions) or of each: both are here.",
        "Wavelets are orthonormal over solid angle. The area-weighted ones hold most flux, radiance "
        "times the area that they span, which is what [Ng2003] keeps and the paper compares with. "
        "The largest ones hold most squared radiance: no other choice of as many leaves less. Both "
        "live on the very texels of the map, where a lamp of one texel is a handful of "
        "coefficients; all other functions know no texels and blur its edges.",
        "![The lights beside each other](figure4.png)",
        f"From left to right: the map, {', '.join(m.name for m in compared if m.pictured)}; one "
        "exposure a light, what is below zero is black.",
        f"Lights are fitted in {FITTED_PARTS} x {FITTED_PARTS} parts of each texel, errors taken in "
        f"{JUDGED_PARTS} x {JUDGED_PARTS} others.",
    ]
    for place, own in rows.items():
        lines.append(f"## Squared-error ratio {place}, in per cent")
        if place != "over the sphere":
            lines.append(
                f"After projection on the {SEEN_BY.n_coeffs} SRBFs of bandwidth "
                f"{SEEN_BY.bandwidth:g} that transfer lives in by default."
            )
        lines.append(markdown([("light", *names), *own, counted, spent]).rstrip())
    return "\n\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
