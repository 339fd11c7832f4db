"""Test ride and window totals against plain numpy over the cleaned rows."""

import numpy as np
import pytest

from socast.core import effects
from socast.core.columns import JOULES_PER_KWH, KMH, SPEED_BINS
from socast.core.pipeline import Pipeline
from socast.core.signals.signals import Signals
from socast.core.signals.weather import Stations
from socast.core.totals.accumulator import AMOUNTS, Accumulator
from socast.core.totals.tables import HISTOGRAM
from socast.core.vehicles import load_catalogue
from socast.core.vehicles.fleet import CarParameters
from tests.support.telemetry import PERIOD, cleaned, drive, joined, leaf, observed, ran, telemetry, without

N = 500


def full(n=N, seed=4, **columns):
    """Return a drive over hills of a car that sends every field."""
    base = drive(n, seed=seed)
    made = base | {
        "elevation_m": 60 + 40 * np.sin(base["metres"] / 900),
        "battery_voltage_v": 370 - 0.01 * np.arange(n),
        "battery_current_a": 4.0 + 0.8 * base["speed_kmh"],
        "ambient_c": 2.0 + 0.01 * np.arange(n),
        "hvac_w": np.full(n, 1200.0),
        "occupants": np.full(n, 3),
        "soc_pct": np.round(90 - 0.02 * np.arange(n), 1),
        "odometer_km": np.round(20_000 + base["metres"] / 1000, 1),
        "battery_temperature_c": np.full(n, 9.0),
    }
    return made | columns


def ride_of(columns, *weather):
    pipeline, _ = ran([leaf(), *weather, *telemetry(columns)])
    return pipeline.take_rides().iloc[0], pipeline.take_windows()


def test_totals_of_a_ride_equal_plain_sums_over_its_rows():
    columns = full()
    ride, _ = ride_of(columns, observed(wind_speed_kmh=18.0, wind_from_deg=300.0, precipitation_mm=2.0))
    clean = cleaned(columns)
    power = columns["battery_voltage_v"] * columns["battery_current_a"]
    mean = np.average(columns["ambient_c"], weights=clean.dt)
    expected = {
        "duration_s": PERIOD * (N - 1),
        "distance_km": columns["metres"][-1] / 1000,
        "average_speed_kmh": columns["metres"][-1] / (PERIOD * (N - 1)) * 3.6,
        "gained_m": np.maximum(clean.climb, 0).sum(),
        "lost_m": -np.minimum(clean.climb, 0).sum(),
        "ambient_c": mean,
        "wind_speed_kmh": 18.0,
        "wind_from_deg": 300.0,
        "precipitation_mm_h": 2.0,
        "hvac_kwh": 1.2 * PERIOD * (N - 1) / 3600,
        "energy_vi_kwh": np.trapezoid(power) * PERIOD / JOULES_PER_KWH,
        "stops": clean.stop[1:].sum(),
        "samples": N - 1,
    }
    for name, value in expected.items():
        assert ride[name] == pytest.approx(value, rel=1e-9), name


def test_energy_of_an_effect_is_the_integral_of_its_power():
    columns = full()
    ride, _ = ride_of(columns)
    clean = cleaned(columns)
    stations = Stations()
    sky = stations.sky(clean.time, clean.latitude, clean.longitude)
    model = load_catalogue()["nissan-leaf-2013"]
    car = CarParameters(*(np.full(N, getattr(model, name)) for name in CarParameters._fields))
    signals = Signals(clean, sky, car)
    for name in ("rolling", "climbing", "aero_drag", "inertia", "accessories"):
        effect = effects.get(name)
        over = clean.travel if effect.per == "distance" else clean.dt
        assert ride[f"effect_{name}"] == pytest.approx(effect.power(signals) @ over / JOULES_PER_KWH), name
    force = (model.mass_kg + 225) * 9.80665
    run = clean.speed @ clean.travel
    assert ride["effect_rolling"] == pytest.approx(force * run / JOULES_PER_KWH, rel=0.01)  # cos θ is nearly one
    assert ride["effect_climbing"] == pytest.approx(force * clean.climb.sum() / JOULES_PER_KWH)
    assert ride["effect_inertia"] * JOULES_PER_KWH == pytest.approx(
        0.5 * (model.mass_kg + 225) * (columns["speed_kmh"][-3:].mean() * KMH) ** 2, abs=1.0
    )


