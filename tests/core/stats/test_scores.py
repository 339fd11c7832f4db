"""Scores against closed forms, and intervals and tests against what they promise on planted truths."""

from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from core.stats import scores
from core.stats.multiple_testing import adjust_differences, adjust_holm, list_pairs, select_dominating
from core.stats.scores import Estimate, average_over_repeats, combine_strata
from core.stats.splits import split_by_ride

ENERGIES = arrays(np.float64, st.integers(1, 60), elements=st.floats(-5.0, 50.0))


def repeated(values, seed, repeats=10):
    """Return the means of the test halves of the splits that the protocol draws."""
    return np.array([values[s.test].mean(axis=0) for s in split_by_ride([("a", 0)] * len(values), seed, repeats)])


def test_the_interval_over_repeats_is_that_of_the_corrected_variance():
    values = np.array([0.3, 0.5, 0.4, 0.6])
    found = average_over_repeats(values, 0.25)
    assert found.value == pytest.approx(0.45)
    assert found.error == pytest.approx(sqrt((1 / 4 + 0.25) * np.var(values, ddof=1)))
    assert found.ci95 == pytest.approx(stats.t.ppf(0.975, 3) * found.error)
    assert found.p == pytest.approx(2 * stats.t.sf(0.45 / found.error, 3))


def test_one_repeat_has_a_value_and_no_interval_and_none_has_neither():
    assert average_over_repeats(np.array([2.0]), 0.25).value == 2.0
    assert np.isnan(average_over_repeats(np.array([2.0, np.nan]), 0.25).ci95)
    assert np.isnan(average_over_repeats(np.array([np.nan]), 0.25).value)


def test_the_interval_of_the_error_holds_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(1)
    truth, hits, plain = sqrt(2 / np.pi), 0, 0
    for seed in range(300):
        found = average_over_repeats(repeated(np.abs(rng.normal(size=200)), seed), 0.25)
        hits += abs(found.value - truth) <= found.ci95
        plain += abs(found.value - truth) <= found.ci95 * sqrt(0.1 / 0.35)
    assert 0.92 <= hits / 300 <= 0.98
    assert plain / 300 < 0.85, "without the correction for overlap it would promise too much"


def test_the_post_stratified_interval_holds_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(2)
    sizes, centres, hits = (15, 60, 400), (1.0, 2.0, 5.0), 0
    for seed in range(300):
        strata = [rng.normal(c, c, size=n) for n, c in zip(sizes, centres, strict=True)]
        found = combine_strata([average_over_repeats(repeated(values, seed), 0.25) for values in strata])
        hits += abs(found.value - np.mean(centres)) <= found.ci95
    assert 0.91 <= hits / 300 <= 0.99


def test_independent_parts_combine_as_textbooks_have_it():
    parts = [Estimate(1.0, 0.3, 9), Estimate(4.0, 0.4, 4), Estimate(np.nan, np.nan, np.nan)]
    found = combine_strata(parts, [1.0, 3.0, 50.0])
    assert found.value == pytest.approx(0.25 * 1.0 + 0.75 * 4.0)
    a, b = (0.25 * 0.3) ** 2, (0.75 * 0.4) ** 2
    assert found.error == pytest.approx(sqrt(a + b))
    assert found.freedom == pytest.approx((a + b) ** 2 / (a**2 / 9 + b**2 / 4))
    assert combine_strata([parts[0]]) == pytest.approx(parts[0])
    assert np.isnan(combine_strata(parts[2:]).value)
    assert np.isnan(combine_strata([]).value)


def test_a_part_without_an_interval_leaves_none():
    found = combine_strata([Estimate(1.0, 0.3, 9), Estimate(2.0, np.nan, 0)])
    assert found.value == 1.5
    assert np.isnan(found.ci95)


def test_parts_without_any_spread_have_an_interval_of_zero():
    assert combine_strata([Estimate(1.0, 0.0, 9), Estimate(2.0, 0.0, 9)]).ci95 == 0.0


@given(ENERGIES, st.sampled_from([0.5, 0.9, 0.95, 0.99, 1.0]))
def test_the_buffer_is_the_least_that_is_enough(measured, share):
    predicted = np.full(len(measured), 3.0)
    found = scores.compute_buffer(measured, predicted, share)
    excess = measured - predicted
    assert np.mean(excess <= found) >= share - 1e-12
    assert np.mean(excess < found) < share


