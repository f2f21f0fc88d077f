"""The squared error against its definition, and its gradients against finite differences."""

import numpy as np
import pytest
from scipy.optimize import check_grad

from prtbake_workers.environment.environment import lat_long_directions, lat_long_solid_angles
from prtbake_workers.environment.fit.cells import Cells, cell_of
from prtbake_workers.environment.fit.objective import (
    RIDGE,
    Lobes,
    SquaredError,
    evaluate_lobes,
    residual,
    solve_over,
    squared_error,
)
from prtbake_workers.environment.fit.refine import _Chart


@pytest.fixture
def cells(rng) -> Cells:
    return Cells(lat_long_directions(12, 24), rng.random((288, 3)), lat_long_solid_angles(12, 24))


@pytest.fixture
def lobes(rng) -> Lobes:
    centres = rng.normal(size=(5, 3))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    return Lobes(centres, np.array([0.5, 2.0, 6.0, 10.0, 20.0]))


def test_the_error_is_eq_20_written_out(cells, lobes, rng) -> None:
    coefficients = rng.normal(size=(5, 3))
    total = 0.0
    for eta, f, w in zip(*cells, strict=True):
        fitted = sum(
            c * np.exp(lam * (eta @ xi - 1))
            for c, xi, lam in zip(coefficients, *lobes, strict=True)
        )
        total += w * ((f - fitted) ** 2).sum()
    objective = SquaredError(cells)
    assert objective.evaluate(lobes, coefficients)[0] == pytest.approx(total, rel=1e-12)
    assert squared_error(lobes, coefficients, cells) == pytest.approx(total, rel=1e-12)


def test_projected_coefficients_are_those_of_dense_least_squares(cells, lobes) -> None:
    root = np.sqrt(cells.solid_angles)[:, None]
    design = root * evaluate_lobes(lobes, cells.directions)
    # the ridge as rows of its own, one a lobe
    ridge = np.diag(np.sqrt(RIDGE * np.pi / lobes.bandwidths))
    rows = np.concatenate([design, ridge])
    target = np.concatenate([root * cells.radiance, np.zeros((5, 3))])
    expected, *_ = np.linalg.lstsq(rows, target, rcond=None)
    found = SquaredError(cells).project(lobes)
    assert found.coefficients == pytest.approx(expected, rel=1e-8)
    assert found.error == pytest.approx(((rows @ expected - target) ** 2).sum(), rel=1e-10)
    over = solve_over(lobes, cells)
    assert over == pytest.approx(expected, rel=1e-8)
    assert squared_error(lobes, over, cells) == pytest.approx(
        ((design @ expected - target[:-5]) ** 2).sum(), rel=1e-10
    )


def relative_gradient_error(value, gradient, x) -> float:
    """The norm of the difference between analytic and one-sided differences, over the gradient's."""
    return check_grad(value, gradient, x) / np.linalg.norm(gradient(x))


def test_gradients_by_coefficients_and_bandwidths(cells, lobes, rng) -> None:
    objective = SquaredError(cells)
    coefficients = rng.normal(size=(5, 3))

    def at_coefficients(x):
        return objective.evaluate(lobes, x.reshape(5, 3))

    def at_logs(x):
        return objective.evaluate(lobes._replace(bandwidths=np.exp(x)), coefficients)

    # one-sided differences with steps of 1.5e-8 are good to about 1e-7
    by_coefficients = relative_gradient_error(
        lambda x: at_coefficients(x)[0],
        lambda x: at_coefficients(x)[1].coefficients.ravel(),
        coefficients.ravel(),
    )
    assert by_coefficients < 1e-6
    logs = np.log(lobes.bandwidths)
    by_logs = relative_gradient_error(
        lambda x: at_logs(x)[0], lambda x: at_logs(x)[1].log_bandwidths, logs
    )
    assert by_logs < 1e-6


def test_gradients_of_the_projected_error_through_the_chart(cells, lobes, rng) -> None:
    objective, chart = SquaredError(cells), _Chart(lobes)
    start = rng.normal(size=10) * 0.3
    logs = np.log(lobes.bandwidths)

    def lobes_at(x):
        return Lobes(chart.centres(x[:10]), np.exp(x[10:]))

    def value(x):
        return objective.project(lobes_at(x)).error

    def gradient(x):
        g = objective.project(lobes_at(x)).gradient
        return np.concatenate([chart.pull_back(x[:10], g.centres), g.log_bandwidths])

    x = np.concatenate([start, logs])
    assert relative_gradient_error(value, gradient, x) < 1e-6

    def without_projection(x):
        g = objective.project(lobes_at(x)).gradient
        along = np.einsum("jai,ji->ja", chart._axes, g.centres).ravel()
        return np.concatenate([along, g.log_bandwidths])

    # the chart's own derivative is missing here: the check notices
    assert relative_gradient_error(value, without_projection, x) > 1e-3


def test_the_charts_origin_is_the_centre_and_steps_are_in_widths(lobes) -> None:
    chart = _Chart(lobes)
    assert chart.centres(np.zeros(10)) == pytest.approx(lobes.centres, abs=1e-15)
    moved = chart.centres(np.tile([1.0, 0.0], 5))
    angle = np.arccos((moved * lobes.centres).sum(axis=1))
    assert angle == pytest.approx(np.arctan(1 / np.sqrt(np.maximum(lobes.bandwidths, 1))), rel=1e-9)


def test_a_region_weight_buys_better_means_with_squared_error(cells, lobes) -> None:
    def region_error(coefficients):
        left = residual(lobes, coefficients, cells)
        region = cell_of(cells.directions, 16)
        sums = np.stack(
            [np.bincount(region, cells.solid_angles * left[:, c]) for c in range(3)], axis=1
        )
        areas = np.bincount(region, cells.solid_angles)
        return (sums[areas > 0] ** 2 / areas[areas > 0, None]).sum()

    plain, weighted = solve_over(lobes, cells), solve_over(lobes, cells, region_weight=100.0)
    assert region_error(weighted) < region_error(plain)
    assert squared_error(lobes, weighted, cells) > squared_error(lobes, plain, cells)
