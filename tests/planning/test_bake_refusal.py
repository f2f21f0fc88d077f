"""What a search for a bake refuses with: the field that binds, and what can be asked for."""

import re
from math import ceil, sqrt

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from prtbake_storage.contract.bake_budget import BakeBudget
from prtbake_workers.planning.bake_model import BakeModel, Told
from prtbake_workers.planning.bake_refusal import LATER_SIZE
from prtbake_workers.planning.bake_search import AIM, MOST_BAKES, choose, delivered
from prtbake_workers.planning.time_search import MARGIN
from support.made_up_bakes import UNTIMED, left, made, model_of, searched, trial


def with_errors(one, squared):
    """The same bake, whose parts err by so much in all."""
    nothing = (0.0,) * len(one.terms)
    return Told(
        one.numbers, (squared,) * len(one.projection), nothing, nothing, one.size, one.seconds
    )


def one_row(error=1.2e-3):
    """A diffuse scene whose centres and directions are given."""
    pinned = trial(glossy=False)
    pinned["candidates"] = [{"n_centres": 42, "cube_resolution": 12, "errors": [error, error / 3]}]
    return BakeModel(pinned, lambda work: work["bake"]["flops"] / 1e9 + 1.0)


def test_bytes_that_all_bakes_keep_are_not_what_an_error_is_refused_by():
    """Four bakes end just above the error, far below the bytes, and finer ones look better."""
    model, budget = model_of(), BakeBudget(max_error=0.2, max_bytes=10**9)
    rows = [model.choices.index(one) for one in ((642, 24, 5), (162, 24, 5), (162, 12, 5))]
    rows.append(model.choices.index((42, 12, 5)))
    told = [with_errors(made(model, model.numbers(row, 4e-3)), 0.201**2) for row in rows]
    assert len(told) == MOST_BAKES
    assert (model.foreseen(told[-1], 4e-3).errors <= 0.04).any()
    choice = choose(model, budget, told, left=None, tolerance=1e-3)
    assert choice.numbers is None
    assert choice.refused == (
        "max_error",
        "an error of 20.00% is not met by the 4 bakes that are made: at best 20.10% was left of a, "
        "and the largest part of it is what directions and functions leave",
    )


def of_twelve_centres(model, error):
    """As many bakes as are made, of 12 centres each: the finest is the last."""
    rows = [model.choices.index((12, fine, 0)) for fine in (12, 24, 36, 48)]
    told = [with_errors(made(model, model.numbers(row, 4e-3)), error**2) for row in rows]
    assert len(told) == MOST_BAKES
    return told


def test_bytes_that_hold_back_all_that_keep_an_error_are_refused_after_all_bakes_too():
    """With 12 centres none is predicted to keep it, and 42 take too many bytes."""
    model = model_of(glossy=False)
    told = of_twelve_centres(model, 0.201)
    budget = BakeBudget(max_error=0.2, max_bytes=round(1.1 * told[0].size))
    seen = model.foreseen(told[-1], 4e-3)
    least = ceil(seen.sizes[seen.errors <= 0.04].min() / LATER_SIZE)
    choice = choose(model, budget, told, left=None, tolerance=1e-3)
    assert choice.refused == (
        "max_bytes",
        f"max_bytes is {budget.max_bytes}: the least that can be asked for for an error of "
        f"20.00% is predicted to be {least}, by the 4 that were made",
    )
    # the twin: bakes so far above the error that no centres are predicted to keep it
    field, why = choose(
        model, budget, of_twelve_centres(model, 0.7), left=None, tolerance=1e-3
    ).refused
    assert field == "max_error"
    assert "an error of 20.00% cannot be met: at best" in why
    assert "more than 642 centres and 6 x 48^2 directions are not tried" in why


def stopped(field, *, lost=0.0):
    """A diffuse scene whose trial was cut short after 12 centres."""
    short = trial(glossy=False)
    short["candidates"] = [one for one in short["candidates"] if one["n_centres"] == 12]
    short["options"][0]["lost"] = [lost, 0.0]
    cut = {"field": field, "n_centres": 42, "least": 250_000}
    short["cut"] = None if field is None else cut
    return BakeModel(short, lambda work: 1.0)


CUT = {
    "max_bytes": (
        {"max_bytes": 120_000},
        " in 120000 bytes",
        "; 42 centres are tried where there are 250000 bytes at least",
    ),
    "max_seconds": (
        {"max_seconds": 400.0},
        " in 400 s",
        "; 42 centres are tried where there are 250000 s at least",
    ),
    None: ({"max_bytes": 10**9, "max_seconds": 400.0}, "", ""),
}


@pytest.mark.parametrize("field", CUT)
def test_what_cut_a_trial_short_is_refused_where_nothing_tried_keeps_the_error(field):
    """The twin: where all centres were tried, it is the error."""
    model = stopped(field)
    more, inside, tail = CUT[field]
    seconds = more.get("max_seconds")
    budget = BakeBudget(max_error=0.2, **more)
    best = sqrt(left(12, 48) + 1e-5)
    refused = choose(model, budget, [], left=seconds, tolerance=1e-3).refused
    assert refused == (
        field or "max_error",
        f"an error of 20.00% cannot be met{inside}: at best {best:.2%} is predicted to be left of "
        "a, and the largest part of it is what directions and functions leave: more than 12 "
        f"centres and 6 x 48^2 directions are not tried{tail}",
    )


