"""Test that significance keeps its level where errors depend on each other within vehicle-days or dates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from socast.core.stats.evidence import (
    FOLDS,
    ClusterSums,
    Evidence,
    compute_evidence,
    compute_worst_case_evidence,
)

EITHER = np.zeros(1, dtype=np.int64)
LEVEL = 0.05


def days(count=40, each=20):
    return np.repeat(np.arange(count), each)


def null(code, rng, candidates=20):
    """Return a residual and unrelated candidates, both correlated within clusters."""
    n, count = len(code), int(code.max()) + 1
    residual = rng.normal(size=n) + rng.normal(size=count)[code]
    return residual, rng.normal(size=(n, candidates)) + 1.5 * rng.normal(size=(count, candidates))[code]


def plain_p(residual, candidates):
    """Return p-values of ordinary least squares, as if all rows were independent."""
    size = (candidates**2).sum(axis=0)
    coefficient = candidates.T @ residual / size
    left = residual[:, np.newaxis] - candidates * coefficient
    error = np.sqrt((left**2).sum(axis=0) / (len(residual) - 1) / size)
    return 2.0 * stats.norm.sf(np.abs(coefficient / error))


def share_below(level, draw, times):
    evidence = np.concatenate([draw(np.random.default_rng(seed)) for seed in range(times)])
    return float(np.mean(evidence < level))


@pytest.mark.parametrize("sign", [0, 1, -1])
@pytest.mark.parametrize("level", [0.05, 0.01])
def test_false_positive_rate_equals_level(sign, level):
    code = days()

    def draw(rng):
        residual, candidates = null(code, rng)
        return compute_evidence(residual, candidates, np.full(20, sign), ClusterSums(code)).p

    assert 0.6 * level < share_below(level, draw, 200) < 1.3 * level


def test_ordinary_least_squares_exceeds_level():
    code = days()
    assert share_below(LEVEL, lambda rng: plain_p(*null(code, rng)), 50) > 0.3


@pytest.mark.parametrize("acting", [2, 3, 4, 8])
def test_candidate_on_few_days_keeps_level(acting):
    code = days(30)

    def draw(rng):
        residual, candidates = null(code, rng)
        few = np.where((code < acting)[:, np.newaxis], 1.0 + 0.1 * candidates, 0.0)
        evidence = compute_evidence(residual, few, np.zeros(20, dtype=np.int64), ClusterSums(code))
        assert (evidence.freedom < acting).all()
        return evidence.p

    assert share_below(LEVEL, draw, 100) < 1.3 * LEVEL


def test_candidate_in_one_cluster_has_no_significance(rng):
    code = days(30)
    alone = np.where(code == 7, 1.0 + rng.random(len(code)), 0.0)[:, np.newaxis]
    evidence = compute_evidence(3.0 * alone[:, 0] + rng.normal(size=len(code)), alone, EITHER, ClusterSums(code))
    assert evidence.coefficient[0] == pytest.approx(3.0, abs=0.5)
    assert evidence.p[0] > 0.5


def test_errors_shared_by_all_cars_on_a_date_keep_level():
    """Clustering by vehicle-day alone would accept weather errors that all cars of a date share."""
    car, date = np.repeat(np.arange(6), 30 * 8), np.tile(np.repeat(np.arange(30), 8), 6)
    clusters = [ClusterSums(car * 30 + date), ClusterSums(date)]
    sign = np.zeros(10, dtype=np.int64)

    def draw(rng, which):
        weather = rng.normal(size=(30, 10))[date] + 0.3 * rng.normal(size=(len(car), 10))
        residual = rng.normal(size=len(car)) + rng.normal(size=30)[date]
        if which is not None:
            return compute_evidence(residual, weather, sign, clusters[which]).p
        both = compute_worst_case_evidence(residual, weather, sign, clusters)
        each = [compute_evidence(residual, weather, sign, one) for one in clusters]
        np.testing.assert_array_equal(both.p, np.maximum(each[0].p, each[1].p))
        half = [one.error * stats.t.ppf(0.975, one.freedom) for one in each]
        np.testing.assert_allclose(both.error * stats.t.ppf(0.975, both.freedom), np.maximum(*half))
        return both.p

    assert share_below(LEVEL, lambda rng: draw(rng, None), 60) < 1.3 * LEVEL
    assert share_below(LEVEL, lambda rng: draw(rng, 0), 60) > 3.0 * LEVEL


def test_coefficient_is_least_squares_and_interval_covers_at_its_level():
    code, true, held = days(), 0.3, []
    for seed in range(300):
        residual, candidates = null(code, np.random.default_rng(seed), 1)
        residual = residual + true * candidates[:, 0]
        evidence = compute_evidence(residual, candidates, EITHER, ClusterSums(code))
        expected = np.linalg.lstsq(candidates, residual, rcond=None)[0]
        np.testing.assert_allclose(evidence.coefficient, expected)
        low, high = evidence.get_estimate(0).interval
        held.append(low < true < high)
    assert 0.92 < np.mean(held) < 0.985


def test_planted_effect_is_significant_only_with_allowed_sign():
    code = days()
    residual, candidates = null(code, np.random.default_rng(1), 1)
    residual = residual + candidates[:, 0]
    right, wrong, either = (
        compute_evidence(residual, candidates, np.array([sign]), ClusterSums(code)).p[0] for sign in (1, -1, 0)
    )
    assert right < 1e-6
    assert wrong == pytest.approx(1.0 - right)
    assert either == pytest.approx(2.0 * right)


@pytest.mark.parametrize(("true", "sign"), [(0.2, 1), (-0.2, -1), (0.2, 0), (-0.2, 0)])
def test_effect_at_least_coefficient_keeps_level(true, sign):
    code, least = days(), np.full(20, 0.2)

    def draw(rng, size):
        residual, candidates = null(code, rng)
        evidence = [
            compute_evidence(residual + size * each[:, 0], each, np.array([sign]), ClusterSums(code), least[:1]).p
            for each in np.split(candidates, 20, axis=1)
        ]
        return np.concatenate(evidence)

    assert share_below(LEVEL, lambda rng: draw(rng, true), 50) < 1.4 * LEVEL
    assert share_below(LEVEL, lambda rng: draw(rng, 0.0), 20) < 0.2 * LEVEL
    assert share_below(LEVEL, lambda rng: draw(rng, 5.0 * true), 5) > 0.9


def test_zero_candidate_has_no_evidence():
    code = days(10)
    evidence = compute_evidence(
        np.random.default_rng(2).normal(size=200), np.zeros((200, 1)), EITHER, ClusterSums(code)
    )
    assert evidence.coefficient[0] == 0.0
    assert evidence.p[0] == pytest.approx(1.0)


@given(st.integers(0, 2**32), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_evidence_does_not_depend_on_units_or_row_order(seed, one, other):
    rng = np.random.default_rng(seed)
    code = days(12, 5)
    residual, candidates = null(code, rng, 3)
    sign = np.array([0, 1, -1])
    evidence = compute_evidence(residual, candidates, sign, ClusterSums(code))
    order = rng.permutation(len(code))
    moved = compute_evidence(one * residual[order], other * candidates[order], sign, ClusterSums(code[order]))
    np.testing.assert_allclose(moved.z, evidence.z, rtol=1e-8)
    np.testing.assert_allclose(moved.p, evidence.p, rtol=1e-8)
    np.testing.assert_allclose(moved.coefficient, evidence.coefficient * one / other, rtol=1e-8)
    assert isinstance(moved, Evidence)


class TestClusters:
    def test_cluster_sums_do_not_depend_on_row_order(self, rng):
        code = rng.permutation(np.r_[np.arange(9), rng.integers(0, 9, 60)])
        values = rng.normal(size=(69, 2))
        expected = [values[code == each].sum(axis=0) for each in range(9)]
        np.testing.assert_allclose(ClusterSums(code).sum_by_cluster(values), expected)
        np.testing.assert_allclose(ClusterSums(code).sum_by_cluster(values[:, 0]), np.array(expected)[:, 0])

    @pytest.mark.parametrize("count", [2, 7, 10, 11, 64])
    def test_folds_are_even_and_reproducible(self, count):
        clusters = ClusterSums(np.arange(count))
        dealt = np.bincount(clusters.assign_folds(3))
        assert len(dealt) == min(FOLDS, count)
        assert np.ptp(dealt) <= 1
        np.testing.assert_array_equal(clusters.assign_folds(3), ClusterSums(np.arange(count)).assign_folds(3))
        assert count < FOLDS or not np.array_equal(clusters.assign_folds(3), clusters.assign_folds(4))
