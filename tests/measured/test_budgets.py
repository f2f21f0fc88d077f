"""The page of budgets: what it says holds, and what it says does not."""

import pytest

from measured.budgets import Kept, Met, page, statements

GOOD = [Met("a ball", 0.1, share, 1000, 5.0) for share in (0.061, 0.08, 0.099)]
IN_TIME = [Kept("a ball", 30.0, 32.9, "quality low"), Kept("a ball", 1.0, 3.0, "refused")]


def test_promises_that_are_kept_are_told_as_kept():
    assert all(holds for holds, _ in statements(GOOD, IN_TIME))
    text = page(GOOD, IN_TIME, "Measured here.")
    assert "does not hold" not in text
    assert "| a ball | 10 % | 6.1 % | 0.61 | 1 kB | 5 |" in text


@pytest.mark.parametrize(
    ("met", "kept", "broken"),
    [
        ([*GOOD, Met("a ball", 0.1, 0.1001, 1000, 5.0)], IN_TIME, 0),
        ([*GOOD[:2], Met("a ball", 0.1, 0.059, 1000, 5.0)], IN_TIME, 1),
        ([*GOOD[:2], Met("a ball", 0.1, None, 0, 5.0, "cannot be met")], IN_TIME, 1),
        (GOOD, [Kept("a ball", 30.0, 33.1, "quality low")], 2),
    ],
)
def test_the_promise_that_is_broken_is_told(met, kept, broken):
    failed = [index for index, (holds, _) in enumerate(statements(met, kept)) if not holds]
    assert failed == [broken]
    assert page(met, kept, "").count("does not hold") == 1
