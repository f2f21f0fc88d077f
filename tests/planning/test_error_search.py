"""The decisions of a search for an error, held against worlds whose errors are known."""

from math import inf, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.planning.error_search import (
    EASY,
    HARD,
    LARGEST_ERROR,
    MOST_COMPRESSIONS,
    SHARES,
    WINDOW,
    best_compression,
    binding_line,
    choose_bake,
    choose_light,
    mended_compression,
    next_compression,
    pool,
    pooled_lines,
    predicted_errors,
    share_to_aim_at,
)

COARSE = BakeSettings(cube_resolution=16, n_centres=162, term_energy_lost=0.04)
FINE = BakeSettings(cube_resolution=32, supersample=2, n_centres=642, term_energy_lost=0.01)
LINES = {
    "K terms": 0.02, "BRDF tables": 0.001, "vertex interpolation": 0.03,
    "visibility sampling": 0.02, "SRBF basis": 0.04, "16-bit transfer": 0.0001, "light fit": 0.5,
}  # fmt: skip


def seen(error, norm=1.0, variance=0.0, picture="asset"):
    """A view whose picture errs by so much, relative, with the noise of the reference on top."""
    squared = {picture: error**2 * norm + variance}
    return {"squared_norm": norm, "variance": variance, "squared": squared, "lines": {"a": error}}


def test_an_error_is_pooled_over_norms_and_counts_half_of_the_noise():
    views = [seen(0.1, norm=1.0), seen(0.3, norm=3.0)]
    whole = pool(views, "asset")
    assert whole.error == pytest.approx(sqrt((0.01 + 3 * 0.09) / 4))
    assert pooled_lines(views)["a"] == pytest.approx(whole.error)
    # weights 1 and 3: mean 0.25, deviation sqrt((0.15^2 + 3 * 0.05^2) / 4)
    assert whole.spread == pytest.approx(sqrt((0.15**2 + 3 * 0.05**2) / 4) / 0.25)
    noisy = pool([seen(0.1, variance=0.01)], "asset")
    assert noisy.error == pytest.approx(sqrt(0.01 + 0.005))
    assert noisy.noise == pytest.approx(0.1)


def test_views_lost_in_noise_count_for_nothing():
    dark = seen(0.5, norm=0.1, variance=0.2)
    assert pool([seen(0.1), dark], "asset").error == pytest.approx(0.1)
    assert pool([dark], "asset").error == inf


@given(st.floats(0.0, 10.0), st.floats(0.0, 10.0))
def test_more_spread_aims_no_higher(one, other):
    low, high = sorted((one, other))
    assert SHARES[0] <= share_to_aim_at(high) <= share_to_aim_at(low) <= SHARES[1]


def test_views_that_differ_much_waste_no_more_than_four_tenths_of_the_target():
    """At the window's lower end, and where held-out views err by a tenth less than tuning views."""
    assert 0.9 * WINDOW[0] * share_to_aim_at(inf) > 0.6


def test_lines_scale_as_their_settings_say_and_interpolation_stays():
    """162 to 642 functions, spacing of directions by 4, a quarter of the terms' energy."""
    own, other = predicted_errors(0.1, LINES, [COARSE, FINE])
    assert own == pytest.approx(0.1)
    before = sum(value**2 for name, value in LINES.items() if name != "light fit")
    # the same powers foretell the steps beside an asset: terms 0.4, directions 0.27, functions 0.4
    terms, visibility, basis = 4**-0.4, 16**-0.27, (162 / 642) ** 0.4
    after = (0.02 * terms) ** 2 + (0.02 * visibility) ** 2 + (0.04 * basis) ** 2
    after += 0.001**2 + 0.03**2 + 0.0001**2
    assert other == pytest.approx(0.1 * sqrt(after / before))
    assert binding_line(LINES, [COARSE, FINE]) == "vertex interpolation"
    assert binding_line(LINES, [COARSE]) == "SRBF basis"


def test_the_lowest_step_that_leaves_room_is_taken():
    assert choose_bake([(0, 0.7 * EASY)], [0.7, 0.3], 0.7).what == "take"
    # it leaves none, the second is predicted to leave some, so the third is not looked at
    choice = choose_bake([(0, 0.7)], [0.7, 0.4, 0.1], 0.7)
    assert (choice.what, choice.step) == ("try", 1)
    # predictions are corrected by what the last step measured: 0.6 where 0.4 was predicted
    choice = choose_bake([(0, 0.7), (1, 0.6)], [0.7, 0.4, 0.3, 0.2], 0.6)
    assert (choice.what, choice.step) == ("try", 2)


