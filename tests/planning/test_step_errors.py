from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.contract.settings import FitLightSettings
from prtbake_workers.planning.step_errors import (
    EXPONENTS,
    Resolution,
    energy_left,
    light_functions,
    line_factors,
    scaled_total,
)

OWN = Resolution(0.01, 6144, 642, 64.0, 162, 10_000)


def test_a_line_changes_by_what_decides_it_alone():
    same = line_factors(OWN, OWN)
    assert same == dict.fromkeys(EXPONENTS, 1.0)
    fewer = line_factors(OWN, replace(OWN, functions=162))
    assert fewer.pop("functions") == pytest.approx((162 / 642) ** EXPONENTS["functions"])
    assert set(fewer.values()) == {1.0}
    # fewer functions err by more, terms that leave more too
    assert line_factors(OWN, replace(OWN, functions=162))["functions"] > 1.0
    assert line_factors(OWN, replace(OWN, energy_lost=0.04))["energy_lost"] == pytest.approx(2.0)


@pytest.mark.parametrize("name", list(EXPONENTS))
def test_there_and_back_is_no_change(name):
    other = replace(OWN, **{name: 3 * getattr(OWN, name)})
    there, back = line_factors(OWN, other), line_factors(other, OWN)
    assert there[name] * back[name] == pytest.approx(1.0)
    assert there[name] != pytest.approx(1.0)


@pytest.mark.parametrize("name", list(EXPONENTS))
def test_what_decides_nothing_scales_nothing(name):
    """No bounces, a light or a file to a given error, terms that leave nothing."""
    nothing = replace(OWN, **{name: 0 * getattr(OWN, name)})
    assert line_factors(OWN, nothing)[name] == line_factors(nothing, OWN)[name] == 1.0


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