def test_bands_and_coverage_count_their_ends():
    measured = np.array([100.0, 100.0, 100.0, 100.0])
    predicted = np.array([105.0, 90.0, 115.0, 116.0])
    assert scores.compute_band_shares(measured, predicted) == {"5": 0.25, "10": 0.5, "15": 0.75}
    assert (
        scores.compute_coverage(measured, np.array([100.0, 99.0, 101.0, 0.0]), np.array([120.0, 100.0, 110.0, 99.0]))
        == 0.5
    )


@given(ENERGIES)
def test_the_square_error_is_bias_and_spread(measured):
    predicted = np.linspace(-1.0, 4.0, len(measured))
    error = predicted - measured
    square = scores.compute_bias(measured, predicted) ** 2 + np.var(error)
    assert scores.compute_rmse(measured, predicted) == pytest.approx(sqrt(square))
    assert abs(scores.compute_bias(measured, predicted)) <= scores.compute_mae(measured, predicted) + 1e-12
    assert scores.compute_mae(measured, predicted) <= scores.compute_rmse(measured, predicted) + 1e-12


def test_means_of_groups_leave_out_what_is_in_none():
    found = scores.compute_group_means(np.array([1.0, 3.0, 8.0, 100.0, 7.0]), np.array([0, 0, 2, 3, -1]), 3)
    np.testing.assert_array_equal(found, [2.0, np.nan, 8.0])


def test_bins_tell_the_sign_of_the_bias_and_the_share_of_the_consumption():
    measured, predicted = np.array([1.0, 3.0, 9.0]), np.array([2.0, 4.0, 9.0])
    found = scores.compute_bin_errors(measured, predicted, np.array([0, 0, -1]), ("short", "long"))
    assert found == [{"bin": "short", "n": 2, "bias": 1.0, "mae": 1.0, "relative": 0.5}]


@given(arrays(np.float64, st.integers(1, 20), elements=st.floats(0.0, 1.0)))
def test_adjusted_probabilities_keep_their_order_and_are_no_smaller(p):
    found = adjust_holm(p)
    assert np.all(found >= p)
    assert np.all(found <= np.minimum(p * len(p), 1.0) + 1e-12)
    order = np.argsort(p, kind="stable")
    assert np.all(np.diff(found[order]) >= 0.0)


def compared(error, seed):
    """Return what the difference score says of models whose absolute errors are the columns."""
    names = [f"m{i}" for i in range(error.shape[1])]
    means = repeated(error, seed)
    found = {
        (a, b): average_over_repeats(means[:, int(a[1])] - means[:, int(b[1])], 0.25) for a, b in list_pairs(names)
    }
    return select_dominating(dict(zip(names, means.mean(axis=0), strict=True)), found), adjust_differences(found)


def test_the_difference_score_finds_a_planted_better_model_and_says_who_shares_its_place():
    rng = np.random.default_rng(5)
    hard = rng.gamma(2.0, 0.2, size=(400, 1))  # what is hard about a ride is hard for all
    error = hard + np.abs(rng.normal(0.0, 0.05, size=(400, 4))) + np.array([0.1, 0.0, 0.03, 0.0])
    best, p = compared(error, seed=5)
    assert set(best) == {"m1", "m3"}
    assert p["m0", "m1"] < 0.001
    assert p["m1", "m3"] > 0.05


def test_among_equals_a_difference_is_found_no_more_often_than_it_says():
    rng = np.random.default_rng(6)
    false = 0
    for seed in range(300):
        hard = rng.gamma(2.0, 0.2, size=(150, 1))
        best, p = compared(hard + np.abs(rng.normal(0.0, 0.1, size=(150, 4))), seed)
        false += min(p.values()) < 0.05
        assert len(best) == 4 or min(p.values()) < 0.05
    assert false / 300 <= 0.05


def test_models_that_say_the_same_co_dominate():
    same = np.abs(np.random.default_rng(7).normal(size=(100, 1))) * np.ones((1, 3))
    best, p = compared(same, seed=7)
    assert best == ["m0", "m1", "m2"]
    assert set(p.values()) == {1.0}


def test_a_model_of_unknown_error_is_in_no_place():
    assert select_dominating({"a": np.nan, "b": 1.0}, {("a", "b"): scores.UNKNOWN}) == ["b"]
    assert select_dominating({}, {}) == []
