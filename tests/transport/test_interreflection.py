"""The series of bounces against a direct solve, and its bound against what is truly left."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array

from prtbake_storage.errors import SettingsError
from prtbake_workers.transport.interreflection import (
    COLUMNS_PER_PRODUCT,
    TAIL_SHARE,
    bounce_series,
    remainder_bound,
)

N = 12


def random_operator(rng, largest=0.8, n=N, density=0.5):
    """Rows that are not negative and sum to at most ``largest``."""
    dense = rng.random((n, n)) * (rng.random((n, n)) < density)
    sums = np.maximum(dense.sum(axis=1), 1e-12)
    dense *= (largest * rng.uniform(0.2, 1.0, n) / sums)[:, None]
    return csr_array(dense.astype(np.float32))


def random_direct(rng, n=N, n_coeffs=7):
    return rng.standard_normal((n, n_coeffs)).astype(np.float32)


def solved(matrix, direct):
    return np.linalg.solve(np.eye(len(direct)) - matrix.toarray().astype(np.float64), direct)


def squared(rows, areas):
    return float(areas @ (np.asarray(rows, np.float64) ** 2).sum(axis=1))


def test_the_series_solves_the_rendering_equation(rng):
    matrix, direct = random_operator(rng), random_direct(rng, n_coeffs=2 * COLUMNS_PER_PRODUCT + 3)
    series = bounce_series(direct, [matrix], areas=np.ones(N), tolerance=1e-13, max_bounces=200)
    expected = solved(matrix, direct)
    # float32 products of 12 entries and up to 60 sums
    np.testing.assert_allclose(series.transfer[0], expected, atol=2e-6 * np.abs(expected).max())
    assert series.report.converged
    assert series.report.messages == ()
    # the negative twin: one bounce is not the solution
    assert np.abs(direct + matrix @ direct - expected).max() > 1e-2


@pytest.mark.parametrize("n_bounces", [0, 1, 2, 5])
def test_each_bounce_adds_a_power(rng, n_bounces):
    matrix, direct = random_operator(rng), random_direct(rng)
    series = bounce_series(direct, [matrix], areas=np.ones(N), tolerance=0.0, max_bounces=n_bounces)
    dense, bounce = matrix.toarray().astype(np.float64), direct.astype(np.float64)
    total, added = bounce.copy(), []
    for _ in range(n_bounces):
        bounce = dense @ bounce
        total += bounce
        added.append((bounce**2).sum() / (total**2).sum())
    np.testing.assert_allclose(series.transfer[0], total, atol=1e-5)
    assert series.report.n_bounces == n_bounces
    assert series.report.added == pytest.approx(added, rel=1e-4)
    assert not series.report.converged
    assert "max_bounces" in series.report.messages[0]


def test_it_stops_at_the_first_bounce_below_the_tolerance(rng):
    matrix, direct = random_operator(rng), random_direct(rng)
    options = {"areas": rng.uniform(0.5, 2.0, N), "max_bounces": 100}
    report = bounce_series(direct, [matrix], tolerance=1e-6, **options).report
    assert report.added[-1] <= 1e-6 < min(report.added[:-1])
    assert report.n_bounces == len(report.added)
    looser = bounce_series(direct, [matrix], tolerance=report.added[1], **options).report
    assert looser.n_bounces == 2
    assert looser.added == report.added[:2]


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(0.05, 0.999),
    st.integers(0, 4),
    st.sampled_from([0.1, 0.5, 1.0]),
)
def test_the_bound_holds(seed, largest, n_bounces, density):
    """What is truly left, by solving the system, is never above the bound."""
    rng = np.random.default_rng(seed)
    matrix, direct = random_operator(rng, largest, density=density), random_direct(rng)
    areas = rng.uniform(0.1, 1.0, N)
    series = bounce_series(direct, [matrix], areas=areas, tolerance=0.0, max_bounces=n_bounces)
    if series.report.remainder is None:
        # nothing but an albedo within rounding of 1 may lack a bound
        assert largest > 0.99
        return
    dense, last = matrix.toarray().astype(np.float64), direct.astype(np.float64)
    for _ in range(series.report.n_bounces):
        last = dense @ last
    left = solved(matrix, last) - last
    bound = series.report.remainder * squared(series.transfer[0], areas)
    assert squared(left, areas) <= bound * (1 + 1e-5) + 1e-30
    rows = remainder_bound(matrix, np.linalg.norm(last, axis=1))
    assert (np.linalg.norm(left, axis=1) <= rows * (1 + 1e-5) + 1e-15).all()


def test_the_bound_is_tight_where_nothing_cancels(rng):
    """Of one positive coefficient the bound is the truth, up to its own tail and rounding.

    The negative twin: the next bounce alone is far below what is left.
    """
    matrix = random_operator(rng, 0.9)
    direct = rng.random((N, 1)).astype(np.float32)
    bound = remainder_bound(matrix, direct[:, 0].astype(np.float64))
    left = (solved(matrix, direct) - direct)[:, 0]
    # the tail is bounded by one number for all vertices: TAIL_SHARE of the largest
    np.testing.assert_allclose(bound, left, atol=1.01 * TAIL_SHARE * left.max())
    assert (matrix @ direct[:, 0] < 0.8 * left).all()


def test_a_single_number_is_the_geometric_series():
    """0.5 with albedo 0.5: after K bounces 0.5^(K+1) is left of 1."""
    matrix = csr_array(np.array([[0.5]], np.float32))
    series = bounce_series(
        np.array([[0.5]], np.float32), [matrix], areas=np.ones(1), tolerance=0.0, max_bounces=3
    )
    assert series.transfer[0, 0, 0] == 0.5 + 0.25 + 0.125 + 0.0625
    truth = (0.0625 / series.transfer[0, 0, 0]) ** 2
    assert series.report.remainder == pytest.approx(truth, rel=3e-3)
    assert series.report.remainder >= truth


def test_albedo_one_has_a_bound_where_light_can_get_out():
    """A chain of vertices that only the first one leaves: its row sums are 1 but one."""
    n = 6
    dense = np.zeros((n, n), np.float32)
    for i in range(n):
        dense[i, max(i - 1, 0)] += 0.5
        dense[i, min(i + 1, n - 1)] += 0.5
    dense[0, 0] = 0.0
    matrix, direct = csr_array(dense), np.eye(n, 1, dtype=np.float32)
    assert (dense.sum(axis=1)[1:] == 1.0).all()
    report = bounce_series(
        direct, [matrix], areas=np.ones(n), tolerance=1e-8, max_bounces=500
    ).report
    assert report.converged
    assert report.remainder is not None
    loose = bounce_series(direct, [matrix], areas=np.ones(n), tolerance=1e-2, max_bounces=1)
    left = solved(matrix, direct) - loose.transfer[0]
    truth = squared(left, np.ones(n)) / squared(loose.transfer[0], np.ones(n))
    assert truth <= loose.report.remainder <= 1.05 * truth
    assert any("above the tolerance" in message for message in loose.report.messages)


def test_albedo_one_in_a_closed_space_has_no_bound():
    closed = csr_array(np.full((4, 4), 0.25, np.float32))
    direct = np.ones((4, 2), np.float32)
    series = bounce_series(direct, [closed], areas=np.ones(4), tolerance=1e-3, max_bounces=5)
    assert series.report.remainder is None
    assert not series.report.converged
    assert any("closed space" in message for message in series.report.messages)
    # albedo 0.99 there has one, and light that comes in nowhere needs none
    near = bounce_series(direct, [closed * 0.99], areas=np.ones(4), tolerance=1e-3, max_bounces=5)
    assert near.report.remainder == pytest.approx((0.99**6 / (1 - 0.99**6)) ** 2, rel=1e-2)
    dark = bounce_series(0.0 * direct, [closed], areas=np.ones(4), tolerance=1e-3, max_bounces=5)
    assert dark.report.remainder == 0.0
    assert dark.report.messages == ()


def test_a_sealed_room_beside_the_lit_one_does_not_spoil_the_bound(rng):
    """Its operator has norm 1, but no light gets in."""
    lit = random_operator(rng, 0.7).toarray()
    both = np.zeros((N + 4, N + 4), np.float32)
    both[:N, :N] = lit
    both[N:, N:] = 0.25
    direct = np.zeros((N + 4, 3), np.float32)
    direct[:N] = random_direct(rng, n_coeffs=3)
    areas = np.ones(N + 4)
    options = {"tolerance": 1e-9, "max_bounces": 50}
    report = bounce_series(direct, [csr_array(both)], areas=areas, **options).report
    alone = bounce_series(direct[:N], [csr_array(lit)], areas=np.ones(N), **options).report
    assert report.remainder == pytest.approx(alone.remainder, rel=1e-4)
    assert report.converged


def test_channels_do_not_mix(rng):
    operators = [random_operator(rng, largest) for largest in (0.2, 0.5, 0.8)]
    direct = random_direct(rng)
    options = {"areas": np.ones(N), "tolerance": 0.0, "max_bounces": 3}
    together = bounce_series(direct, operators, **options)
    for channel, matrix in enumerate(operators):
        alone = bounce_series(direct, [matrix], **options)
        np.testing.assert_array_equal(together.transfer[channel], alone.transfer[0])
    assert together.report.n_bounces == 3


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1e6, 1e25])
def test_the_size_of_the_transfer_does_not_matter(rng, scale):
    matrix, direct = random_operator(rng), random_direct(rng)
    options = {"areas": np.ones(N), "tolerance": 1e-6, "max_bounces": 50}
    plain = bounce_series(direct, [matrix], **options).report
    # squares of float32 leave its range beyond 1e19 and below 1e-19
    if not 1e-18 < scale < 1e18:
        with np.errstate(over="ignore", under="ignore"):
            bound = remainder_bound(matrix, scale * np.linalg.norm(direct, axis=1).astype(float))
        assert bound == pytest.approx(
            scale * remainder_bound(matrix, np.linalg.norm(direct, axis=1).astype(float)), rel=1e-5
        )
        return
    report = bounce_series((scale * direct).astype(np.float32), [matrix], **options).report
    assert report.n_bounces == plain.n_bounces
    assert report.remainder == pytest.approx(plain.remainder, rel=1e-4)


def test_without_albedo_the_direct_transfer_comes_back(rng):
    direct = random_direct(rng)
    empty = csr_array((N, N), dtype=np.float32)
    series = bounce_series(direct, [empty] * 3, areas=np.ones(N), tolerance=1e-4, max_bounces=9)
    for channel in series.transfer:
        assert channel.tobytes() == direct.tobytes()
    assert (series.report.n_bounces, series.report.remainder) == (0, 0.0)
    assert series.report.converged


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"operators": []}, "one operator or three"),
        ({"operators": [csr_array((3, N), dtype=np.float32)]}, "channel 0 is 3 x 12"),
        ({"operators": [csr_array(-np.eye(N, dtype=np.float32))]}, "negative entry"),
        ({"tolerance": -1.0}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"max_bounces": -1}, "max_bounces"),
        ({"direct": np.full((N, 2), np.nan, np.float32)}, "coefficient 0 .* vertex 0"),
    ],
)
def test_what_is_refused(rng, change, message):
    arguments = {
        "direct": random_direct(rng),
        "operators": [random_operator(rng)],
        "areas": np.ones(N),
        "tolerance": 1e-4,
        "max_bounces": 3,
    } | change
    with pytest.raises(SettingsError, match=message):
        bounce_series(arguments.pop("direct"), arguments.pop("operators"), **arguments)
