"""Test that the change of the outside temperature within a day is learned."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.columns import SECONDS_PER_DAY
from socast.core.forecast.learning.daily_cycle import HOURS, DailyCycle
from socast.core.forecast.weather_forecasts import WeatherForecasts

KELVIN = 280.0


def wave(time):
    """Return a temperature with a daily cycle of 8 K, warmest at 20 h UTC. [°C]"""
    return 4.0 * np.cos(2.0 * np.pi * (time / 3600.0 - 20.0) / 24.0)


def learned(days, begin=0.0, hours=24.0, cars=3):
    """Return what shifts of some days teach; each day has a temperature of its own."""
    cycle, rng = DailyCycle(), np.random.default_rng(1)
    for day in range(days):
        level = rng.normal(0.0, 5.0)
        for _ in range(cars):
            time = SECONDS_PER_DAY * day + 3600.0 * begin + np.arange(0.0, 3600.0 * hours + 1.0, 600.0)
            cycle.add_shift(time, level + wave(time))
        cycle.apply_daily_update()
    return cycle


def expected(cycle, hour, ahead):
    now = np.array([50.0 * SECONDS_PER_DAY + 3600.0 * hour])
    return float(WeatherForecasts().expect_ambient(np.array([KELVIN]), now, now + 3600.0 * ahead, cycle)[0])


@pytest.mark.parametrize(("hour", "ahead"), [(8.0, 6.0), (12.0, 1.0), (20.0, 8.0), (23.0, 4.0)])
def test_mean_temperature_ahead_is_learned(hour, ahead):
    time = 3600.0 * (hour + np.linspace(0.0, ahead, 500))
    change = np.mean(wave(time)) - wave(3600.0 * hour)
    assert expected(learned(60), hour, ahead) - KELVIN == pytest.approx(change, abs=0.1 + 0.1 * abs(change))


def test_without_data_the_present_temperature_is_expected():
    assert expected(DailyCycle(), 9.0, 6.0) == KELVIN


def test_one_day_is_believed_in_part():
    one, many = (expected(learned(days), 8.0, 6.0) - KELVIN for days in (1, 60))
    assert 0.2 * many < one < 0.5 * many


def test_hours_without_shifts_change_nothing():
    cycle = learned(30, begin=10.0, hours=8.0)
    assert expected(cycle, 0.0, 6.0) == pytest.approx(KELVIN)
    assert expected(cycle, 10.0, 4.0) > KELVIN + 1.0


@given(st.floats(0.0, HOURS), st.floats(-5.0, 0.0))
def test_past_or_unknown_end_has_the_present_temperature(hour, ahead):
    cycle = learned(5)
    assert expected(cycle, hour, ahead) == pytest.approx(KELVIN)
    assert expected(cycle, hour, np.nan) == pytest.approx(KELVIN)


def test_jump_of_the_temperature_does_not_count():
    cycle, time = DailyCycle(), np.array([36_000.0, 36_600.0, 37_200.0])
    cycle.add_shift(time, np.array([-10.0, 15.0, 15.0]))
    cycle.apply_daily_update()
    assert expected(cycle, 10.0, 2.0) == KELVIN


def test_observations_that_come_at_once_count_like_a_sensor():
    """A car without a sensor has the temperature of the last hourly observation, in steps of up to 3 K."""
    cycle = DailyCycle()
    for day in range(60):
        time = SECONDS_PER_DAY * day + np.arange(0.0, SECONDS_PER_DAY, 600.0)
        cycle.add_shift(time, 3.0 * wave(3600.0 * np.floor(time / 3600.0)))
        cycle.apply_daily_update()
    change = 3.0 * (np.mean(wave(3600.0 * np.linspace(12.0, 16.0, 500))) - wave(3600.0 * 12.0))
    assert expected(cycle, 12.0, 4.0) - KELVIN == pytest.approx(change, rel=0.1)


def test_loaded_state_continues_as_uninterrupted():
    one, other = learned(4), DailyCycle()
    time = 4.5 * SECONDS_PER_DAY + np.arange(0.0, 10_800.0, 600.0)
    one.add_shift(time, wave(time))
    other.load(one.dump())
    for each in (one, other):
        each.apply_daily_update()
    assert one.dump() == other.dump()
    assert expected(one, 12.0, 3.0) == expected(other, 12.0, 3.0)
