"""Test that the rest of a shift follows from the earlier shifts of the car."""

import numpy as np
import pytest

from socast.core.forecast.learning.shift_patterns import (
    KEPT_SHIFTS,
    LEAST_SHIFTS,
    NO_SHIFTS,
    SHIFT_PATTERNS,
    expect_rest,
    remember_shift,
)

HOURS = 3600.0


def remember(shifts):
    """Return what is known of a car, (1,) SHIFT_PATTERNS, from durations [h] and intensities."""
    patterns = np.full(1, NO_SHIFTS, SHIFT_PATTERNS)
    for hours, power in shifts:
        remember_shift(patterns[0], hours, power)
    return patterns


def expect(patterns, hours):
    """Return what is expected of the rest of the shift of the first car after some hours."""
    rest = expect_rest(patterns, np.array([hours * HOURS]))
    return [float(each[0]) for each in rest]


def test_few_shifts_say_nothing():
    for number in range(5):
        told = np.isfinite(expect(remember([(6.0, 1.0)] * number), 1.0))
        assert told.all() == (number >= LEAST_SHIFTS)


def test_rest_is_that_of_the_shifts_that_were_longer():
    """A car that has driven for two hours ends none of its short shifts any more."""
    patterns = remember([(0.5, 1.0)] * 5 + [(6.0, 0.8), (8.0, 1.2), (7.0, 1.0)])
    assert expect(patterns, 0.0)[0] == pytest.approx((5 * 0.5 + 21.0) / 8)
    hours, work, _ = expect(patterns, 2.0)
    assert hours == pytest.approx(5.0)
    assert work == pytest.approx((0.8 * 4.0 + 1.2 * 6.0 + 1.0 * 5.0) / 3)
    assert np.isnan(expect(patterns, 8.0)).all()


def test_uneven_shifts_are_less_certain_than_even_ones():
    even, uneven = remember([(6.0, 1.0)] * 10), remember([(2.0, 1.0), (10.0, 1.0)] * 5)
    assert expect(even, 0.0)[:2] == pytest.approx(expect(uneven, 0.0)[:2])
    assert expect(uneven, 0.0)[2] > 3.0 * expect(even, 0.0)[2]
    assert expect(uneven, 0.0)[2] == pytest.approx(4.0, rel=0.1)


def test_standard_deviation_is_that_of_the_next_shift():
    rng, misses, n = np.random.default_rng(1), [], 4000
    for _ in range(n):
        hours = rng.normal(6.0, 1.5, 11)
        _, work, sd = expect(remember([(each, 1.0) for each in hours[:10]]), 0.0)
        misses.append((hours[10] - work) / sd)
    assert np.std(misses) == pytest.approx(1.0, abs=0.1)


def test_only_the_newest_shifts_are_remembered():
    patterns = remember([(1.0, 1.0)] * KEPT_SHIFTS + [(5.0, 1.0)] * KEPT_SHIFTS)
    assert expect(patterns, 0.0)[0] == pytest.approx(5.0)


def test_any_number_of_cars_gives_the_same_bits():
    rng = np.random.default_rng(2)
    patterns, elapsed = np.full(50, NO_SHIFTS, SHIFT_PATTERNS), rng.uniform(0.0, 8.0, 50) * HOURS
    for lane in range(50):
        for _ in range(int(rng.integers(0, 30))):
            remember_shift(patterns[lane], rng.uniform(0.1, 9.0), rng.uniform(0.5, 1.5))
    together = expect_rest(patterns, elapsed)
    alone = [expect_rest(patterns[[lane]], elapsed[[lane]]) for lane in range(50)]
    for name in together._fields:
        apart = np.concatenate([getattr(each, name) for each in alone])
        assert apart.tobytes() == getattr(together, name).tobytes()
