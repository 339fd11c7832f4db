"""Intervals of proportions hold the proportion as often as they say, also for few trials."""

from math import isnan

import numpy as np
import pytest
from scipy import stats

from core.stats.proportions import compute_wilson_interval


def test_interval_equals_that_of_the_score_test():
    low, high = compute_wilson_interval(7, 25)
    for end in (low, high):
        assert abs(7 / 25 - end) / np.sqrt(end * (1.0 - end) / 25) == pytest.approx(1.96, abs=1e-3)


def test_ends_stay_within_zero_and_one():
    assert compute_wilson_interval(0, 10)[0] == 0.0
    assert compute_wilson_interval(10, 10)[1] == 1.0
    assert 0.6 < compute_wilson_interval(10, 10)[0] < 0.8
    assert all(isnan(end) for end in compute_wilson_interval(0, 0))


@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_interval_holds_the_proportion_in_about_95_percent(share):
    held = [low <= share <= high for low, high in (compute_wilson_interval(k, 60) for k in range(61))]
    assert stats.binom.pmf(np.arange(61), 60, share) @ held == pytest.approx(0.95, abs=0.03)
