"""Test ranking by held-out days: chance gains nothing, forbidden signs do not count, the planted variant is best."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.ranking import (
    LEVEL,
    Ranking,
    ResidualSpace,
    compute_correlation,
    compute_window_gains,
    rank_candidates,
)
from socast.core.stats.clustered import sum_over_clusters
from socast.core.stats.evidence import ClusterSums
from socast.core.stats.multiple_testing import combine_by_simes
from tests.support.synthetic_windows import gather_with_model, keep_only, make_tables, make_windows

EITHER = np.zeros(1, dtype=np.int64)


def days(count=40, each=15):
    return ClusterSums(np.repeat(np.arange(count), each))


def ranked(shares, *names, recipe="road_load", **errors) -> Ranking:
    return of_tables(make_tables(make_windows(), shares, **({"of_day": 0.02} | errors)), *names, recipe=recipe)


def of_tables(tables, *names, recipe="road_load") -> Ranking:
    windows, model = gather_with_model(tables, recipe)
    base, candidates = BaseProjection(windows, model), build_candidates(windows, model)
    clusters = [ClusterSums(windows.day), ClusterSums(windows.date)]
    nothing = np.empty((len(base.residual), 0))
    space = ResidualSpace(base, nothing, base.residual)
    return rank_candidates(space, keep_only(candidates, *names) if names else candidates, clusters, 0)


class TestHeldOut:
    def test_gain_uses_coefficients_of_other_folds(self, rng):
        clusters = days(23, 7)
        residual, columns = rng.normal(size=161), rng.normal(size=(161, 3))
        sign = np.array([0, 1, -1])
        ranking = compute_window_gains(residual, columns, sign, clusters, 5)
        fold = clusters.assign_folds(5)[clusters.code]
        expected = np.zeros((161, 3))
        for k in np.unique(fold):
            for at in range(3):
                here, rest = fold == k, fold != k
                fitted = np.linalg.lstsq(columns[rest][:, [at]], residual[rest], rcond=None)[0][0]
                fitted = 0.0 if sign[at] * fitted < 0.0 else fitted
                expected[here, at] = residual[here] ** 2 - (residual[here] - fitted * columns[here, at]) ** 2
        expected = clusters.sum_by_cluster(expected) / (residual @ residual)
        np.testing.assert_allclose(ranking, expected, atol=1e-12)

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


class TestRank:
    @pytest.mark.parametrize(
        "variant", ["cold_rolling@reference=283.15", "wet_road@depth=0.0001", "regen_full_battery@threshold=0.8"]
    )
    def test_planted_variant_is_best(self, variant):
        ranking = ranked({variant: 0.08}, variant.split("@")[0], "headwind", of_day=0.0)
        assert ranking.candidates.variants[ranking.best[0]] == variant
        assert ranking.q[0] < LEVEL
        assert ranking.list_significant() == [ranking.best[0]]

    def test_significant_effects_are_ordered_by_probability(self):
        ranking = ranked({"headwind": 0.05, "night_lights": 0.05})
        names = [ranking.candidates.variants[v] for v in ranking.list_significant()]
        assert {"headwind", "night_lights"} <= set(names)
        p = [ranking.evidence.p[v] for v in ranking.list_significant()]
        assert p == sorted(p)

    def test_effect_within_model_is_not_identifiable(self):
        ranking = ranked({}, "standby", "headwind", recipe="road_load_constant")
        assert ranking.best[0] == -1
        assert np.isnan(ranking.q[0])
        assert ranking.left[0] < 1e-6
        assert ranking.best[1] >= 0
        assert 0.0 <= ranking.q[1] <= 1.0

    def test_nothing_is_significant_without_planted_effect(self):
        """At a level of one in a hundred, one of six data sets may pass."""
        tables = [make_tables(make_windows(3, 16, seed=seed), seed=seed, of_day=0.03) for seed in range(6)]
        assert sum(bool(of_tables(each).list_significant()) for each in tables) <= 1

    def test_selected_effect_is_projected_off_candidates(self):
        windows, model = gather_with_model(make_tables(make_windows(), {"headwind": 0.05}))
        base, candidates = (
            BaseProjection(windows, model),
            keep_only(build_candidates(windows, model), "headwind", "cold_rolling"),
        )
        off = base.project_out(candidates.columns[:, :1])
        off /= np.sqrt((off**2).sum())
        left = base.residual - off @ (off.T @ base.residual)
        space = ResidualSpace(base, off, left)
        ranking = rank_candidates(space, candidates, [ClusterSums(base.windows.day)], 0)
        assert ranking.best[0] == -1
        assert np.abs(off.T @ ranking.projected[:, 1:]).max() < 1e-6


class TestSimes:
    def test_simes_keeps_level_for_independent_and_repeated_tests(self):
        rng = np.random.default_rng(6)
        assert np.mean([combine_by_simes(rng.random(5)) < 0.05 for _ in range(4000)]) == pytest.approx(0.05, abs=0.012)
        assert combine_by_simes(np.full(7, 0.03)) == pytest.approx(0.03)

    @given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12).map(np.array))
    def test_simes_lies_between_least_probability_and_its_bonferroni_bound(self, p):
        assert p.min() <= combine_by_simes(p) <= min(len(p) * p.min(), p.max()) + 1e-15


@given(st.integers(0, 2**32), st.floats(-10.0, 10.0).filter(lambda x: abs(x) > 1e-3))
def test_correlation_is_a_cosine(seed, scale):
    one, other = np.random.default_rng(seed).normal(size=(2, 30))
    ranking = compute_correlation(one, other)
    assert -1.0 <= ranking <= 1.0
    assert ranking == pytest.approx(compute_correlation(other, one))
    assert compute_correlation(scale * one, other) == pytest.approx(np.sign(scale) * ranking)
    assert compute_correlation(one, one) == pytest.approx(1.0)
    assert compute_correlation(one, np.zeros(30)) == 0.0
