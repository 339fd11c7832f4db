"""Test that the share of plans that is driven is learned, with its spread, and the way home."""

import numpy as np
import pytest

from socast.core.forecast.learning.plan_outcomes import SPREAD, PlanOutcomes


def learn(shifts, seed=1, driving=1.0, waiting=1.0, way_home=0.0, spread=0.02, per_day=5):
    """Return what is learned of shifts of which shares of driving, waiting and a way home are done."""
    rng, outcomes = np.random.default_rng(seed), PlanOutcomes()
    for number in range(shifts):
        drive, wait = np.linspace(8.0, 1.0, 10) * rng.uniform(0.5, 1.5), np.linspace(2.0, 0.3, 10)
        planned = np.column_stack([drive, wait, np.full(10, 0.8)])
        done = planned @ [driving, waiting, way_home]
        outcomes.add_shift(planned, done + np.sqrt(spread * (drive + wait)) * rng.normal())
        if number % per_day == per_day - 1:
            outcomes.apply_daily_update()
    return outcomes


def test_plans_are_believed_before_any_outcome():
    outcomes = PlanOutcomes()
    assert outcomes.factor.tolist() == [1.0, 1.0, 0.0]
    assert outcomes.variance == SPREAD.variance


@pytest.mark.parametrize("shares", [(1.0, 1.0, 0.0), (0.75, 1.0, 0.0), (1.1, 0.8, 0.0), (1.0, 1.0, 1.5)])
def test_share_that_is_done_is_recovered(shares):
    outcomes = learn(200, 1, *shares)
    assert outcomes.factor == pytest.approx(shares, abs=0.12)


def test_share_of_the_way_home_is_never_negative():
    """A shortfall of the energy lowers the shares of driving and waiting, not that of the way home below zero."""
    outcomes = learn(20, driving=0.9, way_home=-0.4)
    assert outcomes.factor[2] == 0.0
    assert outcomes.factor[:2] @ [5.0, 1.0] == pytest.approx(0.9 * 5.0 + 1.0 - 0.4 * 0.8, abs=0.15)


@pytest.mark.parametrize("spread", [0.005, 0.2])
def test_spread_of_what_is_done_is_recovered(spread):
    assert learn(300, spread=spread).variance == pytest.approx(spread, rel=0.35, abs=0.006)


def test_one_shift_changes_little_and_unknown_ones_nothing():
    once = learn(1, driving=0.5, per_day=1)
    assert 0.8 < once.factor[0] < 1.0
    none = PlanOutcomes()
    planned = np.array([[np.nan, 1.0, 0.0], [3.0, np.nan, 0.0], [0.0, 0.1, 0.0]])
    none.add_shift(planned, np.array([1.0, 2.0, 0.1]))
    none.apply_daily_update()
    assert none.dump() == PlanOutcomes().dump()


def test_loaded_state_continues_as_uninterrupted():
    one, other = learn(7, driving=0.8), PlanOutcomes()
    other.load(one.dump())
    for each in (one, other):
        each.apply_daily_update()
    assert other.dump() == one.dump()
    assert other.factor.tolist() == one.factor.tolist()
