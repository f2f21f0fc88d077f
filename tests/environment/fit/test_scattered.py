"""The whole fit on lights whose lobes are known, on suns, and at the ends of its range."""

import numpy as np
import pytest

from prtbake_storage.decode.light import LightFit
from prtbake_storage.errors import EnvironmentMapError, SettingsError
from prtbake_workers.environment.environment import (
    LUMINANCE,
    Environment,
    lat_long_directions,
    lat_long_solid_angles,
)
from prtbake_workers.environment.fit import fit_environment, fit_scattered_srbf
from prtbake_workers.environment.fit.cells import Cells, clip_level, environment_texels
from prtbake_workers.environment.fit.objective import Lobes, evaluate_lobes
from prtbake_workers.environment.fit.peaks import split_peaks
from prtbake_workers.environment.fit.refine import narrowest_bandwidths
from prtbake_workers.environment.light_error import squared_error_ratio
from prtbake_workers.environment.procedural import constant, one_texel_sun
from prtbake_workers.environment.sky import sun_direction

KNOWN = Lobes(
    np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, -0.6, -0.8]]), np.array([4.0, 12, 30, 8])
)
COLOURS = np.array([[1.0, 0.5, 0.2], [2.0, 2.0, 3.0], [0.5, 4.0, 1.0], [1.0, 1.0, 1.0]])


def known_light(height: int = 24):
    directions = lat_long_directions(height, 2 * height)
    radiance = evaluate_lobes(KNOWN, directions) @ COLOURS
    return radiance, directions, lat_long_solid_angles(height, 2 * height)


def relative_error(fit, radiance, directions, weights) -> float:
    fitted = evaluate_lobes(Lobes(fit.centres, fit.bandwidths), directions) @ fit.coefficients
    return float(weights @ ((fitted - radiance) ** 2).sum(axis=1)) / float(
        weights @ (radiance**2).sum(axis=1)
    )


def test_a_light_made_of_lobes_is_found_again() -> None:
    light = known_light()
    fit = fit_scattered_srbf(*light, 4, seed=1, max_iterations=20)
    # limited by the steps allowed: measured 1e-6
    assert fit.error < 1e-4
    assert fit.error == pytest.approx(relative_error(fit, *light), rel=1e-6)
    order = [int(np.argmax(fit.centres @ centre)) for centre in KNOWN.centres]
    assert sorted(order) == [0, 1, 2, 3]
    assert fit.bandwidths[order] == pytest.approx(KNOWN.bandwidths, rel=0.05)
    assert fit.coefficients[order] == pytest.approx(COLOURS, rel=0.05)


def test_the_reported_error_notices_a_changed_coefficient() -> None:
    light = known_light()
    fit = fit_scattered_srbf(*light, 6, seed=1, max_iterations=3)
    worse = fit._replace(coefficients=fit.coefficients * 1.05)
    assert relative_error(worse, *light) > 1.5 * fit.error


@pytest.mark.parametrize(("height", "n_lobes"), [(1, 3), (1, 162), (2, 162), (8, 500)])
@pytest.mark.parametrize("lit", ["random", "even", "lamp"])
def test_a_map_of_a_few_texels_takes_no_more_lobes_than_it_has_room_for(
    rng, height, n_lobes, lit
) -> None:
    """Lobes that coincide, each half as wide as the one before, made the Gram matrix singular."""
    radiance = {
        "random": rng.random((height, 2 * height, 3)),
        "even": np.ones((height, 2 * height, 3)),
        "lamp": np.full((height, 2 * height, 3), 1e-3),
    }[lit]
    if lit == "lamp":
        radiance[0, 0] = 1e3
    environment = Environment(radiance.astype(np.float32))
    fit = fit_environment(environment, n_lobes, seed=0, max_iterations=1)
    room = len(environment_texels(environment).solid_angles)
    assert 0 < len(fit.centres) <= min(n_lobes, room)
    assert np.isfinite(fit.coefficients).all()
    # as many lobes as texels: what is left is the ridge's and, of a lamp, the edges of its texel
    assert fit.error < (0.25 if lit == "lamp" else 0.02)


