"""Test the motion of cars without a speed where their odometer is a witness."""

import numpy as np
import pytest

from socast.core.cleaning.quality import Quality
from tests.core.cleaning.test_position_filter import clean
from tests.support.telemetry import count
from tests.support.town_drives import town_drive, with_noise


def read(metres, step=100.0, share=1.0):
    """Return what an odometer shows, in whole steps. [km]"""
    return np.floor((12_000_000.0 + share * metres) / step) * step / 1000.0


def test_constant_odometer_limits_the_distance_of_a_drifting_car():
    columns = town_drive(1, 1.0, duration=300.0, park=1800.0)
    parked = columns["metres"] == columns["metres"][-1]
    drifting = with_noise(columns, 25.0, 60.0, rows=parked)
    alone, _ = clean(drifting, 1.0)
    witnessed, _ = clean(drifting | {"odometer_km": read(columns["metres"])}, 1.0)
    excess = witnessed.distance.sum() - columns["metres"][-1]
    assert -100.0 < excess < 300.0
    assert witnessed.distance.sum() <= alone.distance.sum()


def test_odometer_that_is_stuck_does_not_stop_the_car():
    columns = town_drive(2, duration=1500.0)
    odometer = read(columns["metres"])
    odometer[150:] = odometer[150]
    rows, _ = clean(columns | {"odometer_km": odometer})
    assert columns["metres"][-1] - rows.distance.sum() < 700.0


@pytest.mark.parametrize("step", [100.0, 1000.0])
def test_odometer_adds_what_sparse_fixes_miss(step):
    columns = town_drive(3, 30.0, duration=6000.0)
    rows, _ = clean(columns | {"odometer_km": read(columns["metres"], step)}, 30.0)
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.03)


def test_sparse_fixes_without_an_odometer_are_marked():
    columns = town_drive(3, 30.0, duration=3000.0)
    rows, _ = clean(columns, 30.0)
    bridged = (rows.quality & Quality.BRIDGED) != 0
    assert rows.distance[bridged].sum() > 0.9 * rows.distance.sum()


def test_odometer_in_miles_does_not_scale_the_distance():
    columns = town_drive(4, duration=1500.0)
    for share in (0.621, 1.609):
        rows, _ = clean(columns | {"odometer_km": read(columns["metres"], 100.0, share)})
        assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.03), share


def test_odometer_shows_the_distance_of_missing_fixes():
    columns = town_drive(5, duration=1500.0)
    for name in ("latitude_deg", "longitude_deg"):
        columns[name] = np.where((np.arange(len(columns["seq"])) // 100) % 2 == 1, np.nan, columns[name])
    rows, _ = clean(columns | {"odometer_km": read(columns["metres"])})
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.03)
    assert count(rows, Quality.POSITION_MISSING) > 100


def test_car_that_sends_a_speed_later_is_measured_by_it():
    columns = town_drive(6)
    speed = np.where(np.arange(len(columns["v"])) < 100, np.nan, columns["v"] * 3.6)
    rows, _ = clean(columns | {"speed_kmh": speed})
    assert not np.isnan(rows.fix_sd[1:100]).any()
    assert np.isnan(rows.fix_sd[100:]).all()
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.03)
