"""The page of known differences, read back."""

from dataclasses import replace

import numpy as np
import pytest

from measured.mitsuba_pages import LINES, Measured, page
from prtbake_workers.validation.budget import ChainPicture
from prtbake_workers.validation.chain import BOUNCED_LINE, STORED_LINE
from prtbake_workers.validation.chain import LINES as CHAIN_LINES
from support.agreement import Agreement, Explained, Picture

NAMES = list(LINES)


def measured(label, step, rng):
    """Every line is ``step`` of what the first picture shows."""
    theirs = Picture(1.0 + 0.001 * rng.standard_normal((4, 3, 4, 3)))
    chain = [
        ChainPicture(name, np.full((1, 12, 3), 1.0 + step * (index + 1)))
        for index, name in enumerate(NAMES)
    ]
    return Measured(
        label, 162, 1536, 64, 1607, 607, 1, 12.0,
        Explained.of(theirs, chain[:-1]), Explained.of(theirs, chain),
    )  # fmt: skip


@pytest.fixture
def rows(rng):
    return [measured("coarse", 0.02, rng), measured("fine", 0.003, rng)]


def cells(text, label):
    """The cells of every row that begins with a label."""
    return [
        [cell.strip(" *\\") for cell in line.split("|")[2:-1]]
        for line in text.splitlines()
        if line.startswith(f"| {label} |")
    ]


TRACER = Agreement(4e-4, 3e-4, 2e-4, 1.0, 1e-3)


def test_lines_are_those_of_the_chain():
    known = [BOUNCED_LINE if name == STORED_LINE else name for name in CHAIN_LINES]
    assert known[: len(NAMES)] == NAMES


def test_figures_are_those_given(rows):
    text = page("A scene", "Compared so.", TRACER, rows)
    settings, budget, rel_mse = cells(text, "coarse")
    assert settings == ["162", "1,536", "1", "1,607", "607", "64", "12.0"]
    n = len(NAMES) - 1
    values = [float(cell.removesuffix(" %")) for cell in budget]
    # in per cent, 0.03 of them noise
    assert values[:n] == pytest.approx([2.0] * n, abs=0.1)
    assert values[n:] == pytest.approx([2.0 * n, 2.0 * n, 0.05], abs=0.1)
    squares = [float(cell) for cell in rel_mse]
    assert squares[:n] == pytest.approx([(0.02 * (k + 1)) ** 2 / 1.01 for k in range(n)], rel=0.05)
    assert squares[-1] == pytest.approx((0.02 * (n + 1)) ** 2 / 1.01, rel=0.05)


def test_what_holds_is_said(rows):
    text = page("A scene", "Compared so.", TRACER, rows)
    closest = rows[1].explained.agreements[-1].rel_mse
    assert f"relMSE {closest:.1e} at *fine*, the closest, is at most 1e-3: holds." in text
    assert "relMSE 4.0e-04, of it noise 3.0e-04, is at most 1e-3: holds." in text
    assert "in 2 of 2 settings: holds." in text
    # the negative twins
    noisy = page("A scene", "Compared so.", replace(TRACER, rel_mse=2e-3), rows[:1])
    assert "at *coarse*, the closest, is at most 1e-3: does not hold." in noisy
    assert "relMSE 2.0e-03, of it noise 3.0e-04, is at most 1e-3: does not hold." in noisy
    short = [replace(rows[0], explained=Unbound(rows[0].explained)), rows[1]]
    assert "in 1 of 2 settings: does not hold." in page("A scene", "Compared so.", TRACER, short)


class Unbound:
    """An explanation whose lines are too short."""

    is_bound = False

    def __init__(self, explained):
        self.explained = explained

    def __getattr__(self, name):
        return getattr(self.explained, name)
