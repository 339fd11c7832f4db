"""Every statistic equals scipy, scikit-learn, numpy, pandas or a computation by brute force on drawn data."""

import inspect
import pkgutil
from importlib import import_module

import numpy as np
import pandas as pd
import pytest
from scipy import optimize, stats
from sklearn import metrics

import socast.core.stats
from socast.core.stats import (
    bin_means,
    clustered,
    conformal,
    evidence,
    multiple_testing,
    random_effects,
    scores,
)
from socast.core.stats.scores import Estimate

ALONE = np.arange(40)
"""Clusters of one case each."""


def classical(values):
    """Return the mean with the ends of its interval by Student's t."""
    return np.mean(values), *stats.ttest_1samp(values, 0.0).confidence_interval()


def state(estimate):
    return estimate.value, *estimate.interval


def mean_of(values):
    return clustered.compute_clustered_mean(values, np.arange(len(values)))


def half_widths(rng):
    error, freedom = rng.gamma(2.0, 1.0, 40), rng.uniform(0.5, 60.0, 40)
    return scores.compute_half_widths(error, freedom, 0.9), stats.t.interval(0.9, freedom, 0.0, error)[1]


def estimate_ends_and_probability(rng):
    estimate = Estimate(rng.normal(), rng.gamma(2.0), rng.uniform(1.0, 30.0))
    of_t = stats.t(estimate.freedom, estimate.value, estimate.error)
    ours = *estimate.interval, estimate.upper95, estimate.p
    return ours, (*of_t.interval(0.95), of_t.ppf(0.95), 2.0 * min(of_t.cdf(0.0), of_t.sf(0.0)))


def clustered_mean_of_regression(rng):
    values, cluster = rng.normal(size=40), np.sort(rng.integers(0, 9, 40))
    left = values - values.mean()
    whole, adjusted, freedoms = np.eye(40) - 1.0 / 40, [], []
    for code in np.unique(cluster):  # Bell and McCaffrey: the root of (I - H)^-1 within each cluster
        at = np.flatnonzero(cluster == code)
        lengths, axes = np.linalg.eigh(whole[np.ix_(at, at)])
        each = (axes / np.sqrt(lengths) @ axes.T).sum(axis=0) / 40
        adjusted.append(float(each @ left[at]) ** 2)
        freedoms.append(whole[:, at] @ each)
    inner = np.array(freedoms) @ np.array(freedoms).T
    ours = clustered.compute_clustered_mean(values, cluster)
    return ours, (values.mean(), np.sqrt(sum(adjusted)), np.trace(inner) ** 2 / np.trace(inner @ inner))


def clustered_ratio(rng):
    above, below = rng.gamma(3.0, 1.0, (2, 40))
    ratio, total, more = above.sum() / below.sum(), np.array([above.sum(), below.sum()]), np.array([above, below])
    slope = [optimize.approx_fprime(total, lambda at: at[0] / at[1], 1e-7)]
    error = np.sqrt(40 * (slope @ np.cov(more) @ np.transpose(slope)).item())
    return clustered.compute_clustered_ratio(above, below, ALONE)[:2], (ratio, error)


def fieller_interval(rng):
    above, below = rng.normal(1.0, 1.0, 40), rng.normal(4.0, 1.0, 40)
    ratio = above.mean() / below.mean()

    def excess(at):
        return stats.ttest_1samp(above - at * below, 0.0).pvalue - 0.05

    ends = (optimize.brentq(excess, *sorted((ratio, ratio + side))) for side in (-3.0, 3.0))
    return clustered.compute_fieller_interval(above, below, ALONE), (ratio, *ends)


def wilson_interval(rng):
    hits, n = int(rng.integers(0, 21)), 20
    ends = stats.binomtest(hits, n).proportion_ci(method="wilson")
    found = *clustered.compute_wilson_interval(hits / n, n), clustered.count_independent_cases(hits / n, *ends)
    return found, (*ends, n)


