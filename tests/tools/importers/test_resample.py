"""Resampling uneven rows to evenly spaced samples keeps the integrals."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from socast.tools.importers.drive import (
    LONGEST_HOLD,
    Drive,
    compute_window_means,
    find_valid_rows,
    make_grid,
    make_samples,
    sort_drives,
)


def make_drive(elapsed, start=1e9, ride="r", **rows):
    elapsed = np.asarray(elapsed, float)
    return Drive(
        "car", "bmw-i3-2014", ride, start, elapsed, {k: np.asarray(v, float) for k, v in rows.items()}, "f.csv"
    )


UNEVEN_TIMES = st.lists(st.floats(0.1, 20.0), min_size=1, max_size=60).map(lambda steps: np.cumsum([0.0, *steps]))


@settings(max_examples=60, deadline=None)
@given(UNEVEN_TIMES, st.floats(0.5, 8.0), st.data())
def test_trapezoid_over_samples_equals_integral_of_rows(times, period, data):
    values = data.draw(arrays(float, len(times), elements=st.floats(-500, 500)))
    at = make_grid(times[-1], period)
    width = at[1] - at[0]
    means = compute_window_means(times, values, at, width)
    scale = np.abs(values).max() * times[-1] + 1
    assert abs(np.trapezoid(means, at) - values[:-1] @ np.diff(times)) <= 1e-9 * scale
    assert np.all((means >= values.min() - 1e-6) & (means <= values.max() + 1e-6))
    assert abs(width - period) <= period / 2 or len(at) == 2


@settings(max_examples=40, deadline=None)
@given(UNEVEN_TIMES, st.data())
def test_means_leave_out_unknown_values(times, data):
    values = data.draw(arrays(float, len(times), elements=st.sampled_from([7.0, np.nan])))
    means = compute_window_means(times, values, make_grid(times[-1], 3.0), 3.0)
    assert np.all(np.isnan(means) | (np.abs(means - 7.0) < 1e-6))
    assert np.isnan(means).all() == np.isnan(values[:-1]).all()


def test_rows_are_not_valid_in_gaps():
    times = np.array([0.0, 10.0, 10.0 + LONGEST_HOLD + 1, 100.0])
    assert find_valid_rows(times, np.array([-1.0, 5.0, 10.0, 12.0, 41.0, 99.0])).tolist() == [-1, 0, 1, -1, 2, -1]
    assert np.isnan(compute_window_means(times, np.ones(4), np.array([25.0]), 3.0)).all()


def test_gap_has_no_samples_and_counter_continues():
    sent = make_samples(make_drive([*range(31), *range(120, 151)], speed_kmh=[50.0] * 62), 3.0)
    stamps = np.array([s.time_s for s in sent]) - 1e9
    assert not np.any((stamps > 30) & (stamps < 120))
    assert [s.seq for s in sent] == [round(t / 3) for t in stamps]
    assert len(sent) == 22


def test_power_of_samples_integrates_to_energy_when_voltage_and_current_correlate():
    t = np.arange(0, 60.01, 0.1)
    amperes = 100 * np.sin(t) + 20
    volts = 390 - 0.2 * amperes
    sent = make_samples(make_drive(t, battery_voltage_v=volts, battery_current_a=amperes), 3.0)
    power = [s.battery_voltage_v * s.battery_current_a for s in sent]
    energy = (volts * amperes)[:-1] @ np.diff(t)
    assert np.trapezoid(power, [s.time_s for s in sent]) == pytest.approx(energy, rel=1e-5)


def test_drive_of_one_row_gives_one_sample():
    (only,) = make_samples(make_drive([0.0], speed_kmh=[12.0], battery_voltage_v=[400.0], battery_current_a=[3.0]), 3.0)
    assert (only.speed_kmh, only.battery_voltage_v, only.battery_current_a) == (12.0, 400.0, 3.0)


def test_unknown_numbers_are_sent_as_null():
    (only,) = make_samples(make_drive([0.0], speed_kmh=[np.nan], soc_pct=[np.inf]), 3.0)
    assert only.speed_kmh is None
    assert only.soc_pct is None


def test_overlapping_trips_of_a_car_are_moved_apart_with_a_note():
    first = make_drive([0.0, 60.0], start=100.0, ride="a")
    second = make_drive([0.0, 60.0], start=130.0, ride="b")
    other = make_drive([0.0, 60.0], start=130.0, ride="c")._replace(vehicle_id="other")
    placed = {d.ride_id: d for d in sort_drives([second, other, first])}
    assert (placed["a"].start, placed["b"].start, placed["c"].start) == (100.0, 161.0, 130.0)
    assert "moved by 31 s" in placed["b"].notes[0]
    assert not placed["a"].notes + placed["c"].notes