def test_speed_histogram_adds_up_to_the_distance():
    columns = full()
    ride, windows = ride_of(columns)
    clean = cleaned(columns)
    expected = np.histogram(clean.speed, bins=[*(5 * KMH * np.arange(SPEED_BINS)), np.inf], weights=clean.distance)[0]
    assert ride[list(HISTOGRAM)].to_numpy(float) == pytest.approx(expected / 1000, abs=1e-9)
    assert ride[list(HISTOGRAM)].sum() == pytest.approx(ride["distance_km"])
    assert windows[list(HISTOGRAM)].sum(axis=1).to_numpy() == pytest.approx(windows["distance_km"].to_numpy())


def test_last_speed_bin_holds_all_faster_driving():
    ride, _ = ride_of(drive(100, speed=35.0))
    assert ride[HISTOGRAM[-1]] == pytest.approx(ride["distance_km"])


@pytest.mark.parametrize("power", [True, False])
def test_windows_add_up_to_their_ride(power):
    columns = full()
    ride, windows = ride_of(columns if power else without(columns, "battery_voltage_v"))
    assert len(windows) > 5
    summed = [
        "duration_s",
        "distance_km",
        "gained_m",
        "lost_m",
        "hvac_kwh",
        "stops",
        "samples",
        "energy_soc_kwh",
        *HISTOGRAM,
    ]
    summed += [name for name in windows if name.startswith("effect_")] + ["energy_vi_kwh"] * power
    for name in summed:
        assert windows[name].sum() == pytest.approx(ride[name], rel=1e-9, abs=1e-9), name
    for first, last in (
        ("start_s", "end_s"),
        ("soc_start_pct", "soc_end_pct"),
        ("latitude_start_deg", "latitude_end_deg"),
    ):
        assert windows[first][1:].to_numpy() == pytest.approx(windows[last][:-1].to_numpy()), first
        assert windows[first].iloc[0] == ride[first]
        assert windows[last].iloc[-1] == ride[last]


def test_running_totals_at_the_end_equal_those_of_the_ride():
    messages = [leaf(), *telemetry(full())]
    pipeline = Pipeline()
    pipeline.push(messages)
    running = pipeline.totals.accumulator.running(np.array([0]))
    status = pipeline.status()[0].forecast
    last = pipeline.push([])
    pipeline.finish()
    ride = pipeline.take_rides().iloc[0]
    assert last == []
    for name, unit in (
        ("distance", 1000.0),
        ("duration", 1.0),
        ("gained", 1.0),
        ("lost", 1.0),
        ("energy", JOULES_PER_KWH),
    ):
        column = {"distance": "distance_km", "duration": "duration_s", "energy": "energy_vi_kwh"}.get(name, f"{name}_m")
        assert running.amount(name)[0] / unit == pytest.approx(ride[column], rel=1e-15), name
    assert status.ride_distance_km == ride["distance_km"]
    assert status.ride_energy_measured_kwh == ride["energy_kwh"]
    assert status.ride_energy_predicted_kwh == pytest.approx(
        float(pipeline.model.predict_energy(pipeline_columns(ride))[0]), rel=1e-12
    )


def pipeline_columns(ride):
    return {name: np.array([value]) for name, value in ride.items() if isinstance(value, float)}


def test_running_distance_equals_the_sum_of_the_rows_so_far():
    columns = full(60)
    messages = telemetry(columns)
    pipeline = Pipeline()
    clean = cleaned(columns)
    for i, message in enumerate(messages):
        pipeline.push([message])
        assert pipeline.totals.accumulator.running(np.array([0])).amount("distance")[0] == pytest.approx(
            clean.distance[: i + 1].sum()
        )


