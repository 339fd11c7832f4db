"""Test the gain on held-out days: chance gains nothing, and forbidden signs do not count."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.diagnose.gains import compute_correlation, compute_window_gains
from socast.core.stats.clustered import sum_over_clusters
from socast.core.stats.evidence import ClusterSums

EITHER = np.zeros(1, dtype=np.int64)


def days(count=40, each=15):
    return ClusterSums(np.repeat(np.arange(count), each))


class TestHeldOut:
    def test_gain_uses_coefficients_of_other_folds(self, rng):
        clusters = days(23, 7)
        residual, columns = rng.normal(size=161), rng.normal(size=(161, 3))
        sign = np.array([0, 1, -1])
        gains = compute_window_gains(residual, columns, sign, clusters, 5)
        fold = clusters.assign_folds(5)[clusters.code]
        expected = np.zeros((161, 3))
        for k in np.unique(fold):
            for at in range(3):
                here, rest = fold == k, fold != k
                fitted = np.linalg.lstsq(columns[rest][:, [at]], residual[rest], rcond=None)[0][0]
                fitted = 0.0 if sign[at] * fitted < 0.0 else fitted
                expected[here, at] = residual[here] ** 2 - (residual[here] - fitted * columns[here, at]) ** 2
        expected = clusters.sum_by_cluster(expected) / (residual @ residual)
        np.testing.assert_allclose(gains, expected, atol=1e-12)

    def test_chance_gains_nothing(self):
        gains = []
        for seed in range(100):
            rng, clusters = np.random.default_rng(seed), days()
            shared = rng.normal(size=(40, 21))[clusters.code]
            drawn = rng.normal(size=(600, 21)) + shared
            gains.append(
                compute_window_gains(drawn[:, 0], drawn[:, 1:], np.zeros(20, dtype=np.int64), clusters, 0).sum(axis=0)
            )
        assert np.mean(gains) < 0.0
        assert np.mean(np.array(gains) > 0.0) < 0.25
        assert np.max(gains) < 0.15

    def test_planted_effect_gains_its_share(self, rng):
        clusters = days(80, 25)
        column = rng.normal(size=(2000, 1))
        residual = 0.5 * column[:, 0] + rng.normal(size=2000)
        gain = sum_over_clusters(compute_window_gains(residual, column, EITHER, clusters, 0)[:, 0])
        assert gain.value == pytest.approx(0.25 / 1.25, abs=3.0 * gain.error)
        assert 0.0 < gain.error < 0.03

    def test_forbidden_sign_has_no_gain(self, rng):
        column = rng.normal(size=(600, 1))
        residual = column[:, 0] + 0.1 * rng.normal(size=600)
        right, wrong = (compute_window_gains(residual, column, np.array([sign]), days(), 0) for sign in (1, -1))
        np.testing.assert_array_equal(wrong, 0.0)
        np.testing.assert_array_equal(right, compute_window_gains(residual, column, EITHER, days(), 0))
        assert right.sum() > 0.9

    def test_candidate_on_one_day_has_no_held_out_gain(self, rng):
        clusters = days()
        column = np.where(clusters.code == 3, rng.normal(size=600), 0.0)[:, np.newaxis]
        np.testing.assert_array_equal(compute_window_gains(5.0 * column[:, 0], column, EITHER, clusters, 0), 0.0)


@given(st.integers(0, 2**32), st.floats(-10.0, 10.0).filter(lambda x: abs(x) > 1e-3))
def test_correlation_is_a_cosine(seed, scale):
    one, other = np.random.default_rng(seed).normal(size=(2, 30))
    correlation = compute_correlation(one, other)
    assert -1.0 <= correlation <= 1.0
    assert correlation == pytest.approx(compute_correlation(other, one))
    assert compute_correlation(scale * one, other) == pytest.approx(np.sign(scale) * correlation)
    assert compute_correlation(one, one) == pytest.approx(1.0)
    assert compute_correlation(one, np.zeros(30)) == 0.0
