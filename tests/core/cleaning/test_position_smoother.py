"""Test the two-sided motion of cars without a speed, its odometer, and when filterpy is imported."""

import subprocess
import sys

import numpy as np
import pytest

from socast.core.cleaning.position_smoother import find_lengths, smooth_motion, smooth_path
from socast.core.cleaning.quality import Quality
from tests.core.cleaning.test_fix_motion import read
from tests.core.cleaning.test_position_filter import clean
from tests.support.telemetry import Columns, drive, without
from tests.support.town_drives import town_drive, with_noise


def smoothed(columns: Columns, period: float = 3.0):
    """Return the rows of one ride, causal and smoothed."""
    named = columns | {"ride_id": np.full(len(columns["time_s"]), "r", dtype=object)}
    rows, _ = clean(named, period)
    return rows, smooth_motion(rows)


def error_of_speed(rows, columns):
    """Return the root mean square error of the mean speed of the steps. [m/s]"""
    true = np.diff(columns["metres"], prepend=0.0) / np.diff(columns["time_s"], prepend=0.0)
    return float(np.sqrt(np.mean((rows.speed - true)[1:] ** 2)))


@pytest.mark.parametrize("period", [1.0, 3.0, 10.0])
@pytest.mark.parametrize(("sd", "time"), [(0.0, 0.0), (3.0, 0.0), (8.0, 0.0), (15.0, 0.0), (8.0, 100.0)])
def test_distance_and_speed_are_better_from_both_sides(period, sd, time):
    columns = with_noise(town_drive(2, period), sd, time)
    causal, rows = smoothed(columns, period)
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.03)
    assert error_of_speed(rows, columns) < 0.85 * error_of_speed(causal, columns)
    np.testing.assert_allclose(rows.speed * rows.travel, rows.distance, atol=1e-9)


def test_work_of_inertia_is_the_change_of_kinetic_energy():
    columns = with_noise(town_drive(3, 1.0), 3.0)
    _, rows = smoothed(columns, 1.0)
    assert abs(np.sum(rows.acceleration * rows.distance)) < 1.0  # from rest to rest
    sped_up = np.maximum(rows.acceleration * rows.distance, 0.0).sum()
    true = np.maximum(np.diff(0.5 * columns["v"] ** 2), 0.0).sum()
    assert sped_up == pytest.approx(true, rel=0.4)
    assert np.abs(rows.acceleration).max() < 6.0


def test_parked_rows_of_a_ride_cover_no_distance():
    columns = town_drive(4, 1.0, duration=300.0, park=170.0)
    parked = columns["metres"] == columns["metres"][-1]
    _, rows = smoothed(with_noise(columns, 5.0, 60.0), 1.0)
    late = np.flatnonzero(parked)[20:]
    assert rows.distance[late].sum() < 20.0
    assert rows.stopped[late].mean() > 0.9


@pytest.mark.parametrize("frozen", [True, False])
def test_hole_is_bridged_evenly_and_marked(frozen):
    columns = drive(400, speed=np.minimum(20.0, 1.5 * np.arange(400)))
    columns = without(columns, "speed_kmh")
    for name in ("latitude_deg", "longitude_deg"):
        columns[name][200:230] = columns[name][199] if frozen else np.nan
    _, rows = smoothed(columns)
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.01)
    np.testing.assert_allclose(rows.speed[200:231], 20.0, rtol=0.05)
    assert np.all(rows.quality[200:231] & Quality.BRIDGED)
    assert not np.any(rows.quality[240:] & Quality.BRIDGED)


@pytest.mark.parametrize("period", [30.0, 60.0])
def test_odometer_scales_the_distance_of_sparse_fixes(period):
    columns = town_drive(5, period, duration=6000.0)
    _, alone = smoothed(columns, period)
    _, rows = smoothed(columns | {"odometer_km": read(columns["metres"])}, period)
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.02)
    assert np.mean((alone.quality & Quality.BRIDGED) != 0) > 0.7
    assert np.mean((rows.quality & Quality.BRIDGED) != 0) < 0.2


def test_rows_of_cars_with_a_speed_stay_the_same():
    rows, _ = clean(drive(100))
    assert smooth_motion(rows) is rows


def test_perfect_fixes_of_uniform_motion_stay_what_they_are():
    dt = np.r_[0.0, np.full(20, 3.0)]
    north = 5.0 * np.cumsum(dt)
    nothing, everything = np.zeros(21, np.bool_), np.ones(21, np.bool_)
    path = smooth_path(dt, north, np.zeros(21), np.full(21, 1.0), everything, nothing)
    np.testing.assert_allclose(path[:, 0], north, atol=0.1)
    np.testing.assert_allclose(path[:, 1], 5.0, atol=0.1)


def test_length_of_a_quarter_of_a_circle_is_that_of_the_curve():
    way, before, after = np.array([[10.0, 10.0]]), np.array([[5.0, 0.0]]), np.array([[0.0, 5.0]])
    time = np.array([0.5 * np.pi * 10.0 / 5.0])
    assert find_lengths(time, way, before, after)[0] == pytest.approx(0.5 * np.pi * 10.0, rel=0.01)


@pytest.mark.parametrize(("names", "expected"), [((), False), (("speed_kmh",), True)])
def test_filterpy_is_imported_only_for_a_table_of_a_car_without_a_speed(names, expected):
    code = (
        "import sys; from tests.support.telemetry import drive, leaf, ran, telemetry, without\n"
        f"messages = [leaf(), *telemetry(without(drive(100), *{names!r}))]\n"
        "pipeline, _ = ran(messages, two_sided=True, keep_forecasts=False)\n"
        "assert len(pipeline.take_rides()) == 1\n"
        "print('filterpy' in sys.modules)"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert ended.stdout.strip() == str(expected)
