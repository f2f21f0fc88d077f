"""The decisions of a search for a time."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prtbake_workers.planning.time_search import (
    LEAST_SAMPLES,
    MARGIN,
    Measured,
    Step,
    choose_step,
    kept_for,
    predicted_seconds,
    samples_for,
)

STEPS = {1: Step(20.0, 5.0, 3.0), 2: Step(100.0, 10.0, 6.0), 3: Step(1000.0, 50.0, 20.0)}
AS_PREDICTED = Measured(5.0, 5.0, 1.0, 1.0)
TWICE = Measured(5.0, 10.0, 1.0, 2.0)


def test_predictions_go_by_what_an_attempt_took():
    assert predicted_seconds(STEPS[1], AS_PREDICTED) == pytest.approx((MARGIN * 25, MARGIN * 3))
    assert predicted_seconds(STEPS[1], TWICE) == pytest.approx((MARGIN * 50, MARGIN * 6))


def test_what_is_kept_for_the_end_goes_by_a_slow_machine_and_not_by_a_quick_one():
    assert kept_for(3.0) == kept_for(3.0, off=0.5) == pytest.approx(MARGIN * 3)
    assert kept_for(3.0, off=2.0) == pytest.approx(MARGIN * 6)
    assert predicted_seconds(STEPS[1], TWICE)[1] == kept_for(3.0, off=2.0)


def test_the_highest_step_that_fits_is_chosen():
    assert choose_step(STEPS, 0, AS_PREDICTED, MARGIN * 116 + 0.1) == (2, MARGIN * 28)
    assert choose_step(STEPS, 0, AS_PREDICTED, MARGIN * 116 - 0.1)[0] == 1
    # the same seconds on a machine that is half as fast
    assert choose_step(STEPS, 0, TWICE, MARGIN * 116 + 0.1)[0] == 1


def test_steps_that_were_made_are_not_made_again():
    assert choose_step(STEPS, 2, AS_PREDICTED, 500.0) == (None, pytest.approx(MARGIN * 1070))
    assert choose_step(STEPS, 3, AS_PREDICTED, 1e9) == (None, None)


@given(st.floats(0.01, 1e4), st.floats(0.0, 1e4), st.floats(0.0, 1e4))
def test_more_time_never_chooses_less_and_nothing_chosen_overruns(took, one, other):
    told = Measured(5.0, took, 1.0, took / 5.0)
    less, more = sorted((one, other))
    first, second = (choose_step(STEPS, 0, told, left)[0] or 0 for left in (less, more))
    assert first <= second
    if second:
        assert sum(predicted_seconds(STEPS[second], told)) <= more


def test_a_validation_gets_the_samples_that_there_is_time_for():
    assert samples_for(128, 10.0, 20.0) == 128
    assert samples_for(128, 20.0, 10.0) == 64
    assert samples_for(128, 20.0, -1.0) == LEAST_SAMPLES
    assert samples_for(4, 20.0, 1.0) == 4
