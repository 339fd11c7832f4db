"""Corrections for multiple testing: their guarantees on planted truths, and the comparison of models."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from socast.core.stats.multiple_testing import (
    adjust_differences,
    adjust_false_discovery,
    adjust_holm,
    list_pairs,
    select_dominating,
)
from socast.core.stats.scores import UNKNOWN, Estimate, average_over_repeats
from tests.support.repeated_splits import repeated


@given(arrays(np.float64, st.integers(1, 20), elements=st.floats(0.0, 1.0)))
def test_holm_keeps_order_and_never_lowers_probabilities(p):
    adjusted = adjust_holm(p)
    assert np.all(adjusted >= p)
    assert np.all(adjusted <= np.minimum(p * len(p), 1.0) + 1e-12)
    order = np.argsort(p, kind="stable")
    assert np.all(np.diff(adjusted[order]) >= 0.0)


def compare(error, seed):
    """Return the dominating models and the adjusted probabilities for columns of absolute errors."""
    names = [f"m{i}" for i in range(error.shape[1])]
    means = repeated(error, seed)
    estimates = {
        (a, b): average_over_repeats(means[:, int(a[1])] - means[:, int(b[1])], 0.25) for a, b in list_pairs(names)
    }
    return select_dominating(dict(zip(names, means.mean(axis=0), strict=True)), estimates), adjust_differences(
        estimates
    )


def test_difference_score_finds_planted_better_models_and_co_dominators():
    rng = np.random.default_rng(5)
    hard = rng.gamma(2.0, 0.2, size=(400, 1))  # the difficulty of a ride is common to all models
    error = hard + np.abs(rng.normal(0.0, 0.05, size=(400, 4))) + np.array([0.1, 0.0, 0.03, 0.0])
    best, p = compare(error, seed=5)
    assert set(best) == {"m1", "m3"}
    assert p["m0", "m1"] < 0.001
    assert p["m1", "m3"] > 0.05


def test_equal_models_differ_significantly_at_most_at_stated_rate():
    rng = np.random.default_rng(6)
    false = 0
    for seed in range(300):
        hard = rng.gamma(2.0, 0.2, size=(150, 1))
        best, p = compare(hard + np.abs(rng.normal(0.0, 0.1, size=(150, 4))), seed)
        false += min(p.values()) < 0.05
        assert len(best) == 4 or min(p.values()) < 0.05
    assert false / 300 <= 0.05


def test_identical_models_co_dominate():
    same = np.abs(np.random.default_rng(7).normal(size=(100, 1))) * np.ones((1, 3))
    best, p = compare(same, seed=7)
    assert best == ["m0", "m1", "m2"]
    assert set(p.values()) == {1.0}


def test_an_error_larger_by_a_factor_is_no_co_dominance_however_wide_its_interval():
    errors = {"a": 0.1, "absurd": 5e8, "near": 0.11, "unsure": 0.12}
    differences = {
        ("a", "absurd"): Estimate(-5e8, 6e8, 9.0),
        ("a", "near"): Estimate(-0.01, 0.005, 9.0),
        ("unsure", "a"): Estimate(0.02, 0.02, 9.0),
        ("absurd", "near"): Estimate(5e8, 6e8, 9.0),
        ("absurd", "unsure"): Estimate(5e8, 6e8, 9.0),
        ("near", "unsure"): Estimate(-0.01, 0.02, 9.0),
    }
    assert min(adjust_differences(differences).values()) > 0.05
    assert select_dominating(errors, differences) == ["a", "near"]


def test_models_without_error_are_not_selected():
    assert select_dominating({"a": np.nan, "b": 1.0}, {("a", "b"): UNKNOWN}) == ["b"]
    assert select_dominating({}, {}) == []


P_VALUES = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30).map(np.array)


class TestFalseDiscovery:
    @given(P_VALUES)
    def test_q_values_keep_order_and_never_lower_probabilities(self, p):
        q = adjust_false_discovery(p)
        assert ((q >= p) & (q <= 1.0)).all()
        assert (np.diff(q[np.argsort(p, kind="stable")]) >= 0.0).all()

    @given(P_VALUES, st.floats(0.001, 0.5))
    def test_q_values_up_to_a_level_are_those_of_the_step_up_procedure(self, p, level):
        ordered = np.sort(p)
        adjusted = ordered * len(p) / np.arange(1, len(p) + 1)
        assume(np.abs(adjusted - level).min() > 1e-12)  # at the level itself rounding decides
        passed = np.flatnonzero(adjusted <= level)
        taken = p <= ordered[passed[-1]] if len(passed) else np.zeros(len(p), dtype=bool)
        np.testing.assert_array_equal(adjust_false_discovery(p) <= level, taken)

    @given(P_VALUES, st.integers(0, 2**32))
    def test_q_values_do_not_depend_on_order_of_hypotheses(self, p, seed):
        order = np.random.default_rng(seed).permutation(len(p))
        np.testing.assert_allclose(adjust_false_discovery(p[order]), adjust_false_discovery(p)[order])

    @given(P_VALUES, st.integers(0, 29), st.floats(0.0, 1.0))
    def test_lowering_one_probability_raises_no_q_value(self, p, at, factor):
        lower = p.copy()
        lower[at % len(p)] *= factor
        assert (adjust_false_discovery(lower) <= adjust_false_discovery(p) + 1e-15).all()

    def test_single_probability_is_unchanged_and_empty_stays_empty(self):
        assert adjust_false_discovery(np.array([0.3])).tolist() == [0.3]
        assert adjust_false_discovery(np.empty(0)).shape == (0,)

    @given(P_VALUES)
    def test_untested_hypotheses_stay_nan_and_change_no_q_value(self, p):
        q = adjust_false_discovery(np.append(p, np.nan))
        assert np.isnan(q[-1])
        np.testing.assert_array_equal(q[:-1], adjust_false_discovery(p))

    def test_share_of_false_discoveries_stays_below_level(self):
        rng = np.random.default_rng(8)
        false = []
        for _ in range(400):
            p = np.r_[rng.random(40), 1e-4 * rng.random(5)]
            discoveries = np.flatnonzero(adjust_false_discovery(p) < 0.1)
            false.append(np.mean(discoveries < 40) if len(discoveries) else 0.0)
        assert np.mean(false) < 0.1
