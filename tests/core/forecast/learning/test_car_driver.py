"""Test that planted consumption factors of cars and drivers are recovered."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from socast.core.forecast.filter_state import CAPACITY_SD
from socast.core.forecast.learning import car_driver as module
from socast.core.forecast.learning.car_driver import (
    CAR_CHANGE_SHIFTS,
    CAR_SD,
    DAY_FACTOR_SD,
    DRIVER_SD,
    LARGEST_LOG_ERROR,
    ConsumptionFactors,
    compute_driver_code,
)


def week(rng, factors, days=30, cars=(0.15, -0.1), drivers=(0.08, -0.08)):
    """Add shifts of two drivers who change cars every day."""
    for day in range(days):
        for lane, car in enumerate(cars):
            who = (day + lane) % 2
            used = 20.0 * np.exp(car + drivers[who] + DAY_FACTOR_SD * rng.normal())
            factors.add_shift(lane, who, 20.0, used, 40.0)


def test_consumption_factor_is_kept_from_shift_to_shift():
    factors, before = ConsumptionFactors(), ConsumptionFactors().expect(0)
    for _ in range(20):
        factors.add_shift(0, None, 20.0, 24.0, 40.0)
    mean, variance = factors.expect(0)
    assert mean == pytest.approx(np.log(1.2), abs=0.02)
    assert DAY_FACTOR_SD**2 < variance < before[1]
    assert factors.expect(1) == before == (0.0, CAR_SD**2 + CAPACITY_SD**2 + DRIVER_SD**2 + DAY_FACTOR_SD**2)


def test_cars_and_drivers_are_distinguished():
    inside = []
    for seed in range(60):
        factors = ConsumptionFactors()
        week(np.random.default_rng(seed), factors)
        for lane, car in enumerate((0.15, -0.1)):
            for who, driver in enumerate((0.08, -0.08)):
                mean, variance = factors.expect(lane, who)
                inside.append(abs(mean - car - driver) < 1.645 * np.sqrt(variance - DAY_FACTOR_SD**2))
                assert mean == pytest.approx(car + driver, abs=0.08)
    assert np.mean(inside) > 0.75


def balance(predicted, driver):
    """Return the variance of a car at which the gain of a shift equals the growth until the next one."""
    noise = (
        driver
        + DAY_FACTOR_SD**2
        + module.ENERGY_SD**2 / predicted
        + (module.DEFAULT_QUANTUM * 40.0 / predicted) ** 2 / 6.0
    )
    drift = CAR_SD**2 / CAR_CHANGE_SHIFTS
    return 0.5 * (drift + np.sqrt(drift**2 + 4.0 * drift * noise))


@given(st.floats(1.0, 60.0), st.booleans())
def test_variance_falls_with_every_shift_to_its_equilibrium(predicted, driven):
    factors, last = ConsumptionFactors(), ConsumptionFactors().expect(0)[1]
    floor = balance(predicted, 0.0 if driven else DRIVER_SD**2) + DRIVER_SD**2 + DAY_FACTOR_SD**2
    for _ in range(300):
        factors.add_shift(0, 1 if driven else None, predicted, predicted, 40.0)
        variance = factors.expect(0)[1]
        assert variance <= last * (1.0 + 1e-12)
        assert variance >= floor * (1.0 - 1e-9)
        last = variance
    assert driven or last == pytest.approx(floor, rel=1e-3)


@given(st.lists(st.tuples(st.floats(0.02, 60.0), st.floats(0.6, 1.7), st.none() | st.integers(0, 1)), max_size=30))
@example([(0.02, 1.0, 0)])
def test_variance_never_exceeds_that_of_an_unknown_car(shifts):
    factors = ConsumptionFactors()
    for predicted, ratio, driver in shifts:
        factors.add_shift(0, driver, predicted, ratio * predicted, 40.0)
        for who in (None, 0, 1):
            assert factors.expect(0, who)[1] <= ConsumptionFactors().expect(0)[1]


@pytest.mark.parametrize("driven", [False, True])
def test_filter_follows_a_car_that_changes(driven):
    """After a year with the same tyres the car gets others, and uses a tenth more."""
    late = []
    for seed in range(40):
        rng, factors = np.random.default_rng(seed), ConsumptionFactors()
        for number in range(265):
            off = 0.0 if number < 250 else np.log(1.1)
            used = 20.0 * np.exp(off + DAY_FACTOR_SD * rng.normal())
            factors.add_shift(0, number % 3 if driven else None, 20.0, used, 40.0)
            if number in (249, 264):
                late.append(factors.expect(0)[0])
    before, after = np.reshape(late, (-1, 2)).T
    assert before.mean() == pytest.approx(0.0, abs=0.01)
    assert 0.75 < np.mean(after - before) / np.log(1.1) < 1.0
    assert np.std(before) < 0.03


@pytest.mark.parametrize(
    ("predicted", "used"),
    [(0.0, 5.0), (-1.0, 5.0), (5.0, 0.0), (5.0, -2.0), (5.0, 5.0 * np.exp(LARGEST_LOG_ERROR) * 1.01), (np.nan, 1.0)],
)
def test_implausible_shift_is_ignored(predicted, used):
    factors = ConsumptionFactors()
    factors.add_shift(0, 1, predicted, used, 40.0)
    assert factors.expect(0, 1) == ConsumptionFactors().expect(0, 1)


def test_short_shift_has_less_weight_than_long_one():
    short, long = ConsumptionFactors(), ConsumptionFactors()
    short.add_shift(0, None, 2.0, 2.4, 40.0)
    long.add_shift(0, None, 40.0, 48.0, 40.0)
    assert 0.0 < short.expect(0)[0] < long.expect(0)[0] < np.log(1.2)


def test_energy_read_from_a_large_battery_has_less_weight():
    small, large = ConsumptionFactors(), ConsumptionFactors()
    small.add_shift(0, None, 5.0, 6.0, 20.0)
    large.add_shift(0, None, 5.0, 6.0, 200.0)
    assert 0.0 < large.expect(0)[0] < small.expect(0)[0]


def test_loaded_state_continues_as_uninterrupted():
    one, other = ConsumptionFactors(), ConsumptionFactors()
    week(np.random.default_rng(1), one)
    other.load(one.dump())
    for factors in (one, other):
        week(np.random.default_rng(2), factors)
    assert one.dump() == other.dump()


# number of remembered drivers


@given(st.lists(st.integers(0, 9), max_size=40))
@example([0, 1, 0, 2, 3, 3])
def test_drivers_with_oldest_shifts_are_forgotten(shifts):
    factors = ConsumptionFactors()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "KEPT_DRIVERS", 2)
        patched.setattr(module, "DRIVERS_PER_CAR", 1)
        for number, driver in enumerate(shifts):
            factors.add_shift(0, driver, 20.0, 24.0, 40.0)
            if number == len(shifts) // 2:
                factors.load(factors.dump())
    last = list(dict.fromkeys(reversed(shifts)))[:3]
    known = [driver for driver in range(10) if factors.get_driver(driver) != (0.0, DRIVER_SD**2)]
    assert known == sorted(last)


def test_driver_codes_are_unique_and_exact_as_float():
    codes = {compute_driver_code(f"driver-{number}") for number in range(20_000)}
    assert len(codes) == 20_000
    assert all(int(float(code)) == code >= 0 for code in codes)
    assert compute_driver_code("ana") == 136_244_865_965_049


@pytest.mark.parametrize("loss", [0.0, 0.004])
def test_share_that_a_cold_battery_lacks_is_recovered(loss):
    factors, rng = ConsumptionFactors(), np.random.default_rng(3)
    for number in range(600):
        celsius = float(rng.uniform(-20.0, 25.0))
        ratio = np.exp(loss * max(10.0 - celsius, 0.0) + 0.06 * rng.normal())
        factors.add_shift(number % 12, None, 20.0, 20.0 * ratio, 40.0, celsius)
    assert factors.expect_cold_loss(np.array([-10.0, 10.0, np.nan])) == pytest.approx([20.0 * loss, 0.0, 0.0], abs=0.02)