def share_of_independent_cases(rng):
    holds = rng.random(40) < 0.3
    found = clustered.compute_clustered_share(holds, ALONE)
    ends = stats.binomtest(int(holds.sum()), 40).proportion_ci(method="wilson")
    return (found["value"], found["low"], found["high"]), (holds.mean(), *ends)


def difference_of_means(rng):
    one, other = rng.normal(1.0, 1.0, 12), rng.normal(0.0, 3.0, 20)
    welch = stats.ttest_ind(one, other, equal_var=False)
    found = clustered.subtract(mean_of(one), mean_of(other))
    return (*found.interval, found.p), (*welch.confidence_interval(), welch.pvalue)


def mean_of_strata(rng):
    one, other = rng.normal(1.0, 1.0, 12), rng.normal(0.0, 3.0, 20)
    found = scores.combine_strata([mean_of(3.0 * one), mean_of(-1.5 * other)], [1.0, 2.0])
    return found.interval, stats.ttest_ind(one, other, equal_var=False).confidence_interval()


def mean_over_repeats(rng):
    values = np.r_[rng.normal(size=9), np.nan]
    return state(scores.average_over_repeats(values, 0.0)), classical(values[:9])


def widening(rng):
    repeats, overlap = int(rng.integers(2, 20)), rng.uniform(0.1, 1.0)
    wide, narrow = stats.t.ppf(0.975, repeats - 1), stats.norm.ppf(0.975)
    return scores.compute_widening(repeats, overlap), wide / narrow * np.sqrt((1.0 / repeats + overlap) / overlap)


def sum_of_clusters(rng):
    values = rng.exponential(size=25)
    return state(clustered.sum_over_clusters(values)), 25.0 * np.array(classical(values))


def means_in_bins(rng):
    values, place = rng.normal(0.5, 1.0, 40), np.arange(40) % 4
    found = bin_means.average_in_bins(place, 4, values, np.ones(40), np.arange(40))
    ours = np.array([found.value, found.value - found.ci95, found.value + found.ci95, found.p]).T
    parts = [values[place == code] for code in range(4)]
    sizes = rng.gamma(2.0, 1.0, 40)
    codes, _ = bin_means.split_at_quantiles(sizes, 5)
    reference = [(*classical(part), stats.ttest_1samp(part, 0.0).pvalue) for part in parts]
    return (*ours.ravel(), *codes), (*np.ravel(reference), *pd.qcut(sizes, 5, labels=False))


def evidence_of_a_column(rng):
    residual, column, cluster = *rng.normal(size=(2, 40)), rng.integers(0, 9, 40)
    every, codes = column @ residual / (column @ column), np.unique(cluster)
    moved = [column[cluster != k] @ residual[cluster != k] / np.sum(column[cluster != k] ** 2) - every for k in codes]
    share = np.array([np.sum(column[cluster == k] ** 2) for k in codes]) / np.sum(column**2)
    error, freedom = np.sqrt(np.sum(np.square(moved))), 1.0 / np.sum(share**2) - 1.0
    found = evidence.compute_evidence(residual, column[:, np.newaxis], np.zeros(1), evidence.ClusterSums(cluster))
    return np.ravel(found), (every, error, freedom, every / error, 2.0 * stats.t.sf(abs(every) / error, freedom))


def gain(rng):
    before, after, cluster = *rng.normal(size=(2, 60)), np.repeat(np.arange(20), 3)
    falls = np.add.reduceat(before**2 - after**2, np.arange(0, 60, 3)) / np.sum(before**2)
    return state(evidence.measure_gain(before, after, cluster)), 20.0 * np.array(classical(falls))


def coefficients_of_other_folds(rng):
    column, residual, fold = *rng.normal(size=(2, 60)), rng.permutation(60) % 4
    fits = [np.linalg.lstsq(column[fold != k, np.newaxis], residual[fold != k], rcond=None)[0][0] for k in range(4)]
    limits = -0.05, 0.05
    ours = evidence.fit_other_folds(column**2, column * residual, fold)
    both = np.array([ours, evidence.cross_fit(column, residual, fold, limits)])
    return both, np.array([np.array(fits), np.clip(fits, *limits)])[:, fold]


