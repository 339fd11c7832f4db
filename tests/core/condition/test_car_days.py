"""Rides are summed to car-days, and what all cars of a date share is taken off."""

import numpy as np
import pandas as pd
import pytest

from socast.core.condition.car_days import estimate_day_noise, gather_car_days, subtract_siblings
from socast.core.errors import ModelError
from socast.core.evaluate.compare.models import ComparedRides
from socast.tools.bench.condition_fleets import make_fleet


def rides(days=8, cars=("b", "a"), **columns):
    """Return rides of 2 kWh that lower the display by 10 %, two for each car and day."""
    rows = [(car, f"2020-01-{day + 1:02}") for day in range(days) for car in cars for _ in range(2)]
    frame = pd.DataFrame(rows, columns=["vehicle_id", "date"])
    same = {"vehicle_model": "m", "nominal_capacity_kwh": 20.0, "energy_kwh": 2.0, "energy_vi_kwh": 2.0}
    frame = frame.assign(**same, soc_start_pct=60.0, soc_end_pct=50.0, ambient_c=10.0)
    return frame.assign(**columns)


def compared(frame, measured=2.0, predicted=2.0):
    n = len(frame)
    clusters = np.arange(n)
    return ComparedRides(frame, np.full(n, measured), {"m": np.full(n, predicted)}, clusters, n, {})


def test_car_day_is_the_energy_of_its_rides_over_the_prediction():
    days = gather_car_days(compared(rides(), measured=2.2), "m")
    assert days.cars == ["a", "b"]
    assert days.consumption.value == pytest.approx(np.full((2, 8), np.log(1.1)))
    assert days.consumption.amount == pytest.approx(np.full((2, 8), 4.0))


def test_noise_of_the_meter_is_known_variance():
    frame = rides(energy_vi_kwh=np.nan, energy_soc_noise_kwh=0.1)
    days = gather_car_days(compared(frame), "m")
    assert days.consumption.extra == pytest.approx(np.full((2, 8), 2 * 0.1**2 / 4.0**2))
    assert (days.capacity.extra == 0.0).all()


def test_days_far_off_count_less_as_siblings():
    fleet = make_fleet(1)
    fleet.value[2, 30] = fleet.value[2, 29] + 0.8
    noise = estimate_day_noise(fleet, ["m"] * 8)
    assert noise[2, 30] > 20.0 * np.median(noise[2])


def test_capacity_is_the_energy_over_the_fall_of_the_display():
    days = gather_car_days(compared(rides(soc_end_pct=48.0)), "m")
    assert days.capacity.value == pytest.approx(np.full((2, 8), np.log(2.0 / 0.12 / 20.0)))
    cold = gather_car_days(compared(rides(ambient_c=-5.0)), "m")
    assert cold.cold == pytest.approx(np.full((2, 8), 15.0))


def test_unmeasured_and_impossible_days_are_unknown():
    days = gather_car_days(compared(rides(energy_vi_kwh=np.nan), measured=9.0), "m")
    assert np.isnan(days.consumption.value).all()
    assert np.isnan(days.capacity.value).all()


def test_absent_columns_are_unknown():
    days = gather_car_days(
        compared(rides().drop(columns=["energy_vi_kwh", "nominal_capacity_kwh", "soc_end_pct"])), "m"
    )
    assert np.isfinite(days.consumption.value).all()
    assert np.isnan(days.capacity.value).all()


def test_car_days_without_energy_are_counted():
    frame = rides()
    table = compared(frame)
    table.predicted["m"][:4] = 0.01  # of both cars on the first date
    days = gather_car_days(table, "m")
    assert (days.left_out, days.energy_left_out) == (2, pytest.approx(1.0 / 8.0))


def test_few_dates_are_refused_with_the_number_and_the_limit():
    with pytest.raises(ModelError, match="of 5 dates, and a condition takes 6: give more days"):
        gather_car_days(compared(rides(days=5)), "m")


def test_what_all_cars_share_is_taken_off_and_levels_stay():
    fleet = make_fleet(1)
    apart = subtract_siblings(fleet, ["m"] * 8)
    shared = fleet._replace(value=fleet.value + np.linspace(-0.2, 0.2, 120))
    again = subtract_siblings(shared, ["m"] * 8)
    enough = np.isfinite(fleet.value).sum(axis=0) >= 3
    moved = (again.value - apart.value)[:, enough]
    assert np.nanmax(np.abs(moved - np.nanmean(moved))) < 0.02  # the level of each car is its median


def test_siblings_count_without_their_steps():
    fleet = make_fleet(1, cars=3, step=0.3)
    plain = make_fleet(1, cars=3)
    apart = subtract_siblings(fleet, ["m"] * 3, without=plain.value)
    assert apart.value[1:] == pytest.approx(subtract_siblings(plain, ["m"] * 3).value[1:], nan_ok=True)
    assert np.nanmean((apart.value - plain.value)[0, 60:]) > 0.2


def test_car_without_siblings_is_as_it_is():
    fleet = make_fleet(2, cars=2)
    apart = subtract_siblings(fleet, ["m", "n"])
    assert apart.value == pytest.approx(fleet.value, nan_ok=True)
    assert (apart.extra == 0.0).all()
