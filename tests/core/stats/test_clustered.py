"""Test clustered means, ratios and shares: intervals cover, and single cases give the classical intervals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from socast.core.stats.clustered import (
    compute_clustered_mean,
    compute_clustered_ratio,
    compute_clustered_share,
    compute_fieller_interval,
    subtract,
    sum_over_clusters,
)
from socast.core.stats.scores import Estimate


@given(
    hits=st.lists(st.booleans(), min_size=2, max_size=60),
    seed=st.integers(0, 1000),
    clusters=st.integers(2, 60),
)
@settings(max_examples=100, deadline=None)
def test_clustered_share_lies_within_its_interval(hits, seed, clusters):
    of = np.random.default_rng(seed).integers(0, clusters, len(hits))
    share = compute_clustered_share(np.array(hits), of)
    assert share["value"] == np.mean(hits)
    if len(np.unique(of)) > 1:
        assert 0.0 <= share["low"] <= share["value"] <= share["high"] <= 1.0
    else:
        assert np.isnan(share["low"])


@pytest.mark.parametrize(("hits", "n"), [(0, 12), (7, 12), (12, 12), (270, 300)])
def test_single_cases_give_wilson_interval(hits, n):
    share = compute_clustered_share(np.arange(n) < hits, np.arange(n))
    assert share["clusters"] == n
    known = stats.binomtest(hits, n).proportion_ci(method="wilson")
    assert (share["low"], share["high"]) == pytest.approx((known.low, known.high))


def test_interval_covers_truth_where_cases_of_a_cluster_are_similar():
    rng = np.random.default_rng(5)
    clusters = np.repeat(np.arange(80), 5)
    inside = 0
    for _ in range(400):
        share = rng.beta(9.0, 1.0, 80)
        estimated = compute_clustered_share(rng.random(400) < share[clusters], clusters)
        inside += estimated["low"] <= 0.9 <= estimated["high"]
    assert 0.93 <= inside / 400 <= 0.995


def test_repeated_cases_add_no_information():
    hits = np.arange(40) < 30
    alone = compute_clustered_share(hits, np.arange(40))
    alike = compute_clustered_share(np.repeat(hits, 5), np.repeat(np.arange(40), 5))
    assert alike == pytest.approx(alone, rel=0.02)


seeds = st.integers(0, 2**32 - 1)


def test_interval_of_independent_rides_is_classical():
    values = np.random.default_rng(1).normal(2.0, 1.0, 50)
    result = compute_clustered_mean(values, np.arange(50))
    assert result.error == pytest.approx(values.std(ddof=1) / np.sqrt(50))
    assert result.freedom == pytest.approx(49)


@given(seeds)
def test_repeated_rides_within_cluster_do_not_change_interval(seed):
    rng = np.random.default_rng(seed)
    clusters = rng.integers(0, 6, 40)
    values = rng.normal(clusters, 1.0)
    once, thrice = (
        compute_clustered_mean(values, clusters),
        compute_clustered_mean(np.repeat(values, 3), np.repeat(clusters, 3)),
    )
    assert thrice == pytest.approx(once)


def test_clustered_interval_covers_true_value_where_plain_interval_does_not():
    rng = np.random.default_rng(5)
    held, plain, draws = 0, 0, 600
    for _ in range(draws):
        clusters = np.repeat(np.arange(12), rng.integers(2, 40, 12))
        values = rng.normal(0.0, 0.1, 12)[clusters] + rng.normal(0.0, 0.2, len(clusters))
        result = compute_clustered_mean(values, clusters)
        held += abs(result.value) <= result.ci95
        plain += abs(result.value) <= 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    assert 0.91 < held / draws < 0.98
    assert plain / draws < 0.7


def test_standard_error_is_unbiased_for_unequal_clusters():
    rng = np.random.default_rng(6)
    clusters = np.repeat(np.arange(4), [1, 3, 8, 20])
    squares = [compute_clustered_mean(rng.normal(0.0, 1.0, 32), clusters).error ** 2 for _ in range(4000)]
    assert np.mean(squares) == pytest.approx(1.0 / 32.0, rel=0.08)


def test_one_cluster_has_no_interval():
    assert np.isnan(compute_clustered_mean(np.ones(5), np.zeros(5, np.int64)).ci95)


@given(seeds)
def test_ratio_is_ratio_of_sums_and_scales_with_unit(seed):
    rng = np.random.default_rng(seed)
    above, below, clusters = rng.gamma(2.0, 1.0, 30), rng.gamma(2.0, 5.0, 30), rng.integers(0, 5, 30)
    result, scaled = (
        compute_clustered_ratio(above, below, clusters),
        compute_clustered_ratio(100.0 * above, below, clusters),
    )
    assert result.value == pytest.approx(above.sum() / below.sum())
    assert (scaled.value, scaled.ci95) == pytest.approx((100.0 * result.value, 100.0 * result.ci95))
    assert compute_clustered_ratio(3.0 * below, below, clusters).error == pytest.approx(0.0, abs=1e-12)


def test_difference_has_larger_error_than_either_estimate():
    one, other = Estimate(3.0, 0.3, 10.0), Estimate(1.0, 0.4, 20.0)
    apart = subtract(one, other)
    assert (apart.value, apart.error) == (2.0, 0.5)
    assert 10.0 <= apart.freedom <= 30.0
    assert subtract(other, one).value == -2.0


def test_fieller_interval_covers_a_ratio_whose_denominator_is_uncertain():
    """The interval by linearisation covers too rarely where the denominator is as uncertain as here."""
    rng, inside, known, clusters = np.random.default_rng(8), 0, 0, np.repeat(np.arange(40), 3)
    for _ in range(500):
        below = 1.0 + np.repeat(rng.normal(0.0, 1.8, 40), 3)
        above = 0.5 * below + np.repeat(rng.normal(0.0, 0.5, 40), 3)
        value, low, high = compute_fieller_interval(above, below, clusters)
        known += np.isfinite(value)
        inside += low <= 0.5 <= high
    assert known > 400
    assert 0.93 < inside / known < 0.98


def test_ratio_to_what_may_be_zero_is_unknown():
    noise = np.random.default_rng(1).normal(0.0, 1.0, 60)
    assert np.isnan(compute_fieller_interval(np.ones(60), noise - noise.mean(), np.arange(60))).all()
    assert np.isnan(compute_fieller_interval(np.ones(3), np.ones(3), np.zeros(3, dtype=np.int64))).all()


def test_standard_error_of_sum_matches_scatter():
    rng = np.random.default_rng(9)
    drawn = rng.exponential(size=(3000, 25))
    sums, errors, _ = np.array([sum_over_clusters(each) for each in drawn]).T
    np.testing.assert_allclose(sums, drawn.sum(axis=1))
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(np.std(sums), rel=0.05)