def test_little_room_does_where_no_step_leaves_more():
    assert choose_bake([(0, 0.9)], [0.9, 0.87], 1.0).what == "take"
    assert choose_bake([(0, 0.99)], [0.99, 0.9], 1.0).step == 1


def test_what_no_step_meets_is_refused_with_the_best():
    choice = choose_bake([(0, 3.0)], [3.0, 2.0, 1.5], 1.0)
    assert (choice.what, choice.best) == ("refuse", 1.5)
    # a prediction close to the aim is tried before it is believed
    assert choose_bake([(0, 3.0)], [3.0, 2.0, 1.1], 1.0).what == "try"
    choice = choose_bake([(0, 3.0), (2, 1.1)], [3.0, 2.0, 1.1], 1.0)
    assert (choice.what, choice.best) == ("refuse", 1.1)


@given(st.lists(st.floats(1e-3, 1.0), min_size=1, max_size=5), st.floats(1e-3, 1.0))
def test_the_ladder_is_climbed_once_and_never_taken_too_early(true, aim):
    """Whatever was predicted: steps rise, the search ends, and what is taken leaves enough."""
    tried = [(0, true[0])]
    while True:
        choice = choose_bake(tried, [0.5] * len(true), aim)
        if choice.what != "try":
            break
        assert choice.step > tried[-1][0]
        tried.append((choice.step, true[choice.step]))
    if choice.what == "take":
        assert tried[-1][1] <= HARD * aim


def test_lights_rise_step_by_step_until_they_leave_room():
    assert choose_light([(0, 0.5)], 3, 0.4, 1.0).what == "take"
    assert choose_light([(0, 0.95)], 3, 0.4, 1.0).step == 1
    # transfer left little room: so may the light
    assert choose_light([(0, 0.95)], 3, 0.9, 1.0).what == "take"
    assert choose_light([(2, 0.95)], 3, 0.4, 1.0).what == "take"
    assert choose_light([(2, 0.99)], 3, 0.4, 1.0).what == "refuse"


def search(base, aim, share, power, refused_below=0.0):
    """Compress a world where pictures' squares grow by a power of what compression is asked."""
    tried = []
    while (asked := next_compression(tried, base, aim)) is not None:
        total = sqrt(base**2 + share * asked**power) if asked >= refused_below else None
        tried.append((asked, total))
        assert len(tried) <= MOST_COMPRESSIONS
    return tried


@given(
    base=st.floats(0.0, HARD), aim=st.floats(0.003, 0.5), share=st.floats(0.02, 5.0),
    power=st.floats(0.6, 1.6),
)  # fmt: skip
def test_compressions_end_and_none_above_the_aim_is_chosen(base, aim, share, power):
    tried = search(base * aim, aim, share, power)
    best = best_compression(tried, aim)
    if best is None:
        return
    chosen = tried[best][1]
    assert chosen <= WINDOW[1] * aim
    assert all(total <= chosen or total > WINDOW[1] * aim for _, total in tried)


@given(base=st.floats(0.0, 0.8), aim=st.floats(0.01, 0.3), share=st.floats(0.1, 1.0))
def test_plain_worlds_end_just_below_the_aim(base, aim, share):
    """Squares of pictures' errors in proportion, as they mostly are: it lands in the window."""
    tried = search(base * aim, aim, share, 1.0)
    best = best_compression(tried, aim)
    assert best is not None
    asked, total = tried[best]
    assert total >= WINDOW[0] * aim or asked == LARGEST_ERROR


def test_what_compression_refuses_is_asked_for_more_loosely():
    tried = search(0.05, 0.1, 0.2, 1.0, refused_below=0.03)
    assert tried[0][1] is None
    assert tried[1][0] > tried[0][0]
    best = best_compression(tried, 0.1)
    assert best is not None
    assert tried[best][0] >= 0.03


def test_a_world_that_refuses_everything_ends_with_nothing():
    tried = search(0.05, 0.1, 0.5, 1.0, refused_below=1.0)
    assert len(tried) == MOST_COMPRESSIONS
    assert best_compression(tried, 0.1) is None


def test_nothing_met_is_nothing_chosen():
    assert best_compression([(0.1, 0.5), (0.01, None)], 0.1) is None


def test_a_mended_compression_asks_for_less_and_tells_when_that_cannot_do():
    mended = mended_compression(0.04, tuned=0.09, base=0.05, held_out=0.12, target=0.1)
    assert mended is not None
    assert 0.0 < mended < 0.04
    # what it errs by before compression is more than the target already
    assert mended_compression(0.04, tuned=0.09, base=0.085, held_out=0.12, target=0.1) is None
