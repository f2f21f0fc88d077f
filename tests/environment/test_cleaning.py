"""Pixels that are no light: refused with their place, or mended and counted."""

import numpy as np
import pytest

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.environment.cleaning import MAX_RADIANCE, clean_pixels


def ramp() -> np.ndarray:
    return np.arange(1, 5 * 6 * 3 + 1, dtype=np.float32).reshape(5, 6, 3)


def test_good_pixels_pass_untouched() -> None:
    pixels, found = clean_pixels(ramp(), repair_non_finite=False, clamp_negative=False)
    assert np.array_equal(pixels, ramp())
    assert (found.n_non_finite, found.n_negative) == (0, 0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused_by_place(value) -> None:
    pixels = ramp()
    pixels[3, 4, 2] = value
    with pytest.raises(EnvironmentMapError, match=r"x=4, y=3, channel=B") as caught:
        clean_pixels(pixels, repair_non_finite=False, clamp_negative=True)
    assert "1 pixels" in caught.value.detail
    assert caught.value.pointer == "/repair_non_finite"


def test_repair_takes_the_median_of_the_finite_neighbours() -> None:
    ramp_ = np.tile(ramp(), (2, 1, 1))
    pixels = ramp_.copy()
    pixels[2, 2, 0] = np.nan
    pixels[2, 3] = np.inf
    mended, found = clean_pixels(pixels, repair_non_finite=True, clamp_negative=True)
    window = ramp_[1:4, 1:4].reshape(9, 3)[[0, 1, 2, 3, 6, 7, 8]]
    assert np.array_equal(mended[2, 2], np.median(window, axis=0))
    assert found.n_non_finite == 2
    assert found.non_finite_places[0].startswith("(x=2, y=2, channel=R): nan")
    untouched = np.ones((10, 6), bool)
    untouched[2, 2:4] = False
    assert np.array_equal(mended[untouched], ramp_[untouched])


def test_repair_widens_its_window_until_it_finds_something() -> None:
    pixels = np.ones((20, 20, 3), dtype=np.float32)
    pixels[9:12, 9:12] = np.nan
    mended, _ = clean_pixels(pixels, repair_non_finite=True, clamp_negative=True)
    assert (mended == 1).all()


def test_a_picture_that_is_mostly_damaged_is_not_repaired() -> None:
    pixels = ramp()
    pixels[:3] = np.nan
    with pytest.raises(EnvironmentMapError, match="60%"):
        clean_pixels(pixels, repair_non_finite=True, clamp_negative=True)


def test_negative_pixels_are_clamped_and_counted_or_refused() -> None:
    pixels = ramp()
    pixels[0, 1] = [-2.0, 5.0, -0.5]
    clamped, found = clean_pixels(pixels, repair_non_finite=False, clamp_negative=True)
    assert clamped[0, 1].tolist() == [0.0, 5.0, 0.0]
    assert (found.n_negative, found.most_negative) == (1, -2.0)
    with pytest.raises(EnvironmentMapError, match=r"x=1, y=0, channel=R\): -2"):
        clean_pixels(pixels, repair_non_finite=False, clamp_negative=False)


def test_radiance_that_float32_cannot_carry_on_is_refused() -> None:
    pixels = ramp()
    pixels[1, 1, 1] = MAX_RADIANCE
    clean_pixels(pixels, repair_non_finite=False, clamp_negative=False)
    pixels[1, 1, 1] = 1.01 * MAX_RADIANCE
    with pytest.raises(EnvironmentMapError, match=r"x=1, y=1, channel=G"):
        clean_pixels(pixels, repair_non_finite=False, clamp_negative=False)
