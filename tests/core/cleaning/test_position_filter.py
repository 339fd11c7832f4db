"""Test the filter of positions: against filterpy, its noise, and what it makes of parked cars and far fixes."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.cleaning import position_filter
from socast.core.cleaning.kernel import STATE, Cleaner, new_lane_state
from socast.core.cleaning.position_smoother import OF_FIX, describe_motion, make_filter
from socast.core.cleaning.quality import Quality
from socast.core.settings import Settings
from tests.support.telemetry import Columns, count, decoded, picked, telemetry, without
from tests.support.town_drives import town_drive, with_noise


def clean(columns: Columns, period: float = 3.0, cuts=()):
    """Return the cleaned rows of one car and the state of its lane, of messages that arrive in parts."""
    cleaner, edges = Cleaner(Settings()), [0, *cuts, len(columns["time_s"])]
    messages = telemetry(without(columns, "v"))
    parts = [cleaner.clean(decoded(messages[a:b]), 1, period=period) for a, b in pairwise(edges)]
    joined = type(parts[0])(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    return joined, cleaner.state[0]


# Against filterpy


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_filter_equals_filterpy_step_by_step(seed):
    rng = np.random.default_rng(seed)
    state = np.zeros(1, STATE).view(np.recarray)[0]
    state.path_noise = 16.0
    position_filter.restart_path.py_func(state, 0.0, 0.0)
    kalman = make_filter(0.0, 0.0, 4.0)
    for dt, sd in zip(rng.choice([0.4, 1.0, 3.0, 30.0], 50), rng.uniform(1.0, 20.0, 50), strict=True):
        fix = kalman.x[::2] + rng.normal(0.0, 30.0, 2)
        transition, process = describe_motion(dt)
        kalman.predict(F=transition, Q=process)
        kalman.update(fix, R=sd**2 * np.eye(2), H=OF_FIX)
        position_filter.predict_path.py_func(state, dt)
        position_filter.update_path.py_func(state, *fix, sd**2)
        found = [state.path_north, state.path_to_north, state.path_east, state.path_to_east]
        np.testing.assert_allclose(found, kalman.x, rtol=1e-9, atol=1e-9)
        covariance = [state.path_pp, state.path_pv, state.path_vv]
        for axis in (kalman.P[:2, :2], kalman.P[2:, 2:]):
            np.testing.assert_allclose(covariance, axis[[0, 0, 1], [0, 1, 1]], rtol=1e-7)
        np.testing.assert_allclose(kalman.P[:2, 2:], 0.0, atol=1e-9)


# Noise


@pytest.mark.parametrize("period", [1.0, 3.0, 10.0])
@pytest.mark.parametrize("sd", [3.0, 8.0, 15.0])
def test_noise_of_fixes_is_estimated(period, sd):
    columns = with_noise(town_drive(1, period, duration=max(600.0, 200.0 * period)), sd)
    found = clean(columns, period)[0].fix_sd
    assert np.median(found[len(found) // 3 :]) == pytest.approx(sd, rel=0.25)


def test_noise_of_perfect_fixes_is_the_least():
    assert clean(town_drive(1, 1.0), 1.0)[0].fix_sd[-1] == position_filter.LEAST_NOISE


# Distance


@pytest.mark.parametrize("period", [1.0, 3.0, 10.0])
@pytest.mark.parametrize(("sd", "time"), [(0.0, 0.0), (3.0, 0.0), (8.0, 0.0), (15.0, 0.0), (8.0, 100.0)])
def test_distance_is_right_with_noise_of_fixes(period, sd, time):
    columns = with_noise(town_drive(2, period, duration=1200.0), sd, time)
    rows, state = clean(columns, period)
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.03)
    assert state["path_distance"] == pytest.approx(columns["metres"][-1], rel=0.03)
    assert (rows.speed * rows.travel)[rows.distance > 0].sum() == pytest.approx(rows.distance.sum())


# Parked cars


@pytest.mark.parametrize("period", [1.0, 3.0, 10.0, 30.0])
@pytest.mark.parametrize(("sd", "time"), [(5.0, 0.0), (15.0, 0.0), (25.0, 0.0), (10.0, 120.0)])
def test_parked_car_hardly_moves(period, sd, time):
    columns = town_drive(3, 1.0, duration=1.0, park=1800.0)
    columns = picked(columns, slice(-int(1800 / 1.0), None, int(period)))
    columns["seq"] = np.arange(len(columns["time_s"]))
    rows, _ = clean(with_noise(columns, sd, time, rows=slice(20, None)), period)
    assert rows.distance.sum() < 600.0  # of up to 84 km between the fixes
    assert count(rows, Quality.POSITION_DRIFT) > 0.1 * len(rows.dt)
    assert np.mean(rows.stopped) > 0.95


@pytest.mark.parametrize("rest", [30.0, 300.0, 1800.0])
def test_drift_at_a_stop_ends_the_ride_as_a_still_fix_does(rest):
    first, second = town_drive(4, duration=400.0, park=rest), town_drive(5, duration=400.0)
    at = len(first["time_s"])
    second["time_s"] = second["time_s"] + first["time_s"][-1] - second["time_s"][0] + 3.0
    for name in ("latitude_deg", "longitude_deg", "metres"):
        second[name] = second[name] + first[name][-1] - second[name][0]
    columns = {name: np.concatenate([first[name], second[name]]) for name in first}
    columns["seq"] = np.arange(len(columns["time_s"]))
    drifting = with_noise(columns, 10.0, 120.0, rows=slice(at - int(rest / 3.0), at))
    rows = clean(drifting)[0]
    rides = [rows.distance[rows.ride == ride].sum() for ride in range(int(rows.ride.max()) + 1)]
    assert sum(length > 500.0 for length in rides) == (1 if rest < 180.0 else 2)
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.04)


# Far fixes


@pytest.mark.parametrize("still", [True, False], ids=["frozen", "moving"])
@pytest.mark.parametrize("degrees", [40.0, 0.05])
def test_far_fixes_for_a_minute_add_no_distance_and_lose_none(degrees, still):
    columns = town_drive(6, 1.0)
    rows = slice(300, 390)
    for name in ("latitude_deg", "longitude_deg"):
        columns[name] = columns[name].copy()
        columns[name][rows] = (columns[name][300] if still else columns[name][rows]) + degrees
    result, _ = clean(columns, 1.0)
    assert result.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.03)
    assert count(result, Quality.POSITION_JUMP) >= 2
    assert np.degrees(np.ptp(result.latitude)) < 0.2


def test_place_where_fixes_stay_is_believed_after_some_minutes():
    columns = town_drive(7, duration=2000.0)
    columns["latitude_deg"] = columns["latitude_deg"] + np.where(np.arange(len(columns["seq"])) < 50, 0.0, 1.0)
    result, _ = clean(columns)
    assert result.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.03)
    assert np.degrees(result.latitude[-1]) == pytest.approx(columns["latitude_deg"][-1], abs=1e-3)


# Causality


@settings(max_examples=10)
@given(cuts=st.lists(st.integers(1, 290), unique=True, max_size=5).map(sorted), sd=st.sampled_from([0.0, 8.0]))
def test_any_division_of_the_input_gives_the_same_rows(cuts, sd):
    columns = picked(with_noise(town_drive(8), sd), slice(0, 300))
    whole, state = clean(columns)
    parts, same = clean(columns, cuts=cuts)
    for name, one, other in zip(whole._fields, whole, parts, strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)
    assert state.tobytes() == same.tobytes()


def test_new_lane_has_no_path():
    state = new_lane_state(1)[0]
    assert all(np.isnan(state[name]) for name in position_filter.UNKNOWN_AT_FIRST)