def test_lamps_over_a_black_floor_are_fitted() -> None:
    """Lamps far above the clip level, and texels of no radiance at all: a quotient overflowed."""
    radiance = np.zeros((16, 32, 3), np.float32)
    radiance[:10] = 1.0
    radiance[4, 6] = radiance[9, 20] = 1e6
    environment = Environment(radiance)
    texels = environment_texels(environment)
    clipped, excess = split_peaks(texels)
    lit = texels.radiance.any(axis=1)
    assert not clipped.radiance[~lit].any()
    np.testing.assert_array_equal(clipped.radiance + excess.radiance, texels.radiance)
    # at most the clip level everywhere, and that level is far above 4
    level = clip_level(texels.radiance @ LUMINANCE, texels.solid_angles)
    assert level > 4.0
    assert (clipped.radiance @ LUMINANCE).max() == pytest.approx(level, rel=1e-12)
    fit = fit_environment(environment, 12, seed=0, max_iterations=2)
    # square lamps of one texel each by four Gaussians: 0.19 was measured, 1 is no fit at all
    assert fit.error < 0.3
    assert fit.power_ratio == pytest.approx(1.0, abs=0.05)


def test_more_lobes_fit_better(rng) -> None:
    environment = Environment((rng.random((16, 32, 3)) ** 3).astype(np.float32))
    errors = [fit_environment(environment, n, seed=0, max_iterations=2).error for n in (2, 8, 32)]
    assert errors[0] > errors[1] > errors[2]


def test_equal_arguments_give_equal_bytes() -> None:
    light = known_light(12)
    first, second = (fit_scattered_srbf(*light, 5, seed=3, max_iterations=2) for _ in range(2))
    for a, b in zip(first[:3], second[:3], strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_sun_of_one_texel_keeps_its_power_and_leaves_lobes_for_the_sky() -> None:
    sun = one_texel_sun(64)
    fit = fit_environment(sun, 24, seed=0, max_iterations=3)
    assert 1 <= fit.n_peak_lobes <= 8
    # Gaussians in a square texel: measured 0.10 with eight of them
    assert fit.error < 0.15
    # and no less between the samples that it was taken in
    light = LightFit(centres=fit.centres, bandwidths=fit.bandwidths, coefficients=fit.coefficients)
    other = environment_texels(sun, 40)
    assert squared_error_ratio(light, other) == pytest.approx(fit.error, rel=0.03)
    # negative twin: the samples that the lobes moved in tell far less
    assert squared_error_ratio(light, environment_texels(sun)) < 0.9 * fit.error
    # the lobes' integrals in closed form against the map's power: measured 1e-4
    assert fit.power_ratio == pytest.approx(1.0, abs=0.005)
    directions, weights = sun.directions(), sun.solid_angles()
    far = directions @ sun_direction(40.0, 30.0) < np.cos(0.5)
    sky = evaluate_lobes(Lobes(fit.centres, fit.bandwidths), directions[far]) @ fit.coefficients
    rms = np.sqrt(weights[far] @ (sky[:, 0] - 0.05) ** 2 / weights[far].sum())
    # the sun is 1e4 times as bright; measured 0.03, and 0.23 by least squares alone
    assert rms / 0.05 < 0.1


def test_no_lobe_is_narrower_than_its_samples_can_show(rng) -> None:
    radiance = np.zeros((16, 32, 3), dtype=np.float32)
    radiance[5, 7] = 1.0
    environment = Environment(radiance + 1e-3)
    radiance, directions, weights = (
        environment.radiance.reshape(-1, 3),
        environment.directions(),
        environment.solid_angles(),
    )
    fit = fit_scattered_srbf(radiance, directions, weights, 6, seed=0, max_iterations=2)
    texels = Cells(directions, radiance.astype(np.float64), weights)
    assert (fit.bandwidths <= 1.001 * narrowest_bandwidths(texels, fit.centres).max()).all()


def test_a_constant_light_takes_a_wide_lobe() -> None:
    fit = fit_environment(constant(32, 2.0), 4, seed=0)
    # lobes no wider than bandwidth 0.05 make up a constant to this
    assert fit.error < 1e-5
    assert fit.power_ratio == pytest.approx(1.0, rel=1e-3)


def test_progress_never_falls_and_ends_at_one() -> None:
    seen: list[float] = []
    fit_scattered_srbf(
        *known_light(8), 3, seed=0, max_iterations=1, progress=lambda share, _: seen.append(share)
    )
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"n_lobes": 0}, SettingsError, "n_lobes is 0"),
        ({"max_iterations": 0}, SettingsError, "max_iterations is 0"),
    ],
)
def test_settings_out_of_range_are_refused(change, error, message) -> None:
    radiance, directions, weights = known_light(8)
    arguments = {"n_lobes": 3, "seed": 0, **change}
    with pytest.raises(error, match=message):
        fit_scattered_srbf(radiance, directions, weights, **arguments)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_a_sample_that_is_no_light_is_named(value) -> None:
    radiance, directions, weights = known_light(8)
    radiance[17, 1] = value
    with pytest.raises(EnvironmentMapError, match="texel 17"):
        fit_scattered_srbf(radiance, directions, weights, 3, seed=0)
