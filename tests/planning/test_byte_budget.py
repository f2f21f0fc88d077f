"""Sizes for bytes: ample, in proportion, and never more numbers than the transfer."""

from dataclasses import asdict

import pytest

from prtbake_workers.planning.byte_budget import NUMBERS_A_BYTE, Extent, sized_to_bytes
from prtbake_workers.planning.cost import factor_floats
from prtbake_workers.planning.presets import PartCompression

GLOSSY, FLAT = Extent(4658, 12, 642, 1), Extent(4096, 1, 642, 1)
SIZES = [
    PartCompression("cta", 13, (8, 48, 24), 16),
    PartCompression("cpca", 11, (1, 24, 24), 16),
]


def numbers(extents, sizes):
    return sum(factor_floats(one, **asdict(of)) for of, one in zip(extents, sizes, strict=True))


def sized(factor_bytes, sizes=SIZES, *, given=False):
    return sized_to_bytes([GLOSSY, FLAT], sizes, factor_bytes, clusters_given=given)


@pytest.mark.parametrize("factor_bytes", [1e5, 2e5, 1e6, 3e6])
def test_numbers_are_ample_for_the_bytes(factor_bytes):
    found = numbers([GLOSSY, FLAT], sized(factor_bytes))
    assert factor_bytes * NUMBERS_A_BYTE <= found <= 1.3 * factor_bytes * NUMBERS_A_BYTE


def test_more_bytes_mean_no_fewer_numbers():
    found = [numbers([GLOSSY, FLAT], sized(10.0**power)) for power in range(1, 12)]
    assert found == sorted(found)
    assert found[-1] <= 1.2 * (4658 * 12 + 4096) * 642


def test_clusters_that_are_given_stay():
    large = sized(3e6, given=True)
    assert [one.n_clusters for one in large] == [13, 11]
    assert [one.n_clusters for one in sized(3e6)] > [13, 11]


@pytest.mark.parametrize("factor_bytes", [0.0, -5e4])
def test_where_nothing_is_left_sizes_are_the_smallest(factor_bytes):
    assert sized(factor_bytes)[1].n_components == 4
    assert sized(factor_bytes)[0].ranks == (8, 12, 6)


def test_vector_quantisation_goes_by_its_clusters():
    vq = [PartCompression("vq", 100, (1, 1, 1), 0)]
    few, many = (
        sized_to_bytes([FLAT], vq, size, clusters_given=False)[0].n_clusters for size in (2e4, 2e5)
    )
    assert many == pytest.approx(10 * few, rel=0.1)
