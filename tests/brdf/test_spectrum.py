import numpy as np
import pytest

from prtbake_workers.brdf.spectrum import (
    RANK_FLOOR,
    AzimuthalSpectrum,
    Spectrum,
    energy_lost_by_terms,
)

# orders 0, 1, 2 and 3, the grid's last
VALUES = np.array([[8.0, 1.0, 0.1], [5.0, 2.0, 1e-9], [3.0, 0.5, 0.0], [4.0, 0.2, 0.0]])


@pytest.fixture
def spectrum():
    return AzimuthalSpectrum.from_blocks(VALUES)


def test_units_fall_and_the_last_order_stands_behind(spectrum):
    assert spectrum.orders[:6].tolist() == [0, 1, 2, 1, 0, 2]
    assert spectrum.values[:6].tolist() == [8, 5, 3, 2, 1, 0.5]
    assert spectrum.orders[-3:].tolist() == [3, 3, 3]
    assert spectrum.multiplicity[:6].tolist() == [1, 2, 2, 2, 1, 2]
    assert RANK_FLOOR * 8 > 1e-9
    assert spectrum.usable == 7


def test_all_values_count_pairs_twice(spectrum):
    assert spectrum.all_values[:9].tolist() == [8, 5, 5, 4, 3, 3, 2, 2, 1]
    assert len(spectrum.all_values) == 3 + 2 * 6 + 3


def test_ties_keep_the_lower_order_first():
    tied = AzimuthalSpectrum.from_blocks(np.ones((4, 2)))
    assert tied.orders.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


@pytest.mark.parametrize(
    ("asked", "kept"), [(1, 1), (2, 1), (3, 3), (4, 3), (5, 5), (7, 7), (8, 8), (9, 8), (99, 11)]
)
def test_no_number_of_terms_splits_a_pair(spectrum, asked, kept):
    assert spectrum.whole_counts[spectrum.units_for_terms(asked) - 1] == kept


def test_energy_left_is_the_rest_of_the_sum(spectrum):
    total = np.sum(spectrum.all_values**2)
    kept = np.cumsum(spectrum.multiplicity[:7] * spectrum.values[:7] ** 2)
    # sums of a dozen terms
    np.testing.assert_allclose(spectrum.energies_left, 1 - kept / total, rtol=1e-12)
    # the last order's energy cannot be won, so that it is left even by all that is usable
    assert spectrum.energies_left[-1] > 16 / total


@pytest.mark.parametrize(("lost", "units"), [(0.7, 1), (0.4, 2), (0.15, 4)])
def test_fewest_units_for_an_energy(spectrum, lost, units):
    assert spectrum.units_for_energy(lost) == units
    assert spectrum.energies_left[units - 1] <= lost
    assert units == 1 or spectrum.energies_left[units - 2] > lost


def test_none_where_no_number_serves(spectrum):
    assert spectrum.units_for_energy(0.01) is None


def test_energy_by_terms_may_split_a_pair(spectrum):
    total = np.sum(spectrum.all_values**2)
    assert energy_lost_by_terms(spectrum.all_values, 2) == pytest.approx(1 - 89 / total)


def test_equal_values_of_any_blocks_make_one_unit():
    falling = np.array([8.0, 5.0, 5.0 * (1 - 1e-9), 3.0, 3.0, 3.0, 2.0, 1.999, 1e-9])
    spectrum = Spectrum.from_values(falling)
    assert spectrum.multiplicity.tolist() == [1, 2, 3, 1, 1, 1]
    assert spectrum.whole_counts.tolist() == [1, 3, 6, 7, 8]
    # the last is noise
    assert spectrum.usable == 5
    assert spectrum.energies_left[1] == pytest.approx((27 + 4 + 1.999**2) / np.sum(falling**2))


def test_two_that_differ_are_two_units():
    assert Spectrum.from_values(np.array([2.0, 2.0 * (1 - 1e-5)])).multiplicity.tolist() == [1, 1]
