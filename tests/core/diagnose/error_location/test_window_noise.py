"""Test the noise of windows: its correlation along a ride, and what follows for the sums of rides."""

import numpy as np
import pytest

from socast.core.diagnose.error_location.window_noise import LAGS, WindowNoise, estimate_correlation

RIDE = np.repeat(np.arange(1500), 15)


def make_noise(correlation=(-0.2, -0.05, 0.02)):
    weight = np.random.default_rng(1).uniform(0.5, 2.0, len(RIDE))
    return WindowNoise(weight, RIDE, np.array(correlation))


def draw_compensating(seed=2, share=0.3):
    """Return errors of which each window passes a part on to the next one of its ride."""
    rng = np.random.default_rng(seed)
    own, passed = rng.normal(0.0, 1.0, len(RIDE)), rng.normal(0.0, share, len(RIDE) + 1)
    passed[:-1][np.r_[True, np.diff(RIDE) != 0]] = 0.0
    return (own + passed[1:] - passed[:-1]) / np.sqrt(1.0 + 2.0 * share**2), -(share**2) / (1.0 + 2.0 * share**2)


def test_whitened_columns_have_the_inverse_covariance():
    noise = make_noise()
    n = 30
    part = WindowNoise(noise.weight[:n], RIDE[:n], noise.correlation)
    correlation = np.eye(n)
    for lag, value in enumerate(part.correlation, start=1):
        same = RIDE[lag:n] == RIDE[: n - lag]
        correlation += np.diag(value * same, lag) + np.diag(value * same, -lag)
    covariance = correlation / np.sqrt(np.outer(part.weight, part.weight))
    white = part.whiten(np.eye(n))
    np.testing.assert_allclose(white.T @ white, np.linalg.inv(covariance), atol=1e-9)
    by_ride = [covariance[:15, :15].sum(), covariance[15:, 15:].sum()]
    np.testing.assert_allclose(part.sum_ride_variances(2), by_ride)


@pytest.mark.parametrize("correlation", [(-0.2, -0.05, 0.02), (0.0, 0.0, 0.0)])
def test_conversion_to_energy_undoes_whitening(correlation):
    noise, values = make_noise(correlation), np.random.default_rng(3).normal(size=len(RIDE))
    np.testing.assert_allclose(noise.convert_to_energy(noise.whiten(values[:, np.newaxis])[:, 0]), values)


@pytest.mark.parametrize("of_ride", [0.0, 0.6])
def test_correlation_is_that_beyond_the_whole_ride(of_ride):
    errors, expected = draw_compensating()
    errors = errors + of_ride * np.random.default_rng(5).normal(size=RIDE.max() + 1)[RIDE]
    found = estimate_correlation(errors, RIDE)
    assert found[0] == pytest.approx(expected, abs=0.03)
    np.testing.assert_allclose(found[1:], 0.0, atol=0.03)


def test_impossible_correlation_is_reduced():
    alternating = np.tile([1.0, -1.0, 0.0], len(RIDE))[: len(RIDE)]
    found = estimate_correlation(alternating, RIDE)
    assert np.isfinite(WindowNoise(np.ones(len(RIDE)), RIDE, found).whiten(alternating[:, np.newaxis])).all()


def test_few_windows_have_no_correlation():
    assert not estimate_correlation(np.ones(12), np.repeat([0, 1, 2], 4)).any()
    assert len(estimate_correlation(np.ones(12), np.repeat([0, 1, 2], 4))) == LAGS
