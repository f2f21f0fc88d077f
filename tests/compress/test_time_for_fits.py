"""Fits that have to end: between two rounds, never after a step that would not fit."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.cpca import METHODS, compress_cpca
from prtbake_workers.compress.cta import CtaRanks, compress_cta
from prtbake_workers.compress.cta_adaptive import with_own_ranks
from prtbake_workers.compress.cta_schedule import Schedule, Step
from prtbake_workers.compress.lbg import lbg
from prtbake_workers.compress.methods import Fit
from prtbake_workers.compress.to_error import Scaled, compress_to_error
from prtbake_workers.deadline import SLACK, Deadline, ends_by, time_for


class Clock:
    """Moves on as it is told."""

    def __init__(self):
        self.now = 5.0

    def __call__(self):
        return self.now


def test_a_step_is_taken_while_it_ends_in_time():
    clock = Clock()
    deadline = Deadline(10.0, clock)
    with ends_by(deadline):
        assert time_for(10.0 / SLACK - 1e-9)
        clock.now += 7.0
        assert deadline.spent == 7.0
        assert time_for(2.0)
        assert not deadline.hit
        assert not time_for(3.0)
        assert deadline.hit
    # outside of it there is no deadline, and inside of another one that one counts
    assert time_for(1e9)
    with ends_by(Deadline(0.0, clock)), ends_by(None):
        assert time_for(1e9)


@pytest.mark.parametrize("kind", METHODS)
def test_without_time_clusters_are_those_of_one_round(kind, diffuse):
    sizes = {"n_clusters": 5, "n_components": 3, "seed": 1}
    deadline = Deadline(0.0)
    with ends_by(deadline):
        found = compress_cpca(diffuse, **sizes, method=kind, max_iterations=20)
    assert deadline.hit
    once = compress_cpca(diffuse, **sizes, method="static", max_iterations=1)
    assert found.objective[-1] <= once.objective[-1] * (1.0 + 1e-9)
    free = compress_cpca(diffuse, **sizes, method=kind, max_iterations=20)
    assert len(found.objective) < len(free.objective)
    assert free.objective[-1] < found.objective[-1]


def test_without_time_tensors_are_those_of_one_step(glossy):
    with ends_by(Deadline(0.0)):
        found = compress_cta(glossy, 4, CtaRanks(4, 12, 8), seed=1)
    assert found.iterations == 1
    assert found.squared_error_ratio < 0.2


def test_without_time_tensors_keep_even_ranks(glossy):
    even = compress_cta(glossy, 4, CtaRanks(4, 12, 8), seed=1, max_iterations=2)
    deadline = Deadline(0.0)
    with ends_by(deadline):
        assert with_own_ranks(even, glossy) is even
    assert deadline.hit
    with ends_by(Deadline(600.0)):
        assert with_own_ranks(even, glossy).squared_error_ratio < even.squared_error_ratio


def test_a_deadline_that_is_not_hit_changes_nothing(glossy):
    deadline = Deadline(1e6)
    with ends_by(deadline):
        found = compress_cta(glossy, 4, CtaRanks(4, 12, 8), seed=1, max_iterations=4)
    plain = compress_cta(glossy, 4, CtaRanks(4, 12, 8), seed=1, max_iterations=4)
    assert not deadline.hit
    assert np.array_equal(found.dual_bases, plain.dual_bases)
    assert found.objective == plain.objective


def test_an_error_that_time_does_not_allow_is_refused_with_the_best(glossy):
    fit = Fit(seed=1, max_iterations=4)
    sizes = Scaled(4, (2, 3, 2), 4)
    with (
        ends_by(Deadline(0.0)),
        pytest.raises(SettingsError, match=r"max_seconds ended .* of cta leaves") as caught,
    ):
        compress_to_error("cta", glossy, sizes, fit, 0.001)
    assert caught.value.pointer == "/max_seconds"


def test_a_first_trial_that_meets_the_error_is_taken_without_more_time(glossy):
    sizes = Scaled(4, (6, 40, 40), 4)
    with ends_by(Deadline(0.0)):
        found = compress_to_error("cta", glossy, sizes, Fit(seed=1, max_iterations=4), 0.1)
    assert 0.09 < found.model.squared_error_ratio <= 0.1


@pytest.mark.parametrize(("last", "cut"), [(0.9, False), (0.5, True)])
def test_a_fit_that_is_at_its_end_is_not_cut(last, cut):
    """The second step wins nothing and is the last anyway, or enough for another."""
    schedule, deadline = Schedule(1.0, max_iterations=1), Deadline(1e6)
    with ends_by(deadline):
        schedule.modelled([0.9])
        schedule.seen()
        assert not deadline.hit
        deadline.kept = 1e9
        schedule.modelled([last])
    assert schedule.step is Step.END
    assert deadline.hit == cut


def test_the_last_iteration_of_a_clustering_cuts_nothing(diffuse):
    signal, ones = diffuse.reshape(len(diffuse), -1), np.ones(len(diffuse))
    for most, cut in ((1, False), (2, True)):
        deadline = Deadline(0.0)
        with ends_by(deadline):
            found = lbg(signal, 5, rng=np.random.default_rng(1), weights=ones, max_iterations=most)
        assert len(found.objective) == 1
        assert deadline.hit == cut