def false_discovery(rng):
    p = rng.beta(0.3, 1.0, 30)
    q = [min(*(limit * len(p) / np.sum(p <= limit) for limit in p if limit >= each), 1.0) for each in p]
    holed = multiple_testing.adjust_false_discovery(np.r_[p, np.nan])
    assert np.isnan(holed[-1])
    return holed[:-1], q


def holm(rng):
    p, adjusted, least = rng.beta(0.3, 1.0, 12), np.empty(12), 0.0
    for rank, at in enumerate(np.argsort(p)):
        adjusted[at] = least = max(least, min((12 - rank) * p[at], 1.0))
    return multiple_testing.adjust_holm(p), adjusted


def conformal_quantiles(rng):
    errors, levels = np.sort(rng.normal(size=60)), (0.05, 0.3, 0.5, 0.9, 0.97)
    between = np.quantile(errors, levels, method="weibull")
    ours = conformal.compute_counted_quantiles(np.ones(60), errors, levels)
    ranks = conformal.find_conformal_ranks(60, levels)
    return (*ours, *np.interp(ranks, np.arange(60), errors)), (*between, *between)


def conformal_quantiles_that_cover(rng):
    errors, levels = rng.normal(size=60), (0.05, 0.9, 0.97)
    places = np.arange(1, 61) / 61.0  # probability of the next error below each of the known ones
    ends = max(np.flatnonzero(places <= 0.05)), min(np.flatnonzero(places >= 0.9)), min(np.flatnonzero(places >= 0.97))
    return conformal.compute_conformal_quantiles(errors, levels), np.sort(errors)[list(ends)]


def variance_between(rng):
    values, weight = rng.normal(0.0, 2.0, 12), rng.gamma(2.0, 1.0, 12)
    form = np.diag(weight) - np.outer(weight, weight) / weight.sum()  # values' form values is Cochran's Q
    expected = (values @ form @ values - np.trace(form / weight)) / np.trace(form)
    return random_effects.estimate_variance_between(values, weight), max(expected, 0.0)


def integration(rng):
    columns, weight, variance = rng.normal(size=(30, 4)), rng.gamma(2.0, 1.0, 30), np.array([0.4, 0.1])
    unit = rng.permutation(np.arange(30) % 3)
    found = random_effects.integrate_out(random_effects.sum_products(columns, weight, unit), slice(0, 2), variance)
    whole = np.diag(1.0 / weight)
    for k in range(2):
        whole += variance[k] * (unit[:, np.newaxis] == unit) * np.outer(columns[:, k], columns[:, k])
    total = random_effects.sum_units(found.sums, random_effects.number_units(np.full(3, 7)))[0]
    determinant = np.linalg.slogdet(whole)[1] + np.log(weight).sum()
    assert random_effects.get_diagonals(found.sums).sum(axis=0) == pytest.approx(np.diag(total))
    return (*total.ravel(), found.log_determinant.sum()), (
        *(columns.T @ np.linalg.solve(whole, columns)).ravel(),
        determinant,
    )


def errors_of_predictions(rng):
    measured, predicted = rng.gamma(3.0, 1.0, (2, 40))
    ours = [getattr(scores, f"compute_{name}")(measured, predicted) for name in ("mae", "rmse", "bias", "wmape")]
    mae = metrics.mean_absolute_error(measured, predicted)
    reference = mae, metrics.root_mean_squared_error(measured, predicted), np.mean(predicted) - np.mean(measured)
    relative = scores.compute_relative_errors(measured, predicted, 0.0)
    both = scores.compute_mape(measured, predicted, 0.0), np.mean(relative)
    percentage = metrics.mean_absolute_percentage_error(measured, predicted)
    return (*ours, *both), (*reference, mae / measured.mean(), percentage, percentage)


