"""What cars and drivers take, and how their shifts go: planted and found."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.ahead.scales import CAR, DAY, DRIVER, LEAST_SHIFTS, MOST, Habit, Scales


def week(rng, scales, days=30, cars=(0.15, -0.1), drivers=(0.08, -0.08)):
    """Let two drivers change cars every day."""
    for day in range(days):
        for lane, car in enumerate(cars):
            who = (day + lane) % 2
            used = 20.0 * np.exp(car + drivers[who] + DAY * rng.normal())
            scales.learn(lane, f"d{who}", 20.0, used, 40.0)


def test_what_a_car_takes_is_kept_from_shift_to_shift():
    scales, before = Scales(), Scales().expected(0)
    for _ in range(20):
        scales.learn(0, None, 20.0, 24.0, 40.0)
    mean, variance = scales.expected(0)
    assert mean == pytest.approx(np.log(1.2), abs=0.02)
    assert DAY**2 < variance < before[1]
    assert scales.expected(1) == before == (0.0, CAR**2 + DRIVER**2 + DAY**2)


def test_cars_and_drivers_are_told_apart():
    inside = []
    for seed in range(60):
        scales = Scales()
        week(np.random.default_rng(seed), scales)
        for lane, car in enumerate((0.15, -0.1)):
            for who, driver in enumerate((0.08, -0.08)):
                mean, variance = scales.expected(lane, f"d{who}")
                inside.append(abs(mean - car - driver) < 1.645 * np.sqrt(variance - DAY**2))
                assert mean == pytest.approx(car + driver, abs=0.08)
    assert np.mean(inside) > 0.75


@given(st.lists(st.tuples(st.floats(1.0, 60.0), st.floats(0.6, 1.7), st.none() | st.sampled_from("ab")), max_size=30))
def test_every_shift_makes_it_surer(shifts):
    scales, last = Scales(), Scales().expected(0)[1]
    for predicted, ratio, driver in shifts:
        scales.learn(0, driver, predicted, ratio * predicted, 40.0)
        variance = scales.expected(0)[1]
        assert DAY**2 < variance < last
        last = variance


@pytest.mark.parametrize(
    ("predicted", "used"),
    [(0.0, 5.0), (-1.0, 5.0), (5.0, 0.0), (5.0, -2.0), (5.0, 5.0 * np.exp(MOST) * 1.01), (np.nan, 1.0)],
)
def test_a_shift_that_cannot_be_is_not_learned_from(predicted, used):
    scales = Scales()
    scales.learn(0, "a", predicted, used, 40.0)
    assert scales.expected(0, "a") == Scales().expected(0, "a")


def test_short_shifts_tell_less_than_long_ones():
    short, long = Scales(), Scales()
    short.learn(0, None, 2.0, 2.4, 40.0)
    long.learn(0, None, 40.0, 48.0, 40.0)
    assert 0.0 < short.expected(0)[0] < long.expected(0)[0] < np.log(1.2)


def test_what_is_read_from_the_charge_of_a_large_battery_tells_less():
    small, large = Scales(), Scales()
    small.learn(0, None, 5.0, 6.0, 20.0)
    large.learn(0, None, 5.0, 6.0, 200.0)
    assert 0.0 < large.expected(0)[0] < small.expected(0)[0]


def test_habits_need_a_few_shifts_and_are_in_the_middle_of_them():
    scales = Scales()
    for number, hours in enumerate((6.0, 8.0, 7.0)):
        assert np.isnan(scales.habit(0)).all() == (number < LEAST_SHIFTS)
        scales.went(0, Habit(hours, 1.0 + 0.1 * number))
    assert scales.habit(0) == pytest.approx((7.0, 1.1))
    assert np.isnan(scales.habit(1)).all()


def test_what_was_dumped_goes_on_as_if_nothing_had_happened():
    one, other = Scales(), Scales()
    week(np.random.default_rng(1), one)
    one.went(0, Habit(7.0, 1.0))
    other.load(one.dump())
    for scales in (one, other):
        week(np.random.default_rng(2), scales)
        scales.went(0, Habit(8.0, 1.2))
    assert one.dump() == other.dump()
