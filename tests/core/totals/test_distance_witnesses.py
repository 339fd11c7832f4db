"""Test that a distance which odometer, straight roads or the speeds of a slow logger contradict is not fit."""

import numpy as np
import pytest

from socast.core.cleaning.quality import Quality
from tests.support.telemetry import cleaned, count, drive, leaf, picked, ran, telemetry, without

N = 600
CONTRADICTED = "speed_contradicted"


def judge(columns, period=None):
    """Return the ride of a car that may announce its period."""
    pipeline, _ = ran([leaf(period_s=period) if period else leaf(), *telemetry(columns)])
    return pipeline.take_rides().iloc[0]


def check(columns, fits, slack=0.03):
    """Assert that a ride is fit, or else unfit or calibrated by its witnesses."""
    ride = judge(columns)
    if fits:
        assert ride["fit_for_training"]
    elif ride["unfit_reason"] != CONTRADICTED:
        assert ride["distance_km"] == pytest.approx(columns["metres"][-1] / 1000.0, rel=slack)


def metered(columns):
    """Add voltage and current, so that nothing else makes a ride unfit."""
    n = len(columns["time_s"])
    power = {"battery_voltage_v": np.full(n, 360.0), "battery_current_a": 20.0 + 0.1 * (np.arange(n) % 50)}
    return columns | power


@pytest.mark.parametrize(("factor", "fits"), [(0.90, False), (0.97, True), (1.0, True), (1.03, True), (1.10, False)])
def test_straight_roads_show_a_speed_that_is_scaled(factor, fits):
    columns = metered(drive(N, speed=14.0))
    columns["speed_kmh"] = columns["speed_kmh"] * factor
    check(columns, fits, 0.06)


@pytest.mark.parametrize(("factor", "fits"), [(0.95, False), (0.98, True), (1.0, True), (1.02, True), (1.05, False)])
@pytest.mark.parametrize("step", [0.1, 1.0])
def test_changes_of_the_odometer_show_a_speed_that_is_scaled(factor, fits, step):
    columns = metered(drive(N, speed=14.0))
    columns["odometer_km"] = np.floor(columns["metres"] / 1000.0 / step) * step
    columns["speed_kmh"] = columns["speed_kmh"] * factor
    check(without(columns, "latitude_deg", "longitude_deg") | {"metres": columns["metres"]}, fits)


@pytest.mark.parametrize(("factor", "fits"), [(0.75, False), (1.0, True), (1.3, False)])
def test_speeds_of_a_slow_logger_contradict_its_odometer(factor, fits):
    columns = metered(drive(800, speed=14.0))
    columns["odometer_km"] = np.floor(factor * columns["metres"] / 100.0) / 10.0
    columns = without(picked(columns, slice(None, None, 20)), "latitude_deg", "longitude_deg", "seq")
    assert (judge(columns, 60.0)["unfit_reason"] != CONTRADICTED) == fits


def test_standstill_of_a_receiver_without_fix_is_none_while_the_car_takes_power_of_driving():
    columns = without(metered(drive(N, speed=14.0)), "ride_id")
    blind = slice(200, 400)
    columns["speed_kmh"][blind] = 0.0
    columns["latitude_deg"][blind] = columns["longitude_deg"][blind] = np.nan
    columns["speed_kmh"][[198, 199, 200]] = 5.0  # the car was about to stop as the fix was lost
    waiting = columns | {"battery_current_a": np.where((np.arange(N) > 200) & (np.arange(N) < 400), 3.0, 20.0)}
    driving = columns | {"battery_current_a": np.where(np.arange(N) % 2, 60.0, 5.0)}
    assert len(set(cleaned(driving).ride[100:].tolist())) == 1
    assert len(set(cleaned(waiting).ride[100:].tolist())) > 1


def test_braking_of_a_car_whose_speed_is_stuck_at_zero_is_no_charging():
    columns = without(metered(drive(N, speed=14.0)), "ride_id", "latitude_deg", "longitude_deg")
    columns["speed_kmh"][200:260] = 0.0
    columns["battery_current_a"][210:220] = -30.0
    assert count(cleaned(columns), Quality.CHARGING_INFERRED) == 0
    columns["speed_kmh"][200:400] = 0.0
    columns["battery_current_a"][240:400] = -30.0
    assert count(cleaned(columns), Quality.CHARGING_INFERRED) > 100
