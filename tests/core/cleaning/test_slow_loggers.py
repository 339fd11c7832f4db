"""Test loggers with a period other than 3 s, and those without one: time, distance, energy and its uncertainty."""

import numpy as np
import pandas as pd
import pytest

from socast.core.cleaning.clock import LONGEST_SILENCE
from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.meters import find_variance_factor
from socast.core.cleaning.quality import Quality
from socast.core.columns import EARTH_RADIUS
from socast.core.settings import Settings
from tests.support.real_fits import DATA
from tests.support.telemetry import PLACE, START, count, decoded, drive, leaf, picked, ran, telemetry

N = 4000
SPEED = 45.0 + 35.0 * np.sin(np.arange(N) / 60.0)
"""Speed of a drive at samples every second. [km/h]"""


def second_by_second(**columns):
    """Return a drive with a sample every second, its odometer, and a current that follows the speed."""
    metres = np.concatenate([[0.0], np.cumsum((SPEED[1:] + SPEED[:-1]) / 7.2)])
    made = drive(N, speed=SPEED / 3.6, battery_voltage_v=360.0, battery_current_a=4.0 + 0.9 * SPEED, **columns)
    made |= {"time_s": START + np.arange(N), "odometer_km": metres / 1000.0, "metres": metres}
    return made | {"latitude_deg": PLACE[0] + np.degrees(metres / EARTH_RADIUS)}


def clean(columns, period):
    """Return the cleaned samples of a car that has announced its period."""
    return Cleaner(Settings()).clean(decoded(telemetry(columns)), 1, period=period)


def changes(columns, least=2.0):
    """Return the rows at which the speed has changed by some km/h since the last such row, or a minute has passed."""
    sent = [0]
    for i in range(1, N):
        if abs(columns["speed_kmh"][i] - columns["speed_kmh"][sent[-1]]) >= least or i - sent[-1] >= LONGEST_SILENCE:
            sent.append(i)
    rows = picked(columns, sent)
    return rows | {"seq": np.arange(len(sent))}


@pytest.mark.parametrize("announced", [True, False])
@pytest.mark.parametrize("counter", [True, False])
@pytest.mark.parametrize("period", [1, 2, 5, 10, 30, 60])
def test_any_period_keeps_time_and_distance(period, counter, announced):
    columns = picked(second_by_second(), slice(None, None, period))
    columns["seq"] = np.arange(len(columns["seq"])) if counter else np.full(len(columns["seq"]), np.nan)
    rows = clean(columns, float(period) if announced else np.nan)
    late = slice(20, None)  # without counter and announcement, a period is found after ten samples
    assert np.diff(rows.time[late]) == pytest.approx(period, abs=0.08 * period)
    driven = columns["metres"][-1] - columns["metres"][19]
    assert rows.distance[late].sum() == pytest.approx(driven, rel=0.01)
    assert rows.metered[late] == pytest.approx(period, abs=0.08 * period)
    assert not (rows.quality[late] & Quality.BRIDGED).any()


def test_logger_without_period_keeps_its_stamps_distance_and_energy():
    columns = changes(second_by_second())
    steps = np.diff(columns["time_s"])
    assert steps.min() < 5.0 < 15.0 < steps.max()
    rows = clean(columns, 0.0)
    assert rows.time.tolist() == columns["time_s"].tolist()
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.01)
    true = 360.0 * (4.0 + 0.9 * SPEED[: int(steps.sum())]).sum()
    assert rows.energy.sum() == pytest.approx(true, rel=0.02)
    assert count(rows, Quality.GAP | Quality.CLOCK_STEP | Quality.REPAIRED_TIME) == 0


def test_logger_without_period_is_found_where_stamps_contradict_the_counter():
    columns = drive(400)
    columns["time_s"] = START + np.cumsum(np.random.default_rng(3).choice([1.0, 1.0, 2.0, 2.5, 9.0, 25.0], 400))
    rows = clean(columns, np.nan)
    late = slice(60, None)
    assert rows.time[late].tolist() == columns["time_s"][late].tolist()
    assert rows.dt[late].tolist() == np.diff(columns["time_s"])[59:].tolist()


@pytest.mark.parametrize("lost", [0.0, 0.3, 0.6])
def test_logger_with_period_keeps_it_whatever_is_lost(lost):
    columns = drive(2000)
    rng = np.random.default_rng(8)
    columns["time_s"] += rng.normal(0.0, 0.5, 2000)
    rows = clean(picked(columns, rng.uniform(size=2000) >= lost), np.nan)
    away = (rows.time - START + 1.5) % 3.0 - 1.5
    assert np.abs(away[50:]).max() < 1.0


def test_stamps_of_logger_without_period_are_checked():
    columns = changes(second_by_second())
    at = len(columns["time_s"]) // 2
    columns["time_s"][at] -= 500.0
    columns["time_s"][at + 5] += 1e6
    rows = clean(columns, 0.0)
    assert rows.quality[at] & Quality.LATE
    assert rows.quality[at + 5] & Quality.REPAIRED_TIME
    assert rows.dt[[at, at + 5]].tolist() == [0.0, 0.0]
    assert rows.time[-1] == columns["time_s"][-1]
    assert rows.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.01)


