from dataclasses import fields, replace

import numpy as np
import pytest

from prtbake_storage.contract.light import FitLightSettings
from prtbake_workers.planning.presets import PartCompression
from prtbake_workers.planning.resolution import vectors_of
from prtbake_workers.planning.step_errors import (
    POWERS,
    Resolution,
    energy_left,
    light_functions,
    line_factors,
    scaled_total,
)

OWN = Resolution(0.01, 6144, 642, 162, 200)
NUMBERS = [field.name for field in fields(Resolution)]


def test_a_line_changes_by_what_decides_it_alone():
    same = line_factors(OWN, OWN)
    assert same == dict.fromkeys(POWERS, 1.0)
    fewer = line_factors(OWN, replace(OWN, functions=162))
    # a finer basis errs by less
    assert fewer["basis"] > 1.0
    assert fewer.pop("basis") == pytest.approx((162 / 642) ** POWERS["basis"][1])
    assert set(fewer.values()) == {1.0}


@pytest.mark.parametrize("name", NUMBERS)
def test_every_number_decides_something_there_and_back(name):
    other = replace(OWN, **{name: 3 * getattr(OWN, name)})
    there, back = line_factors(OWN, other), line_factors(other, OWN)
    assert all(there[kind] * back[kind] == pytest.approx(1.0) for kind in POWERS)
    # three times as much of it lessens some line, of energy lost three times as little
    assert min((back if name == "energy_lost" else there).values()) < 0.9


@pytest.mark.parametrize("name", NUMBERS)
def test_what_decides_nothing_scales_nothing(name):
    """A light or a file to a given error, terms that leave nothing."""
    nothing = replace(OWN, **{name: 0 * getattr(OWN, name)})
    assert line_factors(OWN, nothing) == line_factors(nothing, OWN) == line_factors(OWN, OWN)


@pytest.mark.parametrize(
    ("compression", "vectors"),
    [
        (PartCompression("cta", 10, (8, 48, 24), 16), 240),
        (PartCompression("cpca", 10, (1, 24, 24), 16), 170),
        (PartCompression("vq", 170, (1, 24, 24), 0), 170),
    ],
)
def test_vectors_that_vertices_are_mixed_of(compression, vectors):
    assert vectors_of(compression) == vectors


def test_energy_left_is_that_outside_the_terms():
    spectra = [np.array([2.0, 1.0, 1.0]), np.array([3.0])]
    assert energy_left(spectra, [1, 1]) == pytest.approx(2.0 / 6.0)
    assert energy_left(spectra, [3, 1]) == 0.0
    assert energy_left([np.zeros(2)], [1]) == 0.0


@pytest.mark.parametrize(
    ("settings", "functions"),
    [
        ({}, 162),
        ({"n_lobes": 40}, 40),
        ({"max_error": 0.05}, 0),
        ({"max_bytes": 10**5}, 0),
        ({"method": "sh", "sh_order": 7}, 49),
        ({"method": "wavelet", "n_wavelets": 50}, 50),
        ({"method": "srbf_uniform", "n_centres": 42}, 42),
    ],
)
def test_functions_of_a_light(settings, functions):
    assert light_functions(FitLightSettings.model_validate(settings)) == functions


def test_the_total_follows_the_squares_of_its_lines():
    lines = {"a": 0.3, "b": 0.4}
    assert scaled_total(0.6, lines, {}) == (0.6, lines)
    # a's share of the squares is 0.09 of 0.25; without it 0.8 of the root is left
    total, scaled = scaled_total(0.6, lines, {"a": 0.0, "other": 9.0})
    assert total == pytest.approx(0.6 * 0.8)
    assert scaled == {"a": 0.0, "b": 0.4}
    assert scaled_total(0.0, {"a": 0.0}, {"a": 2.0}) == (0.0, {"a": 0.0})