@pytest.mark.parametrize("field", ["max_bytes", "max_seconds"])
def test_what_cut_a_trial_short_is_refused_after_a_bake_that_errs_by_more(field):
    model = stopped(field)
    more, inside, tail = CUT[field]
    seconds = more.get("max_seconds")
    budget = BakeBudget(max_error=0.35, **more)
    first = choose(model, budget, [], left=seconds, tolerance=1e-3).numbers
    told = [with_errors(made(model, first), 0.16)]
    refused, why = choose(model, budget, told, left=seconds, tolerance=1e-3).refused
    assert refused == field
    assert f"an error of 35.00% cannot be met{inside}: at best " in why
    assert why.endswith(tail)


@pytest.mark.parametrize("lost", [0.02, 0.06])
def test_what_cut_a_trial_short_does_not_bind_where_terms_alone_leave_too_much(lost):
    """More centres would not help: of 0.2 squared terms leave a half, or more than all."""
    budget = BakeBudget(max_error=0.2, max_bytes=120_000)
    model = stopped("max_bytes", lost=lost)
    field, why = choose(model, budget, [], left=None, tolerance=1e-3).refused
    assert field == ("max_bytes" if lost < 0.04 else "max_error")
    assert ("42 centres" in why) == (lost < 0.04)


@pytest.mark.parametrize(
    ("more", "left"), [({}, None), ({"max_seconds": 1000.0}, 990.0), ({"max_bytes": 10**9}, None)]
)
def test_a_bake_that_errs_by_more_than_any_trial_is_off_is_refused_by_the_error(more, left):
    """Nothing but the bake that was made is there to choose, and predictions are held to ten."""
    model, budget = one_row(), BakeBudget(max_error=0.12, **more)
    first = choose(model, budget, [], left=left, tolerance=1e-3).numbers
    told = [with_errors(made(model, first), 2e-2)]
    choice = choose(model, budget, told, left=left, tolerance=1e-3)
    assert choice.numbers is None
    field, why = choice.refused
    assert field == "max_error"
    assert f"at best {sqrt(2e-2):.2%} was left of a, and" in why


def test_bytes_that_a_bake_of_the_error_exceeds_are_refused_with_what_it_takes():
    """The one row there is keeps the error, and takes a tenth more than is predicted."""
    model = one_row()
    size = int(model.foreseen(None, 0.0).sizes[0])
    budget = BakeBudget(max_error=0.12, max_bytes=round(1.05 * size))
    told, choice = searched(model, budget, size_off=1.1)
    assert len(told) == 1
    assert told[0].error < 0.12
    field, why = choice.refused
    assert field == "max_bytes"
    assert f"found to be {ceil(told[0].size / LATER_SIZE)}, by the one that was made" in why


def least_of(choice):
    """Read the bytes that a refusal names."""
    field, why = choice.refused
    assert field == "max_bytes"
    return int(re.search(r"least that can be asked for.* to be (\d+)", why)[1])


@pytest.mark.parametrize("seconds", [None, 1000.0])
def test_bytes_that_are_named_after_all_bakes_are_more_than_were_asked_for(seconds):
    """The first keeps the error in too many bytes; 42 centres, which fit, are not made any more."""
    model = model_of(glossy=False)
    rows = [model.choices.index(one) for one in ((642, 48, 0), (12, 12, 0), (12, 24, 0))]
    told = [with_errors(made(model, model.numbers(row, 4e-3)), 0.1**2) for row in rows]
    told = [told[0], *(with_errors(one, 0.5**2) for one in told[1:])]
    told.append(of_twelve_centres(model, 0.201)[-1])
    seen = model.foreseen(told[-1], 4e-3)
    size = seen.sizes[model.choices.index((42, 24, 0))]
    budget = BakeBudget(max_error=0.2, max_bytes=round(1.1 * size), max_seconds=seconds)
    assert seen.errors[model.choices.index((42, 24, 0))] <= 0.04
    choice = choose(model, budget, told, left=seconds, tolerance=1e-3)
    assert least_of(choice) > budget.max_bytes


@settings(deadline=None, max_examples=60)
@given(
    share=st.floats(0.5, 1.2), size_off=st.floats(0.9, 1.1), max_error=st.sampled_from((None, 0.2))
)
@example(share=0.99, size_off=1.0, max_error=None)
@example(share=0.9974, size_off=1.0, max_error=None)
@example(share=0.5, size_off=1.0625, max_error=None)
@example(share=0.5, size_off=0.90625, max_error=0.2)
def test_bytes_that_a_refusal_names_can_be_asked_for(share, size_off, max_error):
    """At once where a bake was measured, or takes no more than predicted; else after one that is."""
    model = UNTIMED
    seen = model.foreseen(None, 0.0)
    keeps = seen.errors <= (AIM * (max_error or np.inf)) ** 2
    asked, sure = round(share * size_off * seen.sizes[keeps].min()), False
    while True:
        budget = BakeBudget(max_bytes=asked, max_error=max_error)
        told, choice = searched(model, budget, size_off=size_off)
        if choice.refused is None:
            break
        assert not sure
        named = least_of(choice)
        assert named > asked
        asked, sure = named, bool(told) or size_off <= 1.0
    assert told[delivered(model, budget, told)].size <= asked


def test_a_better_bake_in_sight_that_has_no_time_is_refused_by_the_time():
    """The twin: what is left to make would keep the error, and takes longer than there is."""
    model, budget = model_of(), BakeBudget(max_error=0.2, max_seconds=100.0)
    first = choose(model, budget, [], left=90.0, tolerance=1e-3).numbers
    told = [made(model, first, off=1.5)]
    field, why = choose(model, budget, told, left=1.2, tolerance=1e-3).refused
    assert field == "max_seconds"
    seen = model.foreseen(told[0], first.bounce_tolerance)
    within = seen.errors <= 0.04
    within[model.row(first)] = False
    least = MARGIN * float(np.where(within, seen.seconds, np.inf).min())
    assert least > 1.2
    assert f"take {int(np.ceil(least))} s" in why
