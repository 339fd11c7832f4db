"""Test the ride table: the terms of the paper's Table 1, and measured energy with its uncertainty."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from socast.core.cleaning.meters import POWER_SPREAD, UNSEEN_TIME
from socast.core.cleaning.quality import CAUSES
from socast.core.totals.display_yield import READING_SDS
from socast.core.totals.measured_energy import METER_GAIN, RIDE_SD
from socast.core.totals.tables import HISTOGRAM, is_winter
from socast.core.vehicles import OCCUPANT_MASS, load_catalogue
from tests.support.telemetry import PERIOD, START, drive, leaf, make_message, observed, ran, telemetry, without

pytestmark = pytest.mark.long

CAPACITY = (
    load_catalogue()["nissan-leaf-2013"].usable_capacity_kwh
    or load_catalogue()["nissan-leaf-2013"].nominal_capacity_kwh
)

TABLE_1 = {
    "Distance": "distance_km",
    "Average Speed": "average_speed_kmh",
    "Gained Altitude": "gained_m",
    "Lost Altitude": "lost_m",
    "Duration seconds": "duration_s",
    "Temperature": "ambient_c",
    "Wind Speed": "wind_speed_kmh",
    "Wind Direction": "wind_from_deg",
    "Starting SOC": "soc_start_pct",
    "Ending SOC": "soc_end_pct",
    "Vehicle Id": "vehicle_id",
    "Vehicle Model": "vehicle_model",
    "Date": "date",
    "Driver Id": "driver_id",
    "Time since last charge": "time_since_charge_s",
    "Odometer": "odometer_km",
    "Precipitation": "precipitation_mm_h",
    "Nominal capacity": "nominal_capacity_kwh",
    "Vehicle positions": "latitude_start_deg",
    "Winter": "winter",
    "Summer": "summer",
}


def rides_of(columns, *others, **options):
    pipeline, _ = ran([leaf(), *others, *telemetry(columns)], keep_forecasts=False, **options)
    return pipeline.take_rides()


def test_every_term_of_table_1_has_its_expected_value():
    n = 600
    columns = drive(n, seed=4, odometer_km=41_000.0, soc_pct=np.round(80 - 0.01 * np.arange(n), 1), charging=False)
    columns["elevation_m"] = 50 + columns["metres"] / 100
    before = drive(20, speed=0.0, soc_pct=80.0, odometer_km=41_000.0, charging=True, elevation_m=50.0)
    before["time_s"] -= 20 * PERIOD
    before["seq"] -= 20
    before["ride_id"][:] = None
    both = {name: np.concatenate([before[name], columns[name]]) for name in columns}
    both["seq"] += 20
    weather = observed(
        time=START - 900, temperature_c=-7.0, wind_speed_kmh=15.0, wind_from_deg=270.0, precipitation_mm=0.4
    )
    driver = make_message("ride", ride_id="r1", event="start", driver_id="ana")
    rides = rides_of(both, weather, driver)
    assert len(rides) == 1
    ride = rides.iloc[0]
    assert not ride[list(TABLE_1.values())].isna().any()
    assert len(HISTOGRAM) == 21
    assert set(HISTOGRAM) <= set(rides)
    metres = columns["metres"][-1]
    expected = {
        "distance_km": metres / 1000,
        "average_speed_kmh": metres / (PERIOD * (n - 1)) * 3.6,
        "lost_m": 0.0,
        "duration_s": PERIOD * (n - 1),
        "ambient_c": -7.0,
        "wind_speed_kmh": 15.0,
        "wind_from_deg": 270.0,
        "soc_start_pct": 80.0,
        "soc_end_pct": 74.0,
        "time_since_charge_s": PERIOD * n,
        "odometer_km": 41_000.0,
        "precipitation_mm_h": 0.4,
        "nominal_capacity_kwh": 24.0,
        "latitude_start_deg": 45.5,
        "longitude_end_deg": -73.6,
    }
    for name, value in expected.items():
        assert ride[name] == pytest.approx(value, abs=1e-6), name
    assert ride["gained_m"] == pytest.approx(metres / 100, abs=4)
    named = ("vehicle_id", "vehicle_model", "date", "driver_id", "winter", "summer", "ride_id")
    assert ride[list(named)].tolist() == ["a", "nissan-leaf-2013", "2024-01-15", "ana", 1, 0, "r1"]


def test_energy_of_speeding_up_is_that_of_the_reported_speed():
    speed = np.array([0.0, *[10.0, 10.0, 10.0, 14.0, 10.0, 0.0, 0.0] * 10])  # m/s
    ride = rides_of(drive(len(speed), speed=speed), also=["inertia_positive"]).iloc[0]
    kinetic = 10 * 14.0**2 / 2.0 * (ride["mass_kg"] + OCCUPANT_MASS)
    assert ride["effect_inertia_positive"] == pytest.approx(kinetic / 3.6e6)
    assert 0.0 < ride["unresolved_braking_kwh"] < 0.3 * kinetic / 3.6e6


def test_names_and_types_of_columns_do_not_depend_on_known_values():
    empty, _ = ran([])
    full = rides_of(drive(100, speed=10.0))
    assert list(empty.take_rides()) == list(full)
    named = rides_of(
        drive(100, speed=10.0, soc_pct=50.0), make_message("ride", ride_id="r1", event="start", driver_id="ana")
    )
    assert named.dtypes.equals(full.dtypes)
    assert {f"quality_{cause}" for cause in CAUSES} <= set(full)
    assert full.columns.is_unique
    for name in ("energy_vi_kwh", "energy_soc_kwh", "energy_kwh", "energy_sd_kwh", "fit_for_training", "unfit_reason"):
        assert name in full


@given(st.dates(min_value=pd.Timestamp("2000-01-01").date(), max_value=pd.Timestamp("2100-01-01").date()))
def test_winter_is_the_season_of_mandatory_winter_tyres(day):
    middle = pd.Timestamp(day).timestamp() + 43_200
    in_winter = (day.month, day.day) >= (12, 15) or (day.month, day.day) <= (3, 15)
    assert is_winter(np.array([middle])).tolist() == [int(in_winter)]


def test_energy_by_power_takes_precedence_over_energy_by_soc():
    n = 400
    columns = drive(n, speed=10.0, battery_voltage_v=360.0, battery_current_a=25.0)
    columns["soc_pct"] = 90 - np.floor(np.arange(n) / 60)
    ride = rides_of(columns).iloc[0]
    assert ride["energy_vi_kwh"] == pytest.approx(9.0 * PERIOD * (n - 1) / 3600)
    assert ride["energy_kwh"] == ride["energy_vi_kwh"]
    assert ride["energy_sd_kwh"] == ride["energy_vi_sd_kwh"] < ride["energy_soc_sd_kwh"]


def test_energy_by_soc_is_used_where_power_is_known_for_less_than_half():
    n = 400
    columns = drive(n, speed=10.0, battery_voltage_v=360.0, battery_current_a=25.0)
    columns["soc_pct"] = 90 - 0.02 * np.arange(n)
    columns["battery_current_a"][150:] = np.nan
    ride = rides_of(columns).iloc[0]
    assert np.isnan(ride["energy_vi_kwh"])
    assert ride["energy_kwh"] == ride["energy_soc_kwh"] == pytest.approx(0.02 * (n - 1) / 100 * CAPACITY)
    columns["battery_current_a"][150:300] = 25.0
    ride = rides_of(columns).iloc[0]
    assert ride["energy_vi_kwh"] == pytest.approx(
        9.0 * PERIOD * (n - 1) / 3600, rel=1e-3
    )  # the mean power fills the rest
    assert ride["energy_vi_sd_kwh"] > 0.05 * ride["energy_vi_kwh"]


def test_ride_without_measurement_has_no_energy():
    ride = rides_of(drive(100, speed=10.0)).iloc[0]
    assert ride[["energy_vi_kwh", "energy_soc_kwh", "energy_kwh", "energy_sd_kwh"]].isna().all()
    assert ride["unfit_reason"] == "no_measured_energy"
    unknown, _ = ran(telemetry(drive(100, speed=10.0, soc_pct=50.0)))
    assert np.isnan(unknown.take_rides()["energy_kwh"][0])  # the capacity is unknown


@pytest.mark.parametrize("quantum", [0.1, 0.5, 1.0])
def test_uncertainty_of_energy_by_quantised_soc_agrees_with_its_errors(quantum):
    """The score is the error of the energy by SOC over its standard deviation, for rides of random energy."""
    rng = np.random.default_rng(int(10 * quantum))
    noise = READING_SDS.sum() / (1.0 / READING_SDS).sum()  # mean variance of a display before any data
    score = []
    for seed in range(60):
        n = int(rng.integers(60, 300))
        start, drawn = rng.uniform(60, 95), rng.uniform(2.5, 8.0)
        true = start - drawn * np.arange(n) / (n - 1)
        columns = without(drive(n, seed=seed, speed=10.0), "latitude_deg", "longitude_deg")
        columns["soc_pct"] = np.floor(true / quantum) * quantum
        ride = rides_of(columns).iloc[0]
        others = noise * CAPACITY**2 + (RIDE_SD * ride["energy_soc_kwh"]) ** 2
        sd = np.sqrt(ride["energy_soc_noise_kwh"] ** 2 - others)  # its part of the quantum
        score.append((ride["energy_soc_kwh"] - drawn / 100 * CAPACITY) / sd)
    assert np.mean(score) == pytest.approx(0, abs=0.4)
    assert np.std(score) == pytest.approx(1, abs=0.25)
    assert np.mean(np.abs(score) < 1.96) > 0.9


def test_uncertainty_of_energy_by_power_with_holes_covers_its_errors():
    """A burst of samples lacks current; the score is the error of the filled energy over its standard deviation."""
    rng = np.random.default_rng(3)
    score = []
    for seed in range(40):
        n = 300
        columns = drive(n, seed=seed, battery_voltage_v=360.0)
        columns["battery_current_a"] = 3.0 + 1.2 * columns["speed_kmh"]
        true = np.trapezoid(360.0 * columns["battery_current_a"]) * PERIOD / 3.6e6
        at = int(rng.integers(0, 200))
        columns["battery_current_a"][at : at + int(rng.integers(20, 100))] = np.nan
        ride = rides_of(columns).iloc[0]
        score.append((ride["energy_vi_kwh"] - true) / ride["energy_vi_sd_kwh"])
    assert np.mean(np.abs(score) < 2) > 0.9
    assert np.std(score) > 0.2  # the uncertainty is not far too wide


def test_window_table_has_the_measured_columns_of_the_ride_table():
    pipeline, _ = ran([leaf(), *telemetry(drive(200, speed=10.0, soc_pct=80.0))])
    windows, rides = pipeline.take_windows(), pipeline.take_rides()
    same = [name for name in rides if name in windows]
    assert {"distance_km", "energy_kwh", "energy_sd_kwh", "rolling_resistance", "drag_area_m2", *HISTOGRAM} <= set(same)
    assert (windows["ride_key"] == rides["ride_key"][0]).all()
    assert pipeline.take_rides().empty
    assert pipeline.take_windows().empty


def test_each_ride_and_window_is_returned_once_whenever_tables_are_taken():
    columns = drive(300, speed=10.0)
    columns["ride_id"] = np.repeat(np.array(["A", "B", "C"], dtype=object), 100)
    messages = [leaf(), *telemetry(columns)]
    whole, _ = ran(messages)
    pipeline, _ = ran([])
    taken, windows = [], []
    for start in range(0, len(messages), 40):
        pipeline.push(messages[start : start + 40])
        taken.append(pipeline.take_rides())
        windows.append(pipeline.take_windows())
    pipeline.finish()
    taken.append(pipeline.take_rides())
    windows.append(pipeline.take_windows())
    together = pd.concat([part for part in taken if len(part)], ignore_index=True)
    pd.testing.assert_frame_equal(together, whole.take_rides())
    windowed = pd.concat([part for part in windows if len(part)], ignore_index=True)
    pd.testing.assert_frame_equal(windowed, whole.take_windows())


@pytest.mark.parametrize("year", [1971, 2024, 2100])
def test_ride_at_any_plausible_time_has_a_date(year):
    columns = drive(60, speed=10.0)
    columns["time_s"] += pd.Timestamp(f"{year}-06-01").timestamp() - columns["time_s"][0]
    assert rides_of(columns)["date"].tolist() == [f"{year}-06-01"]


def test_ride_with_implausible_time_is_dropped():
    columns = drive(60, speed=10.0)
    columns["time_s"] += 5e10
    assert rides_of(columns).empty


@pytest.mark.parametrize("memory", [2.0, 6.0, 20.0])
def test_uncertainty_of_power_between_samples_agrees_with_its_errors(memory):
    """Power varies with a correlation time of some seconds, and is sampled every 3 s.

    The score is the error of the energy over its standard deviation.
    """
    rng = np.random.default_rng(int(memory))
    score = []
    for seed in range(60):
        n, fine = 200, 30
        noise = rng.normal(size=n * fine)
        keep = np.exp(-PERIOD / fine / memory)
        noise[0] = 0.0
        power = 15e3 + 10e3 * lfilter([np.sqrt(1 - keep * keep)], [1.0, -keep], noise)
        true = np.trapezoid(power[: (n - 1) * fine + 1]) * PERIOD / fine / 3.6e6
        columns = drive(n, seed=seed, speed=10.0, battery_voltage_v=360.0)
        columns["battery_current_a"] = power[::fine] / 360.0
        ride = rides_of(columns).iloc[0]
        sd = np.sqrt(ride["energy_vi_sd_kwh"] ** 2 - (METER_GAIN * ride["energy_vi_kwh"]) ** 2)
        score.append((ride["energy_vi_kwh"] - true) / sd)
    assert 0.55 < np.std(score) < 1.25
    assert np.mean(np.abs(score) < 1.96) > 0.88


def test_uncertainty_covers_power_that_was_not_seen():
    """The mean of the ride fills a hole of two minutes; cars differ by some kilowatts from it."""
    n, rng, scores = 400, np.random.default_rng(5), []
    for _ in range(60):
        keep = np.exp(-PERIOD / UNSEEN_TIME)
        noise = rng.normal(size=n)
        noise[1:] *= np.sqrt(1.0 - keep * keep)
        power = 12e3 + POWER_SPREAD * lfilter([1.0], [1.0, -keep], noise)
        columns = drive(n, speed=10.0, battery_voltage_v=360.0)
        columns["battery_current_a"] = power / 360.0
        whole = rides_of(columns).iloc[0]["energy_vi_kwh"]
        columns["battery_current_a"][150:190] = np.nan
        ride = rides_of(columns).iloc[0]
        scores.append((ride["energy_vi_kwh"] - whole) / ride["energy_vi_sd_kwh"])
    assert 0.6 < np.std(scores) < 1.3


@pytest.mark.parametrize(("at", "fit"), [((0, 40), False), ((260, 300), False), ((0, 5), True), ((100, 140), True)])
def test_ride_that_begins_or_ends_in_a_long_gap_is_unfit(at, fit):
    """Samples before and after the ride show that the logger was on; those at the edge of the ride are lost."""
    columns = drive(500, speed=np.r_[np.zeros(100), np.full(300, 12.0), np.zeros(100)])
    columns |= {"battery_voltage_v": np.full(500, 360.0), "battery_current_a": np.full(500, 30.0)}
    columns["ride_id"] = np.r_[[None] * 100, ["r1"] * 300, [None] * 100].astype(object)
    whole = rides_of(columns).iloc[0]
    lost = np.r_[100 + at[0] : 100 + at[1]]
    cut = rides_of({name: np.delete(values, lost) for name, values in columns.items()}).iloc[0]
    assert whole["fit_for_training"]
    assert cut["fit_for_training"] == fit
    assert (cut["unfit_reason"] == "cut_by_gap") != fit
    missing = whole["energy_kwh"] - cut["energy_kwh"]
    assert abs(missing) < 2.0 * cut["energy_sd_kwh"]


def test_ride_of_a_car_without_vehicle_message_has_unknown_capacity():
    pipeline, _ = ran(telemetry(drive(200, soc_pct=np.linspace(80, 78, 200).round(1))))
    ride = pipeline.take_rides().iloc[0]
    assert ride["unfit_reason"] == "unknown_capacity"
    assert pipeline.quality()["unpredicted"] == {"no_vehicle_message": 1}