def test_clock_of_logger_without_period_may_be_set_back():
    columns = changes(second_by_second())
    at = len(columns["time_s"]) // 2
    columns["time_s"][at:] -= 4000.0
    rows = clean(columns, 0.0)
    assert rows.time[-1] == columns["time_s"][-1]
    assert count(rows, Quality.CLOCK_STEP) == 1


def test_silence_of_logger_without_period_is_a_gap():
    columns = changes(second_by_second())
    at = len(columns["time_s"]) // 2
    columns["time_s"][at:] += 2.0 * LONGEST_SILENCE
    rows = clean(columns, 0.0)
    assert np.flatnonzero(rows.quality & Quality.GAP).tolist() == [at]
    assert rows.metered[at] == 0.0


def test_period_may_be_announced_after_the_first_samples():
    columns = picked(second_by_second(), slice(None, None, 30))
    columns["seq"] = np.full(len(columns["seq"]), np.nan)
    period = np.where(np.arange(len(columns["seq"])) < 4, np.nan, 30.0)
    rows = clean(columns, period)
    assert np.diff(rows.time[5:]) == pytest.approx(30.0, abs=0.1)


@pytest.mark.parametrize(("period", "counted"), [(0.05, 1), (61.0, 1), (-1.0, 1), (0.0, 0), (10.0, 0), (60.0, 0)])
def test_announced_period_has_limits(period, counted):
    columns = picked(second_by_second(), slice(None, None, 10))
    pipeline, _ = ran([leaf(period_s=period), *telemetry(columns)], keep_forecasts=False)
    assert pipeline.cars.unpredictable["override_out_of_range"] == counted
    assert pipeline.take_rides()["distance_km"].sum() == pytest.approx(columns["metres"][-1] / 1000.0, rel=0.01)


def test_variance_of_energy_between_samples_is_that_of_a_wandering_power():
    """The power follows an Ornstein-Uhlenbeck process; the estimate uses only what a logger sees."""
    rng, tick, correlation = np.random.default_rng(4), 0.25, 3.3118
    keep = np.exp(-tick / correlation)
    power = np.zeros(1_600_000)
    draws = rng.normal(scale=np.sqrt(1.0 - keep**2), size=len(power))
    for i in range(1, len(power)):
        power[i] = keep * power[i - 1] + draws[i]
    for period in (3.0, 5.0, 10.0, 30.0, 60.0):
        steps = round(period / tick)
        parts = power[: len(power) // (20 * steps) * 20 * steps].reshape(-1, 20 * steps)  # rides of 20 samples
        whole = np.column_stack([parts[:-1], parts[1:, 0]])
        truth = 0.5 * (whole[:, 1:] + whole[:, :-1]).sum(axis=1) * tick
        seen = whole[:, ::steps]
        energy = 0.5 * (seen[:, 1:] + seen[:, :-1]).sum(axis=1) * period
        expected = find_variance_factor(period) * (np.diff(seen, axis=1) ** 2).sum(axis=1) * period**2
        assert np.mean((energy - truth) ** 2) == pytest.approx(np.mean(expected), rel=0.12), period


def test_factor_of_variance_lies_between_its_limits_and_grows():
    factors = [find_variance_factor(dt) for dt in (0.5, 3.0, 3.0 + 1e-9, 5.0, 10.0, 30.0, 60.0, 1000.0)]
    assert factors[:2] == [0.125, 0.125]
    assert factors[2] == pytest.approx(0.125, rel=1e-3)
    assert (np.diff(factors) >= -1e-6).all()
    assert factors[-1] == pytest.approx(0.5, rel=0.01)


@pytest.mark.skipif(not (DATA / "bmw_i3").is_dir(), reason="the real drives are not here")
def test_variance_of_energy_holds_on_real_drives():
    """A BMW i3 was recorded at 10 Hz; the energy by single samples misses the whole by what the variance says."""
    for period in (3.0, 10.0, 30.0):
        deviations = []
        for file in sorted((DATA / "bmw_i3").glob("Trip*"))[::4]:
            time, power = read_power(file)
            energy = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(time))])
            for phase in np.linspace(0.0, period, 5, endpoint=False):
                at = np.arange(time[0] + phase, time[-1], period)
                seen, whole = np.interp(at, time, power), np.interp(at[[0, -1]], time, energy)
                sampled = 0.5 * (seen[1:] + seen[:-1]).sum() * period
                variance = find_variance_factor(period) * (np.diff(seen) ** 2).sum() * period**2
                deviations.append((sampled - (whole[1] - whole[0])) / np.sqrt(variance))
        assert 0.85 < np.mean(np.abs(deviations) < 2.0) < 0.99, period


def read_power(file):
    """Return the time [s] and the power drawn [W] of a drive."""
    table = pd.read_csv(file, sep=";", encoding="latin-1")
    volts, amperes = (
        next(column for column in table if name in column) for name in ("Battery Voltage", "Battery Current")
    )
    rows = table[[table.columns[0], volts, amperes]].dropna().to_numpy(float)
    return rows[:, 0], -rows[:, 1] * rows[:, 2]
