"""Test the held-out gain against a loop over folds, and its interval by simulation."""

import numpy as np
import pytest

from socast.core.stats.evidence import cross_fit, measure_gain

FREE = (-np.inf, np.inf)


def test_coefficient_of_a_fold_is_that_of_least_squares_on_the_others():
    rng = np.random.default_rng(0)
    column, residual, fold = rng.normal(size=60), rng.normal(size=60), np.repeat(np.arange(6), 10)
    fitted = cross_fit(column, residual, fold, FREE)
    for k in range(6):
        rest = fold != k
        expected = np.linalg.lstsq(column[rest, np.newaxis], residual[rest], rcond=None)[0][0]
        assert fitted[fold == k] == pytest.approx(np.full(10, expected))


def test_coefficients_stay_within_limits():
    column, fold = np.ones(20), np.repeat(np.arange(4), 5)
    assert cross_fit(column, -3.0 * column, fold, (0.0, 2.0)).tolist() == [0.0] * 20
    assert cross_fit(column, 3.0 * column, fold, (0.0, 2.0)).tolist() == [2.0] * 20


def test_gain_is_the_share_of_the_squared_error_that_falls():
    before, after = np.array([3.0, 4.0, 0.0]), np.array([0.0, 4.0, 0.0])
    gain = measure_gain(before, after, np.array([0, 1, 2]))
    assert gain.value == pytest.approx(9.0 / 25.0)
    assert np.isnan(measure_gain(before, after, np.zeros(3, np.int64)).ci95)


@pytest.mark.parametrize("count", [6, 40])
def test_interval_holds_the_gain_of_many_days_in_95_percent_of_draws(count):
    rng, held = np.random.default_rng(count), []
    sizes = np.array([1.0, 1.0, 2.0])
    cluster = np.repeat(np.arange(count), 3)
    truth = 1.0 - 0.5**2  # each error is halved, but for noise
    for _ in range(400):
        before = rng.normal(size=(count, 3)) * sizes
        after = 0.5 * before + rng.normal(size=(count, 3)) * 0.2
        expected = truth - 0.04 * 3.0 / (sizes @ sizes)
        gain = measure_gain(before.ravel(), after.ravel(), cluster)
        held.append(abs(gain.value - expected) <= gain.ci95)
    assert np.mean(held) > 0.93
