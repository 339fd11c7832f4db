"""Sudden changes are found and dated, and what wanders, changes slowly or is one odd day is no step."""

import numpy as np
import pytest

from socast.core.condition.car_days import subtract_siblings
from socast.core.condition.level_model import CONSUMPTION, Series, Wandering, smooth_levels
from socast.core.condition.level_steps import (
    find_steps,
    separate_steps,
    smooth_between_steps,
    subtract_steps,
)
from socast.tools.bench.condition_fleets import FIRST, make_fleet

QUIET = Wandering(0.03, 0.0, 0.01, 0.03)


def steps_of(fleet):
    apart = subtract_siblings(fleet, ["m"] * len(fleet.value))
    return separate_steps(apart, CONSUMPTION)[2]


def test_steps_of_six_percent_are_found_and_dated_and_few_others():
    found, near, held, false = [], [], [], 0
    for seed in range(16):
        size = 0.06 if seed % 2 else -0.06
        mine, *others = steps_of(make_fleet(seed, step=size, at=30 + 4 * seed))
        right = [each for each in mine if abs(each.since - FIRST - 30 - 4 * seed) < 20]
        found.append(bool(right))
        near += [abs(each.since - FIRST - 30 - 4 * seed) <= 4 for each in right]
        held += [abs(each.size - size) <= 1.96 * each.sd for each in right]
        false += sum(map(bool, others))
    assert np.mean(found) >= 0.8
    assert np.mean(near) >= 0.75
    assert np.mean(held) >= 0.8
    assert false <= 4  # of 112 cars


def test_a_slow_change_is_no_step():
    assert not any(map(bool, steps_of(make_fleet(3, days=200, rate=0.1))[1:]))
    dates = np.arange(300.0)
    value = 0.08 * dates / 365.0 + 0.03 * np.random.default_rng(0).normal(size=300)
    assert find_steps(dates, value, np.full(300, 0.03**2), QUIET) == []


def test_two_steps_are_separated():
    rng, dates = np.random.default_rng(1), np.arange(150.0)
    value = 0.03 * rng.normal(size=150) + np.where(dates >= 50, 0.08, 0.0) - np.where(dates >= 100, 0.1, 0.0)
    first, second = find_steps(dates, value, np.full(150, 0.03**2), QUIET)
    assert abs(first.since - 50) <= 2
    assert abs(second.since - 100) <= 2
    assert first.low <= first.since <= first.high
    assert (first.size, second.size) == (pytest.approx(0.08, abs=0.02), pytest.approx(-0.1, abs=0.02))


def test_few_days_have_no_step():
    assert find_steps(np.arange(5.0), np.array([0.0, 0.0, 0.0, 1.0, 1.0]), np.full(5, 1e-4), QUIET) == []


def test_a_step_is_as_probable_as_it_was_expected():
    rng, dates = np.random.default_rng(4), np.arange(100.0)
    value = 0.03 * rng.normal(size=100) + np.where(dates >= 50, 0.03, 0.0)
    odds = []
    for expected in (1.0, 0.25):
        (step,) = find_steps(dates, value, np.full(100, 0.03**2), QUIET._replace(steps=expected), least=0.01)[:1]
        odds.append(step.probability / (1.0 - step.probability))
    assert odds[0] == pytest.approx(4.0 * odds[1])


def test_steps_are_subtracted():
    fleet = make_fleet(2, step=0.08, at=60)
    without = subtract_steps(fleet, steps_of(fleet))
    before, after = np.nanmean(without.value[0, :60]), np.nanmean(without.value[0, 60:])
    assert abs(after - before) < 0.03


def test_a_step_that_is_not_sure_widens_the_interval_of_the_level():
    rng, dates = np.random.default_rng(6), np.arange(40)
    value = 0.03 * rng.normal(size=(2, 40))
    value[0] += np.where(dates >= 30, 0.04, 0.0)
    series = Series(FIRST + dates, value, np.ones((2, 40)), np.zeros((2, 40)))
    assert find_steps(dates.astype(float), value[0], np.full(40, 0.03**2), QUIET) == []
    plain, mixed = smooth_levels(series, QUIET), smooth_between_steps(series, QUIET, [[], []])
    assert plain.level[0, -1] < mixed.level[0, -1] < 0.04
    assert mixed.sd[0, -1] > 1.3 * plain.sd[0, -1]
    assert mixed.sd[1, -1] < 1.15 * plain.sd[1, -1]
    assert mixed.level[1] == pytest.approx(plain.level[1], abs=0.005)
