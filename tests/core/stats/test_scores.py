"""Scores agree with closed forms; intervals and tests keep their stated rates on planted truths."""

from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from socast.core.stats import scores
from socast.core.stats.scores import Estimate, average_over_repeats, combine_strata, compute_widening
from tests.support.repeated_splits import repeated

ENERGIES = arrays(np.float64, st.integers(1, 60), elements=st.floats(-5.0, 50.0))


def test_interval_over_repeats_uses_corrected_variance():
    values = np.array([0.3, 0.5, 0.4, 0.6])
    estimate = average_over_repeats(values, 0.25)
    assert estimate.value == pytest.approx(0.45)
    assert estimate.error == pytest.approx(sqrt((1 / 4 + 0.25) * np.var(values, ddof=1)))
    assert estimate.ci95 == pytest.approx(stats.t.ppf(0.975, 3) * estimate.error)
    assert estimate.p == pytest.approx(2 * stats.t.sf(0.45 / estimate.error, 3))


def test_widening_is_the_ratio_of_the_widths_of_intervals():
    few, many = (average_over_repeats(np.tile([0.0, 1.0], n), 0.25) for n in (2, 50_000))
    spread = np.sqrt(np.var([0, 1, 0, 1], ddof=1) / np.var(np.tile([0.0, 1.0], 50_000), ddof=1))
    assert compute_widening(4, 0.25) == pytest.approx(few.ci95 / many.ci95 / spread, rel=1e-3)


def test_one_repeat_gives_value_without_interval_and_none_gives_neither():
    assert average_over_repeats(np.array([2.0]), 0.25).value == 2.0
    assert np.isnan(average_over_repeats(np.array([2.0, np.nan]), 0.25).ci95)
    assert np.isnan(average_over_repeats(np.array([np.nan]), 0.25).value)


def test_interval_over_repeats_covers_truth_at_stated_rate():
    rng = np.random.default_rng(1)
    truth, hits, plain = sqrt(2 / np.pi), 0, 0
    for seed in range(300):
        estimate = average_over_repeats(repeated(np.abs(rng.normal(size=200)), seed), 0.25)
        hits += abs(estimate.value - truth) <= estimate.ci95
        plain += abs(estimate.value - truth) <= estimate.ci95 * sqrt(0.1 / 0.35)
    assert 0.92 <= hits / 300 <= 0.98
    assert plain / 300 < 0.85, "without the correction for overlap the interval is too narrow"


def test_post_stratified_interval_covers_truth_at_stated_rate():
    rng = np.random.default_rng(2)
    sizes, centres, hits = (15, 60, 400), (1.0, 2.0, 5.0), 0
    for seed in range(300):
        strata = [rng.normal(c, c, size=n) for n, c in zip(sizes, centres, strict=True)]
        estimate = combine_strata([average_over_repeats(repeated(values, seed), 0.25) for values in strata])
        hits += abs(estimate.value - np.mean(centres)) <= estimate.ci95
    assert 0.91 <= hits / 300 <= 0.99


def test_independent_parts_combine_by_textbook_formula():
    parts = [Estimate(1.0, 0.3, 9), Estimate(4.0, 0.4, 4), Estimate(np.nan, np.nan, np.nan)]
    combined = combine_strata(parts, [1.0, 3.0, 50.0])
    assert combined.value == pytest.approx(0.25 * 1.0 + 0.75 * 4.0)
    a, b = (0.25 * 0.3) ** 2, (0.75 * 0.4) ** 2
    assert combined.error == pytest.approx(sqrt(a + b))
    assert combined.freedom == pytest.approx((a + b) ** 2 / (a**2 / 9 + b**2 / 4))
    assert combine_strata([parts[0]]) == pytest.approx(parts[0])
    assert np.isnan(combine_strata(parts[2:]).value)
    assert np.isnan(combine_strata([]).value)


def test_part_without_interval_leaves_combination_without_interval():
    combined = combine_strata([Estimate(1.0, 0.3, 9), Estimate(2.0, np.nan, 0)])
    assert combined.value == 1.5
    assert np.isnan(combined.ci95)


