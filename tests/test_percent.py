"""Shares as sentences tell them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prtbake_workers.percent import percent


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0.2, "20.00%"),
        (0.0123, "1.23%"),
        (1e-3, "0.10%"),
        (9.87e-4, "0.0987%"),
        (1e-5, "0.001%"),
        (0.0, "0.00%"),
    ],
)
def test_a_share_is_written_for_people(share, words):
    assert percent(share) == words


@given(st.floats(1e-7, 1.0))
def test_no_error_is_told_as_none_or_as_much_off(share):
    """Two decimals of a per cent are off by half of one in the last, at least a tenth of it."""
    told = float(percent(share).removesuffix("%")) / 100.0
    assert told == pytest.approx(share, rel=0.051)
