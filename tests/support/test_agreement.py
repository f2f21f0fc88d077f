"""Known differences between pictures come back as lines, sums and bounds."""

import numpy as np
import pytest

from prtbake_workers.validation.budget import ChainPicture
from support.agreement import Agreement, Explained, Picture

SIZE = (4, 5, 3)
STEP = 0.05


@pytest.fixture
def theirs(rng):
    """Brightness about 1, with noise of 1 % a part."""
    return Picture(1.0 + 0.01 * rng.standard_normal((8, *SIZE)))


def chain(theirs, *steps):
    """Our reference, that many steps off theirs and without noise, and pictures further off."""
    offsets = STEP * np.cumsum(steps)
    return [
        ChainPicture(f"step {i}", np.full((1, 20, 3), theirs.mean.mean() + offset))
        for i, offset in enumerate(offsets)
    ]


def test_steps_of_one_kind_add_up(theirs):
    found = Explained.of(theirs, chain(theirs, 0, 1, 2))
    # 20 x 3 values of 8 parts, 1 % of noise each
    expected = [0.0, STEP, 2 * STEP]
    assert [line.error for line in found.budget.lines] == pytest.approx(expected, abs=3e-3)
    assert found.budget.total == pytest.approx(3 * STEP, abs=3e-3)
    assert found.own.sum_of_lines == pytest.approx(3 * STEP, rel=0.01)
    assert found.slack == pytest.approx(0.01 / np.sqrt(8), rel=0.3)
    assert found.is_bound
    assert found.is_tight


def test_steps_that_cancel_explain_little(theirs):
    found = Explained.of(theirs, chain(theirs, 0, 2, -2, 0.4))
    assert found.is_bound
    assert not found.is_tight


def test_a_reference_that_is_off_is_no_line_of_our_own(theirs):
    found = Explained.of(theirs, chain(theirs, 4, 1))
    assert found.budget.lines[0].error == pytest.approx(4 * STEP, rel=0.05)
    assert found.is_bound
    assert found.budget.total > found.own.sum_of_lines + found.slack


def test_agreement_tells_noise_from_difference(theirs, rng):
    same = Picture(1.0 + 0.01 * rng.standard_normal((8, *SIZE)))
    off = Picture(same.parts + STEP)
    near, far = Agreement.between(same, theirs), Agreement.between(off, theirs)
    # variances of 60 values from 8 parts each
    assert near.rel_mse == pytest.approx(near.noise, rel=0.5)
    assert near.noise == pytest.approx(2e-4 / 8 / 1.01, rel=0.3)
    assert far.rel_mse == pytest.approx(STEP**2 / 1.01, rel=0.1)
    assert far.ratio == pytest.approx(1.0 + STEP, abs=4 * far.ratio_error)


def test_a_single_part_has_no_noise():
    assert not Picture(np.ones((1, *SIZE))).variance.any()