def shares_of_predictions(rng):
    measured, predicted = rng.gamma(3.0, 1.0, (2, 40))
    ours = (
        scores.compute_buffer(measured, predicted, 0.9),
        scores.compute_coverage(measured, predicted, predicted + 1.0),
    )
    inside = pd.Series(measured).between(predicted, predicted + 1.0).mean()
    bands = [np.isclose(predicted, measured, rtol=band / 100.0, atol=0.0).mean() for band in scores.BANDS]
    reference = np.quantile(measured - predicted, 0.9, method="inverted_cdf"), inside, *bands
    return (*ours, *scores.compute_band_shares(measured, predicted).values()), reference


def means_of_groups(rng):
    values, groups = rng.normal(size=40), rng.integers(-1, 4, 40)
    table = pd.Series(values).groupby(groups).mean().reindex(range(4))
    ours = scores.compute_bin_errors(values + 9.0, values + 10.0, groups, list("abcd"))
    sizes = pd.Series(groups).value_counts().reindex(range(4), fill_value=0)
    means = scores.compute_group_means(values, groups, 4)
    return (*means, *(each["n"] for each in ours)), (*table, *sizes[sizes > 0])


CASES = {
    half_widths: ["compute_half_widths"],
    estimate_ends_and_probability: [],
    clustered_mean_of_regression: ["compute_clustered_mean"],
    clustered_ratio: ["compute_clustered_ratio"],
    fieller_interval: ["compute_fieller_interval"],
    wilson_interval: ["compute_wilson_interval", "count_independent_cases"],
    share_of_independent_cases: ["compute_clustered_share"],
    difference_of_means: ["subtract"],
    mean_of_strata: ["combine_strata"],
    mean_over_repeats: ["average_over_repeats"],
    widening: ["compute_widening"],
    sum_of_clusters: ["sum_over_clusters"],
    means_in_bins: ["average_in_bins", "split_at_quantiles"],
    evidence_of_a_column: ["compute_evidence"],
    gain: ["measure_gain"],
    coefficients_of_other_folds: ["fit_other_folds", "cross_fit"],
    false_discovery: ["adjust_false_discovery"],
    holm: ["adjust_holm"],
    conformal_quantiles: ["compute_counted_quantiles", "find_conformal_ranks"],
    conformal_quantiles_that_cover: ["compute_conformal_quantiles"],
    variance_between: ["estimate_variance_between"],
    integration: ["integrate_out", "number_units", "get_diagonals", "link_units", "sum_products", "sum_units"],
    errors_of_predictions: [
        *(f"compute_{name}" for name in ("mae", "rmse", "bias", "wmape", "mape", "relative_errors")),
    ],
    shares_of_predictions: ["compute_buffer", "compute_coverage", "compute_band_shares"],
    means_of_groups: ["compute_group_means", "compute_bin_errors"],
}
"""What is compared -> the functions that it runs."""
ELSEWHERE = {
    "compute_worst_case_evidence": "test_evidence.py",
    "compute_reach": "test_confidence_sequence.py",
    "estimate_variances": "test_mixed_model.py",
    "find_interval": "test_mixed_model.py",
    "adjust_differences": "test_multiple_testing.py",
    "list_pairs": "test_multiple_testing.py",
    "select_dominating": "test_multiple_testing.py",
}
"""Function -> the file that compares it with dense matrices or on planted truths; those of splits are in one file."""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_statistic_equals_reference(case, seed):
    ours, reference = case(np.random.default_rng(seed))
    np.testing.assert_allclose(np.array(ours, float), np.array(reference, float), rtol=1e-6, atol=1e-9)


def test_every_statistic_is_compared():
    modules = [
        import_module(f"socast.core.stats.{each.name}") for each in pkgutil.iter_modules(socast.core.stats.__path__)
    ]
    functions = {
        name
        for module in modules
        for name, value in vars(module).items()
        if inspect.isfunction(value) and value.__module__ == module.__name__ and not name.startswith("_")
        if module.__name__ != "socast.core.stats.splits"
    }
    assert functions == {name for names in CASES.values() for name in names} | set(ELSEWHERE)
