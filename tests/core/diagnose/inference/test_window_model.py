"""The sums of the model of windows give what the whole covariance matrix of the windows gives."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from socast.core.diagnose.inference.window_model import DATES, HYPER, WIDEST, WindowModel
from tests.support.random_columns import build_covariance, draw_columns


@pytest.fixture(params=[1, 2], ids=["alone", "beside a known effect"])
def model(request):
    """Return a model with spreads and weights of its own."""
    rng = np.random.default_rng(request.param)
    first = WindowModel(draw_columns(request.param))
    first.log_spread = rng.normal(0.0, 0.5, DATES.stop)
    first.weight = rng.uniform(0.3, 1.0, len(first.weight))
    first.variance = rng.uniform(0.05, 0.2, len(first.variance))
    return first.add(first.columns.effects[:, : request.param - 1])


def test_small_fleet_has_random_effects_of_every_level(model):
    assert model.has_cars
    assert model.has_dates


def test_residual_is_that_of_the_best_linear_prediction(model):
    expected = model.variance / model.weight * np.linalg.solve(build_covariance(model), model.columns.residual)
    np.testing.assert_allclose(model.compute_residual(), expected, atol=1e-10)


def test_coefficients_and_their_covariance_are_those_of_generalised_least_squares(model):
    covariance, columns = build_covariance(model), model.columns
    fixed = np.column_stack([columns.base, columns.common, model.known])
    weighed = np.linalg.solve(covariance, fixed)
    k = fixed.shape[1]
    np.testing.assert_allclose(model.coefficients[:k], weighed.T @ columns.residual, atol=1e-10)
    np.testing.assert_allclose(model.covariance()[:k, :k], np.eye(k) - fixed.T @ weighed, atol=1e-10)


def test_log_density_is_that_of_a_gaussian_with_a_prior_of_the_spreads(model):
    def compute(of):
        whole = build_covariance(of)
        quadratic = of.columns.residual @ np.linalg.solve(whole, of.columns.residual)
        return -0.5 * (quadratic + np.linalg.slogdet(whole)[1] + np.sum((of.log_spread / HYPER) ** 2))

    other = copy(model)
    other.log_spread = np.zeros(DATES.stop)
    other.variance = 1.3 * model.variance
    other = other.add(other.known)
    assert model.log_density - other.log_density == pytest.approx(compute(model) - compute(other), abs=1e-8)


def test_gradient_is_the_slope_of_the_density(model):
    at = np.append(model.log_spread, 0.2)
    _, gradient = model._evaluate(at)
    step = 1e-5
    for place in range(len(at)):
        ends = [model._evaluate(at + sign * step * np.eye(len(at))[place])[0] for sign in (-1.0, 1.0)]
        assert gradient[place] == pytest.approx((ends[1] - ends[0]) / (2.0 * step), rel=1e-5, abs=1e-6)


def test_learning_raises_the_density_within_the_range_of_the_spreads(model):
    learned = model.relearn_spreads()
    assert learned.log_density > model.log_density
    assert (learned.log_spread >= WIDEST[0]).all()
    assert (learned.log_spread <= WIDEST[1]).all()


def test_windows_that_are_ignored_have_no_influence():
    columns = draw_columns(3)
    columns.ignored[:8] = True
    spoilt = replace(columns, residual=np.where(columns.ignored, 1e3, columns.residual))
    one, other = WindowModel(columns).relearn(), WindowModel(spoilt).relearn()
    np.testing.assert_allclose(other.coefficients, one.coefficients, atol=1e-9)
