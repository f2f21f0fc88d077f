import pytest

from prtbake_workers.compress.monotone import (
    ALLOWED_RISE,
    FOLLOWED_SHORT,
    ObjectiveRose,
    ObjectiveTrace,
)


def test_falling_and_rounding_are_accepted() -> None:
    trace = ObjectiveTrace(10.0, "test")
    for value in (5.0, 4.0, 4.0 + 0.9 * ALLOWED_RISE * 10.0, 1.0):
        trace.append(value)
    assert trace.ratio == pytest.approx(0.1)


@pytest.mark.parametrize("value", [4.0 + 1.1 * ALLOWED_RISE * 10.0, float("nan"), float("inf")])
def test_a_rise_is_refused_with_its_step(value: float) -> None:
    trace = ObjectiveTrace(10.0, "test")
    trace.append(4.0)
    with pytest.raises(ObjectiveRose, match=r"test: .*1"):
        trace.append(value)
    assert trace.values == [4.0]


@pytest.mark.parametrize(
    ("may_rise", "expected"), [(False, [5.0, 4.00001, 4.00001]), (True, [5.0, 4.0, 4.00001])]
)
def test_a_measured_objective_takes_the_place_of_the_last(
    may_rise: bool, expected: list[float]
) -> None:
    trace = ObjectiveTrace(20.0, "test", may_rise=may_rise)
    for value in (5.0, 4.0, 4.00001 - 0.9 * FOLLOWED_SHORT * 20.0):
        trace.append(value)
    trace.measured(4.00001)
    assert trace.values == expected
    empty = ObjectiveTrace(10.0, "test")
    empty.measured(4.2)
    assert empty.values == []


@pytest.mark.parametrize("may_rise", [False, True])
@pytest.mark.parametrize("value", [3.9 + 1.1 * FOLLOWED_SHORT * 20.0, float("nan"), float("inf")])
def test_an_objective_that_was_followed_too_low_is_refused(value: float, may_rise: bool) -> None:
    trace = ObjectiveTrace(20.0, "test", may_rise=may_rise)
    for one in (5.0, 4.0, 3.9):
        trace.append(one)
    with pytest.raises(ObjectiveRose, match="measured"):
        trace.measured(value)
    assert trace.values == [5.0, 4.0, 3.9]


def test_convergence_needs_two_steps_or_no_error() -> None:
    trace = ObjectiveTrace(10.0, "test")
    assert not trace.has_converged(1e-3)
    trace.append(4.0)
    assert not trace.has_converged(1e-3)
    trace.append(3.9)
    assert not trace.has_converged(1e-3)
    trace.append(3.8999)
    assert trace.has_converged(1e-3)
    trace.append(0.0)
    assert trace.has_converged(0.0)


def test_nothing_to_compress_has_no_error() -> None:
    trace = ObjectiveTrace(0.0, "test")
    trace.append(0.0)
    assert trace.ratio == 0.0
