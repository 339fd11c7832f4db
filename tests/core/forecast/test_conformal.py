"""Test the intervals from earlier errors: coverage, and borrowing between classes."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.forecast.conformal import (
    DISTANCE_CLASSES,
    LEVELS,
    LOWER_LEVEL,
    SCORES,
    UPPER_LEVEL,
    ConformalIntervals,
    classify,
    count_scores,
)
from socast.core.forecast.outlook import MeanAndSd, compute_reserve_risk
from socast.core.stats.conformal import compute_counted_quantiles

BOUND_LEVELS = LOWER_LEVEL, UPPER_LEVEL
HERE = (np.array([0]), np.array([10.0]))
"""A basis and a distance of that class."""


def learned(shifts, conformal=None, each=3, km=10.0, kind=0, nightly=10):
    """Learn from shifts whose forecasts share one error, with a daily update after every `nightly` shifts."""
    conformal = conformal or ConformalIntervals()
    for number, score in enumerate(shifts):
        conformal.add_shift(kind, np.full(each, km), np.full(each, score))
        if (number + 1) % nightly == 0:
            conformal.apply_daily_update()
    conformal.apply_daily_update()
    return conformal


def bounds_at(conformal, km, kind=0):
    bounds = conformal.get_quantiles(np.array([kind]), np.array([km]))[1]
    return np.array([bounds.lower[0], bounds.upper[0]])


@pytest.mark.parametrize(("draw", "scale"), [("normal", 2.0), ("laplace", 1.0), ("lognormal", 1.0), ("uniform", 5.0)])
@pytest.mark.parametrize("count", [20, 60, 200])
def test_quantiles_cover_nine_in_ten_exchangeable_errors(draw, scale, count):
    rng = np.random.default_rng(count)
    inside = []
    for _ in range(400):
        scores = scale * getattr(rng, draw)(size=count + 20)
        low, high = compute_counted_quantiles(count * count_scores(scores[:count]), SCORES, BOUND_LEVELS)
        inside.append(np.mean((scores[count:] >= low) & (scores[count:] <= high)))
    assert 0.88 <= np.mean(inside) <= 0.92


def test_interval_covers_nine_in_ten_while_learning():
    rng = np.random.default_rng(4)
    results = []
    for _ in range(6):
        conformal = ConformalIntervals()
        for day in range(40):
            scores = 0.6 * rng.normal() + rng.normal(size=(10, 3))
            if day > 12:
                low, high = bounds_at(conformal, 10.0)
                results.append(np.mean((scores >= low) & (scores <= high)))
            for mine in scores:
                conformal.add_shift(0, np.full(3, 10.0), mine)
            conformal.apply_daily_update()
    assert 0.88 <= np.mean(results) <= 0.92


def test_bounds_widen_when_errors_double():
    rng = np.random.default_rng(5)
    conformal, inside = learned(rng.normal(size=400)), []
    low, high = bounds_at(conformal, 10.0)
    for _ in range(60):
        scores = 2.0 * rng.normal(size=10)
        lower, higher = bounds_at(conformal, 10.0)
        inside.append(np.mean((scores >= lower) & (scores <= higher)))
        conformal = learned(scores, conformal)
    assert lower < 1.3 * low
    assert higher > 1.3 * high
    assert np.mean(inside[:3]) < np.mean(inside[-20:])
    assert 0.84 < np.mean(inside[-20:]) < 0.97


@pytest.mark.parametrize("kind", [0, 1])
def test_intervals_before_any_shift_are_those_of_the_prior(kind):
    low, high = bounds_at(ConformalIntervals(), 10.0, kind)
    assert low == pytest.approx(-high)
    assert 1.645 < high < 4.0


def test_few_shifts_change_the_intervals_little():
    before, after = bounds_at(ConformalIntervals(), 10.0), bounds_at(learned([0.0, 0.1]), 10.0)
    assert after == pytest.approx(before, rel=0.1)


def test_class_with_few_shifts_borrows_from_the_others_but_not_from_other_basis():
    rng = np.random.default_rng(7)
    prior = bounds_at(ConformalIntervals(), 10.0, kind=1)
    conformal = learned(rng.normal(size=200))
    before = bounds_at(conformal, 50.0)
    conformal = learned(5.0 * rng.normal(size=200), conformal, km=0.1)
    near = bounds_at(conformal, 50.0)
    assert near[1] > 1.3 * before[1]
    assert bounds_at(conformal, 0.1)[1] > near[1] > bounds_at(conformal, 10.0)[1]
    assert bounds_at(conformal, 10.0, kind=1) == pytest.approx(prior)
    alone = learned(0.1 * rng.normal(size=800), conformal, km=50.0)
    assert bounds_at(alone, 50.0)[1] < 0.7 * near[1]


def test_what_errors_do_not_tell_of_is_bounded_as_before_any_shift_and_never_narrower():
    conformal = learned(0.1 * np.random.default_rng(1).normal(size=400))
    first = ConformalIntervals().get_quantiles(*HERE)[0]
    tables = [conformal.get_quantiles(*HERE, np.array([share]))[0] for share in (0.0, 0.3, 1.0)]
    for known, wider in pairwise(tables):
        assert (np.diff(wider) >= 0.0).all()
        assert wider[0, 0] < known[0, 0]
        assert wider[0, -1] > known[0, -1]
    upper = np.array(LEVELS) > 0.5
    assert tables[2] == pytest.approx(np.where(upper, np.maximum(tables[0], first), np.minimum(tables[0], first)))


def test_shifts_of_one_day_count_as_few():
    """Errors of a day are correlated, so that 200 shifts of one day tell less than 50 of 25 days."""
    one_day, many_days = learned(np.full(200, 1.0), nightly=200), learned(np.full(50, 1.0), nightly=2)
    assert one_day._counts.sum() < 0.2 * many_days._counts.sum()


@given(st.lists(st.floats(-50.0, 50.0), min_size=20, max_size=80), st.integers(1, 5))
def test_quantiles_rise_and_do_not_depend_on_the_number_of_forecasts_of_a_shift(scores, each):
    counts = sum(count_scores(np.full(each, score)) for score in scores)
    results = compute_counted_quantiles(counts, SCORES, LEVELS)
    assert (np.diff(results) >= 0.0).all()
    at_once = len(scores) * count_scores(np.array(scores))
    assert compute_counted_quantiles(at_once, SCORES, LEVELS) == pytest.approx(results)


@given(st.lists(st.floats(SCORES[0], SCORES[-1]), min_size=1, max_size=50))
def test_counted_scores_keep_their_number_and_mean(scores):
    counts = count_scores(np.array(scores))
    assert counts.sum() == pytest.approx(1.0)
    assert counts @ SCORES == pytest.approx(np.mean(scores), abs=1e-9)


@given(st.floats(0.0, 500.0))
def test_every_forecast_has_a_class(km):
    (distance,) = classify(np.array([km])).tolist()
    assert DISTANCE_CLASSES[distance] <= km
    assert distance == len(DISTANCE_CLASSES) - 1 or km < DISTANCE_CLASSES[distance + 1]


def test_unknown_distance_has_a_class():
    assert classify(np.array([np.nan, -1.0])).tolist() == [0, 0]


@given(seed=st.integers(0, 1000), mean=st.floats(0.0, 1.0), sd=st.floats(0.001, 0.2))
def test_risk_rises_with_the_reserve_and_agrees_with_the_interval(seed, mean, sd):
    conformal = learned(np.random.default_rng(seed).standard_t(5, size=60))
    table, (_, (low,), (high,)) = conformal.get_quantiles(*HERE)

    def risks(reserve):
        n = len(reserve)
        return compute_reserve_risk(MeanAndSd(np.full(n, mean), np.full(n, sd)), reserve, np.repeat(table, n, axis=0))

    results = risks(np.linspace(-1.0, 2.0, 400))
    assert (np.diff(results) >= 0.0).all()
    assert ((results >= 0.0) & (results <= 1.0)).all()
    assert risks(mean + sd * np.array([low, high])) == pytest.approx(BOUND_LEVELS, abs=0.005)
    assert risks(mean + sd * np.array([-1e6, 1e6])).tolist() == [0.0, 1.0]


def test_risk_equals_frequency_of_ending_below_the_reserve():
    rng = np.random.default_rng(9)
    table = learned(rng.normal(0.3, 1.5, 1500)).get_quantiles(*HERE)[0]
    ends = 0.3 + 0.02 * rng.normal(0.3, 1.5, 20_000)
    for reserve in (0.25, 0.28, 0.3, 0.32, 0.35):
        results = compute_reserve_risk(MeanAndSd(np.array([0.3]), np.array([0.02])), np.array([reserve]), table)
        assert results[0] == pytest.approx(np.mean(ends < reserve), abs=0.05)


def test_risk_is_nan_for_unknown_charge_or_errors():
    table = learned(np.linspace(-1.0, 1.0, 30)).get_quantiles(*HERE)[0]
    unknown = MeanAndSd(np.array([np.nan]), np.array([0.01]))
    assert np.isnan(compute_reserve_risk(unknown, np.array([0.1]), table)).all()
    known = MeanAndSd(np.array([0.5]), np.array([0.01]))
    assert np.isnan(compute_reserve_risk(known, np.array([0.1]), np.full_like(table, np.nan))).all()


def test_loaded_state_continues_as_uninterrupted():
    rng = np.random.default_rng(8)
    one, other = learned(rng.normal(size=500)), ConformalIntervals()
    other.load(one.dump())
    more = rng.normal(size=60)
    assert repr(learned(more, one).dump()) == repr(learned(more, other).dump())
