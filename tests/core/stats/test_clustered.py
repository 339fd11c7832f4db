"""Clustered shares: Wilson's interval for single cases, wider for similar cases, with its stated coverage."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from core.stats.clustered import compute_clustered_share


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