def test_quality_bits_are_counted_per_ride():
    base = joined(full(100), full(100))
    base["ride_id"] = np.array(["A"] * 100 + ["B"] * 100, dtype=object)
    base["seq"] = np.arange(200)
    base["time_s"] = base["time_s"][0] + PERIOD * np.arange(200)
    base["soc_pct"][[150, 160]] = 300.0
    pipeline, _ = ran([leaf(), *telemetry(without(base, "latitude_deg", "longitude_deg"))])
    rides = pipeline.take_rides()
    assert rides["quality_out_of_range"].tolist() == [0, 2]
    assert rides["quality_soc_missing"].tolist() == [0, 2]
    assert pipeline.quality()["samples"]["out_of_range"] == 2


def test_rows_outside_rides_enter_no_totals():
    columns = full(100)
    columns["ride_id"] = np.array(["A"] + [None] * 99, dtype=object)
    pipeline, _ = ran([leaf(), *telemetry(columns)])
    for table in (pipeline.take_rides(), pipeline.take_windows()):
        assert table[["duration_s", "distance_km", "samples"]].to_numpy().tolist() == [[0.0, 0.0, 0.0]]
    assert pipeline.status()[0].forecast.ride_distance_km == 0


def test_empty_ledger_has_a_column_for_every_amount():
    accumulator = Accumulator(3)
    totals = accumulator.running(np.array([], dtype=np.int64))
    assert totals.amounts.shape == (0, len(AMOUNTS) + 3 + SPEED_BINS)
    assert accumulator.close().rides.lane.size == 0


# Idle periods


def summed(columns, monkeypatch):
    """Return the totals of the samples of a car: rides, idle periods, windows and running totals."""
    pipeline, kept = Pipeline(keep_forecasts=False), []
    monkeypatch.setattr(pipeline.day_rollover, "find_rollovers", lambda *_: [])  # a list is one batch
    monkeypatch.setattr(pipeline.totals.closed, "add", kept.append)
    pipeline.take([leaf()])
    pipeline.take(telemetry(columns))
    (sums,) = kept
    return sums


def paused(n=300, begin=100, end=160):
    """Return two rides and the idle period between them, in which the car continues to use power."""
    columns = full(n)
    columns["speed_kmh"][begin:end] = 0.0
    columns["ride_id"] = np.array(["A"] * begin + [None] * (end - begin) + ["B"] * (n - end), dtype=object)
    return columns


def test_idle_period_covers_the_time_between_two_rides(monkeypatch):
    columns = paused()
    sums = summed(columns, monkeypatch)
    (rest,) = range(len(sums.idle_periods.lane))
    power = (columns["battery_voltage_v"] * columns["battery_current_a"])[99:160]
    assert (sums.idle_periods.ride[rest], sums.idle_periods.at[rest]) == (-1, 160)
    assert sums.idle_periods.amount("duration")[rest] == PERIOD * 60
    assert sums.idle_periods.amount("energy")[rest] == pytest.approx(np.trapezoid(power) * PERIOD)
    assert sums.idle_periods.amount("metered")[rest] == PERIOD * 60
    assert sums.idle_periods.at_first("time")[rest] == columns["time_s"][100]
    assert sums.idle_periods.at_last("time")[rest] == columns["time_s"][159]
    assert sums.rides.amount("duration")[0] + sums.idle_periods.amount("duration")[rest] == pytest.approx(PERIOD * 159)


def test_long_silence_ends_an_idle_period_and_belongs_to_none(monkeypatch):
    columns = paused()
    columns["time_s"] = columns["time_s"] + 3600.0 * (np.arange(300) >= 130)
    columns["seq"] = columns["seq"] + 1200 * (np.arange(300) >= 130)
    sums = summed(columns, monkeypatch)
    assert sums.idle_periods.amount("duration").tolist() == [
        PERIOD * 30,
        PERIOD * 28,
    ]  # the first sample is not believed
    assert (sums.idle_periods.at_last("time") - sums.idle_periods.at_first("time")).tolist() == [
        PERIOD * 29,
        PERIOD * 28,
    ]


def test_running_totals_between_rides_are_those_of_the_idle_period(monkeypatch):
    running = summed(paused(), monkeypatch).running
    resting = running.ride < 0
    assert resting.any()
    duration = running.amount("duration")[resting]
    assert duration == pytest.approx(running.at_last("time")[resting] - running.at_first("time")[resting] + PERIOD)
    assert running.amount("duration")[~resting][-1] < PERIOD * 140
