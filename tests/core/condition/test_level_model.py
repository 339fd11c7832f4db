"""The state-space model recovers levels, rates and their uncertainty, as a dense Gaussian computation does."""

import numpy as np
import pytest

from socast.core.condition.car_days import subtract_siblings
from socast.core.condition.level_model import (
    CAPACITY,
    CONSUMPTION,
    LEVEL_SD,
    YEAR,
    Series,
    Wandering,
    average_wander,
    estimate_wandering,
    smooth_levels,
)
from socast.tools.bench.condition_fleets import FIRST, make_batteries, make_fleet

KNOWN = Wandering(0.03, 0.15, 0.02, 0.03)


def test_smoothed_path_is_that_of_the_dense_gaussian_model():
    rng = np.random.default_rng(3)
    dates = FIRST + np.array([0, 1, 2, 5, 9, 10, 11, 30])
    value = rng.normal(0.1, 0.05, (1, 8))
    value[0, 3] = np.nan
    series = Series(dates, value, np.full((1, 8), 10.0), np.zeros((1, 8)))
    path = smooth_levels(series, KNOWN)
    time = (dates - dates[0]).astype(float)
    level = LEVEL_SD**2 + (KNOWN.rate / YEAR) ** 2 * np.outer(time, time)
    level += KNOWN.wander**2 / YEAR * np.minimum.outer(time, time)
    known = np.isfinite(value[0])
    noise = np.diag(series.compute_variance(KNOWN)[0])
    gain = level[:, known] @ np.linalg.inv((level + noise)[np.ix_(known, known)])
    first = value[0, 0]
    assert path.level[0] == pytest.approx(first + gain @ (value[0, known] - first), abs=1e-9)
    assert path.sd[0] ** 2 == pytest.approx(np.diag(level - gain @ level[known]), abs=1e-9)


def test_sizes_of_noise_are_estimated_from_all_cars():
    apart = subtract_siblings(make_fleet(4, days=300), ["m"] * 8)
    found, _ = estimate_wandering(apart, CONSUMPTION)
    assert np.hypot(found.of_day, found.of_amount / np.sqrt(15.0)) == pytest.approx(np.hypot(0.03, 0.039), rel=0.3)
    assert 0.004 < found.wander < 0.025


def test_days_far_off_have_more_variance():
    fleet = make_fleet(5)
    fleet.value[3, 40] = 1.0
    _, heavy = estimate_wandering(fleet, CONSUMPTION)
    assert heavy.extra[3, 40] > 20.0 * np.median(heavy.extra[3])


def test_intervals_of_rates_hold_the_truth():
    held = []
    for seed in range(12):
        apart = subtract_siblings(make_fleet(seed, days=300), ["m"] * 8)
        found, heavy = estimate_wandering(apart, CONSUMPTION)
        path = smooth_levels(heavy, found)
        held += list(np.abs(path.rate) < 1.96 * path.rate_sd)
    assert 0.88 <= np.mean(held) <= 0.99


@pytest.mark.parametrize("wander", [0.005, 0.02])
def test_intervals_of_rates_hold_the_truth_where_capacities_wander(wander):
    held = []
    for seed in range(40):
        fleet = make_batteries(seed, wander=wander)
        found, heavy = estimate_wandering(fleet, CAPACITY)
        path = smooth_levels(heavy, average_wander(fleet, heavy, found, CAPACITY))
        held += list(np.abs(path.rate + 0.02) < 1.96 * path.rate_sd)
    assert 0.92 <= np.mean(held) <= 0.98


def test_averaged_wander_is_the_most_probable_one_where_much_tells_it():
    for cars, days, low, high in ((60, 300, 0.9, 1.1), (3, 40, 1.2, 4.0)):
        fleet = make_batteries(3, cars, days, wander=0.02)
        found, heavy = estimate_wandering(fleet, CAPACITY)
        averaged = average_wander(fleet, heavy, found, CAPACITY)
        assert averaged._replace(wander=found.wander) == found
        assert low < averaged.wander / found.wander < high


def test_rate_is_not_drawn_towards_zero_by_its_prior():
    time = np.arange(60)
    trend = Series(FIRST + time, 0.1 * time[np.newaxis] / YEAR, np.full((1, 60), 10.0), np.zeros((1, 60)))
    for rate in (0.01, 0.03):
        assert smooth_levels(trend, KNOWN._replace(rate=rate)).rate[0] == pytest.approx(0.1, rel=1e-3)


def test_car_without_values_has_no_path():
    fleet = make_fleet(6)
    fleet.value[2] = np.nan
    path = smooth_levels(fleet, KNOWN)
    assert np.isnan(path.level[2]).all()
    assert np.isnan(path.rate[2])
    assert np.isfinite(path.level[0]).all()