def test_parts_without_spread_combine_to_interval_of_zero():
    assert combine_strata([Estimate(1.0, 0.0, 9), Estimate(2.0, 0.0, 9)]).ci95 == 0.0


@given(ENERGIES, st.sampled_from([0.5, 0.9, 0.95, 0.99, 1.0]))
def test_buffer_is_least_sufficient_reserve(measured, share):
    predicted = np.full(len(measured), 3.0)
    buffer = scores.compute_buffer(measured, predicted, share)
    excess = measured - predicted
    assert np.mean(excess <= buffer) >= share - 1e-12
    assert np.mean(excess < buffer) < share


def test_bands_and_coverage_include_their_ends():
    measured = np.array([100.0, 100.0, 100.0, 100.0])
    predicted = np.array([105.0, 90.0, 115.0, 116.0])
    assert scores.compute_band_shares(measured, predicted) == {"5": 0.25, "10": 0.5, "15": 0.75}
    assert (
        scores.compute_coverage(measured, np.array([100.0, 99.0, 101.0, 0.0]), np.array([120.0, 100.0, 110.0, 99.0]))
        == 0.5
    )


@given(ENERGIES)
def test_mean_square_error_is_squared_bias_plus_variance(measured):
    predicted = np.linspace(-1.0, 4.0, len(measured))
    error = predicted - measured
    square = scores.compute_bias(measured, predicted) ** 2 + np.var(error)
    assert scores.compute_rmse(measured, predicted) == pytest.approx(sqrt(square))
    assert abs(scores.compute_bias(measured, predicted)) <= scores.compute_mae(measured, predicted) + 1e-12
    assert scores.compute_mae(measured, predicted) <= scores.compute_rmse(measured, predicted) + 1e-12


def test_percentage_errors_match_hand_computed_values():
    measured, predicted = np.array([2.0, 4.0, 0.05, -1.0]), np.array([1.0, 5.0, 0.15, -1.4])
    errors = scores.compute_relative_errors(measured, predicted, least=0.1)
    np.testing.assert_allclose(errors, [0.5, 0.25, np.nan, np.nan])
    assert scores.compute_mape(measured, predicted, least=0.1) == pytest.approx(0.375)
    assert scores.compute_wmape(measured, predicted) == pytest.approx((1.0 + 1.0 + 0.1 + 0.4) / 5.05)


def test_percentage_errors_without_energy_are_unknown():
    nothing = np.zeros(0)
    assert np.isnan(scores.compute_mape(nothing, nothing, least=0.1))
    assert np.isnan(scores.compute_wmape(nothing, nothing))
    assert np.isnan(scores.compute_mape(np.array([0.05]), np.array([1.0]), least=0.1))
    assert np.isnan(scores.compute_wmape(np.array([-1.0]), np.array([1.0])))


@given(ENERGIES, st.floats(0.01, 100.0))
def test_percentage_errors_do_not_depend_on_unit(measured, unit):
    predicted = measured + 0.3
    assert scores.compute_wmape(unit * measured, unit * predicted) == pytest.approx(
        scores.compute_wmape(measured, predicted), nan_ok=True
    )
    assert scores.compute_mape(unit * measured, unit * predicted, unit * 0.5) == pytest.approx(
        scores.compute_mape(measured, predicted, 0.5), nan_ok=True
    )


def test_group_means_exclude_values_outside_groups():
    means = scores.compute_group_means(np.array([1.0, 3.0, 8.0, 100.0, 7.0]), np.array([0, 0, 2, 3, -1]), 3)
    np.testing.assert_array_equal(means, [2.0, np.nan, 8.0])


def test_bin_errors_report_signed_bias_and_relative_error():
    measured, predicted = np.array([1.0, 3.0, 9.0]), np.array([2.0, 4.0, 9.0])
    errors = scores.compute_bin_errors(measured, predicted, np.array([0, 0, -1]), ("short", "long"))
    assert errors == [{"bin": "short", "n": 2, "bias": 1.0, "mae": 1.0, "relative": 0.5}]
