"""The decisions of a search for an error in a number of bytes."""

from math import hypot, inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prtbake_workers.planning.byte_search import (
    MENDED_ROOM,
    WORTH,
    Left,
    beyond_bytes,
    bytes_needed,
    finer_step,
    mended_by_bytes,
    of_finer,
    within,
)
from prtbake_workers.planning.error_search import TRUST, WINDOW

AIM = 0.04
LARGE = Left(transfer=0.03, light=0.03, total=0.045)
"""Of three parts in 4.5 the bake has three, and compression all that is beside."""


def test_parts_of_an_error_add_up_by_their_squares():
    left = Left(transfer=0.03, light=0.05, total=0.13)
    assert (left.fit, left.compression) == (pytest.approx(0.04), pytest.approx(0.12))
    assert left.with_transfer(0.03) == pytest.approx(0.13)
    assert left.with_transfer(0.0) == pytest.approx(hypot(0.04, 0.12))
    assert left.largest("SRBF basis") == "compression"
    assert Left(0.03, 0.05, 0.051).largest("SRBF basis") == "light fit"
    assert Left(0.05, 0.051, 0.053).largest("SRBF basis") == "SRBF basis"
    # noise may make less of more
    assert Left(0.05, 0.049, 0.04).compression == 0.0


def test_a_finer_bake_is_taken_as_predicted_with_the_light_that_was_measured():
    """A total below what was predicted of the bake leaves nothing to compression."""
    left = Left(transfer=0.06, light=0.1, total=0.2)
    finer = of_finer(1, 2, [0.2, 0.12, 0.06], left, 0.17)
    assert (finer.transfer, finer.fit) == (pytest.approx(0.03), pytest.approx(left.fit))
    assert hypot(finer.transfer, finer.fit, finer.compression) == pytest.approx(0.17)
    assert of_finer(1, 1, [0.2, 0.12, 0.06], left, 0.2) == left
    assert of_finer(1, 2, [0.2, 0.12, 0.06], left, 0.02).compression == 0.0


def test_a_file_that_is_too_large_for_an_error_near_the_aim_ends_the_trials():
    least = WINDOW[0] * AIM
    assert beyond_bytes(least, 1001, AIM, 1000)
    # one that errs by less may be made smaller; one that fits is no reason; nor are no bytes
    assert not beyond_bytes(0.99 * least, 1001, AIM, 1000)
    assert not beyond_bytes(least, 1000, AIM, 1000)
    assert not beyond_bytes(least, 1001, AIM, None)
    assert not beyond_bytes(None, None, AIM, 1000)


def test_files_that_are_too_large_count_for_nothing():
    tried = [(0.1, 0.03), (0.2, 0.04), (0.3, None)]
    sizes = [1001, 1000, None]
    assert within(tried, sizes, 1000) == [(0.1, None), (0.2, 0.04), (0.3, None)]
    assert within(tried, sizes, None) == tried


def test_the_least_that_can_be_asked_for_is_of_what_met_the_aim():
    tried = [(0.1, 0.03), (0.2, AIM), (0.3, 1.1 * AIM), (0.4, None)]
    assert bytes_needed(tried, [2000, 1500, 1000, None], AIM) == "1500 bytes"
    assert bytes_needed(tried[2:], [1000, None], AIM) == "more than 1000 bytes"


def test_the_lowest_step_that_leaves_room_is_made():
    """Compression keeps what it adds; the bake's part goes by its prediction."""
    assert LARGE.with_transfer(0.015) <= AIM < LARGE.with_transfer(0.025)
    assert finer_step(0, [0.03, 0.025, 0.015, 0.01], LARGE, AIM) == 2
    # predictions are corrected by what was measured: half of those
    assert finer_step(0, [0.06, 0.05, 0.03, 0.02], LARGE, AIM) == 2
    assert finer_step(1, [0.04, 0.03, 0.015], LARGE, AIM) == 2
    assert finer_step(0, [0.0, 0.0], LARGE, AIM) is None


def test_a_step_that_may_do_is_tried_and_one_that_changes_nothing_is_not():
    assert AIM < LARGE.with_transfer(0.025) <= TRUST * AIM
    assert finer_step(0, [0.03, 0.029, 0.025], LARGE, AIM) == 2
    assert LARGE.with_transfer(0.029) > WORTH * LARGE.total
    assert finer_step(0, [0.03, 0.029], LARGE, AIM) is None
    assert finer_step(2, [0.03, 0.02, 0.03], LARGE, AIM) is None
    # where compression alone leaves too much no bake helps
    assert finer_step(0, [0.03, 1e-6], Left(0.03, 0.03, 2.0 * AIM), AIM) is None


@given(
    st.lists(st.floats(1e-4, 1.0), min_size=1, max_size=5),
    st.floats(1e-3, 1.0),
    st.floats(0.0, 1.0),
    st.floats(1e-3, 1.0),
)
def test_a_finer_step_is_above_and_predicted_to_be_worth_it(predictions, transfer, more, aim):
    left = Left(transfer, transfer, hypot(transfer, more))
    found = finer_step(0, predictions, left, aim)
    if found is not None:
        assert found > 0
        total = left.with_transfer(transfer / predictions[0] * predictions[found])
        assert total <= min(WORTH * left.total, TRUST * aim)


def test_what_has_little_room_to_grow_is_mended_by_all_bytes():
    assert mended_by_bytes(600, 1000)
    assert not mended_by_bytes(int(1000 / MENDED_ROOM) - 1, 1000)
    assert not mended_by_bytes(600, None)
    assert not mended_by_bytes(600, 10**9)


def test_a_part_of_nothing_is_no_part():
    assert Left(0.0, 0.0, inf).compression == inf
    assert Left(0.0, 0.0, 0.0).with_transfer(0.0) == 0.0
