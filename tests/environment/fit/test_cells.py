"""Merging texels: energy kept, suns kept texel by texel."""

import numpy as np
import pytest

from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit.cells import (
    PEAK,
    SPLIT_ROWS,
    Cells,
    adaptive_cells,
    clip_level,
    environment_texels,
    even_cells,
)
from prtbake_workers.environment.procedural import constant, one_texel_sun


def plain_texels(environment: Environment) -> Cells:
    radiance = environment.radiance.reshape(-1, 3).astype(np.float64)
    return Cells(environment.directions(), radiance, environment.solid_angles())


@pytest.mark.parametrize(
    "merge",
    [lambda t: even_cells(t, 8), lambda t: adaptive_cells(t, 8, 1000)],
    ids=["even", "adaptive"],
)
def test_merging_keeps_the_integral_and_loses_only_variation(merge, rng) -> None:
    texels = plain_texels(Environment(rng.random((32, 64, 3)).astype(np.float32)))
    cells = merge(texels)
    assert len(cells.solid_angles) < len(texels.solid_angles)
    assert cells.solid_angles.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    wanted = texels.solid_angles @ texels.radiance
    assert cells.solid_angles @ cells.radiance == pytest.approx(wanted, rel=1e-12)
    assert np.linalg.norm(cells.directions, axis=1) == pytest.approx(1.0, rel=1e-12)
    assert cells.energy < texels.energy


def test_adaptive_cells_keep_a_sun_that_even_cells_smear() -> None:
    texels = environment_texels(one_texel_sun(128))
    assert adaptive_cells(texels, 8, 2000).energy == pytest.approx(texels.energy, rel=1e-6)
    assert even_cells(texels, 16).energy < 0.2 * texels.energy


def test_a_splitted_sun_keeps_area_and_energy() -> None:
    sun = one_texel_sun(64, sun_elevation_deg=70.0)
    texels, plain = environment_texels(sun), plain_texels(sun)
    assert len(texels.solid_angles) > len(plain.solid_angles)
    assert texels.solid_angles.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    assert texels.energy == pytest.approx(plain.energy, rel=1e-12)
    # every part lies in the texel whose radiance it has
    assert np.array_equal(sun.lookup(texels.directions), texels.radiance)
    bright = texels.radiance[:, 0] > 1
    assert bright.sum() == SPLIT_ROWS * round(SPLIT_ROWS * np.cos(np.radians(70)))
    three = environment_texels(sun, 3)
    assert (three.radiance[:, 0] > 1).sum() == 3 * round(3 * np.cos(np.radians(70)))
    assert three.energy == pytest.approx(plain.energy, rel=1e-12)


def test_only_few_directions_exceed_the_clip_level(rng) -> None:
    luminance = rng.random(1000) ** 30
    weights = np.full(1000, 4 * np.pi / 1000)
    level = clip_level(luminance, weights)
    clipped = np.minimum(luminance, level)
    assert level == pytest.approx(PEAK * clipped.mean(), rel=1e-4)
    assert (luminance > level).mean() <= 1 / PEAK
    assert clip_level(np.zeros(10), weights[:10]) == np.inf
    flat = constant(16).luminance.ravel()
    assert clip_level(flat, constant(16).solid_angles()) >= 1.0
