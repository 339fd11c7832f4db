"""Test the signals that effects request by name."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.cleaning.quality import Quality
from socast.core.columns import GRAVITY, SIGNALS
from socast.core.signals.signals import STEEPEST, Signals, flag_ambient
from socast.core.signals.weather import Stations
from socast.core.vehicles.fleet import CarParameters
from socast.core.wire.messages import Weather
from tests.support.telemetry import PERIOD, START, cleaned, drive, picked

N = 200
START_OF_DAY = START - 8 * 3600


def signals_of(columns=None, weather=None, parameters=None):
    clean = cleaned(drive(N) if columns is None else columns)
    stations = Stations()
    if weather is not None:
        stations.observe(Weather("s", 0.0, 45.5, -73.6, **weather))
    sky = stations.sky(clean.time, clean.latitude, clean.longitude)
    n = len(clean.dt)
    rolling_resistance, drag_area = (np.nan, np.nan) if parameters is None else parameters
    car = CarParameters(1500.0, rolling_resistance, drag_area, np.nan, 1.0)
    return Signals(clean, sky, CarParameters(*(np.full(n, value) for value in car)))


def test_every_declared_signal_has_the_right_shape_and_range():
    signals = signals_of()
    assert len(signals) == len(SIGNALS)
    for column in SIGNALS:
        values = signals[column.name]
        assert values.shape == (N,)
        known = values[~np.isnan(values)]
        assert np.all((known >= column.low - 1e-9) & (known <= column.high + 1e-9)), column.name


def test_unknown_signal_raises_attribute_error():
    with pytest.raises(AttributeError):
        signals_of()["warp"]


def test_integral_of_grade_over_distance_is_the_climb():
    base = drive(N)
    signals = signals_of(base | {"elevation_m": 100 + 0.03 * base["metres"]})
    clean = signals.clean
    assert np.sum(signals["grade"] * clean.speed * clean.travel) == pytest.approx(clean.climb.sum())
    assert clean.climb.sum() > 20


def test_grade_is_limited_at_a_cliff():
    base = drive(N, speed=10.0)
    for cliff in (5.0, 20.0, 5000.0):
        elevation = np.where(np.arange(N) < 100, 0.0, cliff)
        assert np.abs(signals_of(base | {"elevation_m": elevation})["grade"]).max() <= STEEPEST


@pytest.mark.parametrize(
    ("celsius", "elevation", "expected"), [(15.0, 0.0, 1.225), (-20.0, 0.0, 1.3943), (15.0, 1000.0, 1.0880)]
)
def test_air_density_equals_that_of_the_standard_atmosphere(celsius, elevation, expected):
    base = drive(N, ambient_c=celsius, elevation_m=elevation)
    assert signals_of(base)["air_density"][-1] == pytest.approx(expected, rel=2e-4)


def test_moist_air_and_low_pressure_reduce_air_density():
    base = drive(N, ambient_c=30.0)
    dry = signals_of(base)["air_density"][-1]
    moist = signals_of(base, {"humidity_pct": 100.0})["air_density"][-1]
    assert moist / dry == pytest.approx(1 - 0.378 * 4243 / 101325, abs=1e-4)
    low = signals_of(base, {"pressure_hpa": 950.0})["air_density"][-1]
    assert low / dry == pytest.approx(950 / 1013.25)


@given(st.floats(0, 360), st.floats(0, 360))
def test_wind_components_have_the_wind_speed_for_any_heading(source, bearing):
    base = drive(30, speed=15.0)
    angle = np.radians(bearing)
    base["latitude_deg"] = 45.5 + np.degrees(base["metres"] * np.cos(angle) / 6_371_008.8)
    base["longitude_deg"] = -73.6 + np.degrees(base["metres"] * np.sin(angle) / 6_371_008.8 / np.cos(np.radians(45.5)))
    signals = signals_of(base, {"wind_speed_kmh": 36.0, "wind_from_deg": source})
    head, cross = signals["headwind"][-1], signals["crosswind"][-1]
    assert np.hypot(head, cross) == pytest.approx(10.0)
    assert head == pytest.approx(10 * np.cos(np.radians(source - bearing)), abs=0.05)
    assert cross == pytest.approx(10 * np.sin(np.radians(source - bearing)), abs=0.05)


def test_unknown_values_have_the_documented_replacements():
    signals = signals_of()
    for name, expected in (
        ("headwind", 0),
        ("crosswind", 0),
        ("precipitation", 0),
        ("ambient", 288.15),
        ("occupants", 1),
    ):
        assert np.all(signals[name] == expected), name
    assert np.all(signals["mass"] == 1575.0)
    for name, expected in (
        *dict.fromkeys(("solar", "odometer", "water", "snow", "vapour_pressure"), 0).items(),
        ("charge", 0.5),
        ("pack_temperature", 288.15),
        ("parked", 8 * 3600),
    ):
        assert np.all(signals[name] == expected), name
    for name in ("humidity", "soc", "battery_temperature", "hvac", "current", "rolling_resistance", "drag_area"):
        assert np.all(np.isnan(signals[name])), name


def test_quality_bits_name_the_source_of_the_outside_temperature():
    base = drive(N, ambient_c=5.0)
    base["ambient_c"][50:] = np.nan
    for weather, bit in (({"temperature_c": -8.0}, Quality.AMBIENT_FILLED), (None, Quality.AMBIENT_ASSUMED)):
        signals = signals_of(base, weather)
        bits = flag_ambient(signals.clean, signals.sky) & (Quality.AMBIENT_FILLED | Quality.AMBIENT_ASSUMED)
        assert np.all(bits[:50] == 0)
        assert np.all(bits[50:] == bit)
        assert signals["ambient"][-1] == pytest.approx(265.15 if weather else 288.15)


def test_signals_of_a_row_do_not_depend_on_other_rows():
    base = drive(N, elevation_m=30.0)
    weather = {"wind_speed_kmh": 20.0, "wind_from_deg": 10.0, "precipitation_mm": 2.0, "humidity_pct": 60.0}
    whole = signals_of(base, weather, (0.01, 0.7))
    parts = whole.clean._replace(**{name: column[50:] for name, column in whole.clean._asdict().items()})
    sky = type(whole.sky)(*(column[50:] for column in whole.sky))
    part = Signals(parts, sky, CarParameters(*(column[50:] for column in whole.car)))
    for column in SIGNALS:
        assert np.array_equal(whole[column.name][50:], part[column.name], equal_nan=True), column.name


def test_each_stop_of_a_ride_is_counted_once():
    base = drive(N, seed=3)
    signals = signals_of(picked(base, np.arange(N)))
    stops = signals["stop_rate"] * signals["dt"]
    assert stops.sum() == signals.clean.stop[1:].sum() > 2


# Signals for candidate effects


def test_traction_equals_the_force_balance_with_the_parameters_of_the_car():
    base = drive(N, seed=3)
    signals = signals_of(base | {"elevation_m": 100 + 0.03 * base["metres"]}, None, (0.01, 0.7))
    v, a, sine = signals["speed"], signals["acceleration"], signals["grade"]
    weight = 1575 * GRAVITY
    expected = 1575 * a + weight * (0.01 * np.sqrt(1 - sine**2) + sine) + 0.5 * 1.225 * 0.7 * v**2
    moving = v > 0
    assert moving.sum() > 100
    assert (~moving).sum() > 5
    assert signals["traction"][moving] == pytest.approx(expected[moving])
    assert np.all(signals["traction"][~moving] == 0)
    assert signals["tyre_load"] == pytest.approx(weight * np.cos(np.arcsin(sine)))
    assert signals["traction"].min() < -500


def test_braking_force_is_the_mean_over_forces_within_a_step():
    """Within each step, the acceleration is normally distributed about its mean, with the declared spread."""
    signals = signals_of(drive(200, seed=4), None, (0.01, 0.7))
    spread, force = signals["acceleration_spread"], signals["traction"]
    z = np.random.default_rng(0).normal(size=200_000)
    for row in np.flatnonzero((spread > 0.2) & (np.abs(force) < 2000.0) & (signals["speed"] > 0.0))[:5]:
        drawn = np.maximum(-(force[row] + signals["mass"][row] * spread[row] * z), 0.0)
        assert signals["braking_force"][row] == pytest.approx(drawn.mean(), abs=5.0)
    still = spread == 0.0
    np.testing.assert_array_equal(signals["braking_force"][still], np.maximum(-force[still], 0.0))
    assert np.all(signals["braking_force"] >= np.maximum(-force, 0.0))


def test_forces_of_a_wrong_time_stamp_do_not_exceed_what_tyres_transmit():
    """A step of a microsecond makes any change of the speed an acceleration without limit."""
    clean = cleaned(drive(N, seed=4))
    row = N // 2
    for column in (clean.acceleration, clean.wide_acceleration, clean.acceleration_spread):
        column[row] = 1e6
    car = CarParameters(1500.0, 0.01, 0.7, np.nan, 1.0)
    signals = Signals(
        clean, Stations().sky(clean.time, clean.latitude, clean.longitude), CarParameters(*(np.full(N, v) for v in car))
    )
    weight = 1575 * GRAVITY
    for name in ("traction", "braking_force"):
        assert abs(signals[name][row]) < 1.5 * weight, name
    assert abs(signals["wheel_power"][row]) < 1.5 * weight * clean.wide_speed[row]


def test_traction_at_steady_speed_equals_the_road_load():
    """The car has 1575 kg and drives at 72 km/h on a level road: 0.010 of 15.4 kN, and 1/2 1.225 0.7 20^2 N."""
    signals = signals_of(drive(N, speed=20.0), None, (0.01, 0.7))
    assert signals["traction"][-1] == pytest.approx(0.010 * 1575 * GRAVITY + 0.5 * 1.225 * 0.7 * 400, rel=1e-6)


def test_wheel_power_is_the_road_load_over_two_steps():
    signals = signals_of(drive(N, seed=3), None, (0.01, 0.7))
    speed, acceleration = signals.clean.wide_speed, signals.clean.wide_acceleration
    force = 1575 * (acceleration + 0.010 * GRAVITY) + 0.5 * 1.225 * 0.7 * speed**2
    moving = speed > 0.0
    assert moving.sum() > 100
    assert signals["wheel_power"][moving] == pytest.approx(force[moving] * speed[moving])
    assert not signals["wheel_power"][~moving].any()


def test_reported_values_take_precedence_over_assumed_ones():
    base = drive(N, soc_pct=80.0, battery_temperature_c=-4.0, odometer_km=1234.0, ambient_c=7.0)
    signals = signals_of(base, {"solar_w_m2": 300.0})
    for name, value in (("charge", 0.8), ("pack_temperature", 269.15), ("odometer", 1.234e6), ("solar", 300.0)):
        assert signals[name][-1] == pytest.approx(value), name


def test_vapour_pressure_at_30_degrees_and_70_percent():
    """The steam tables give a saturation pressure of 4243 Pa."""
    signals = signals_of(drive(N, ambient_c=30.0), {"humidity_pct": 70.0})
    assert signals["vapour_pressure"][-1] == pytest.approx(0.7 * 4243, rel=4e-3)


@pytest.mark.parametrize(
    ("clock", "low", "high"),
    [(16, 0.0, 0.0), (21.3, 0.0, 0.0), (21.6, 0.02, 0.3), (22.0, 0.5, 0.95), (23, 1.0, 1.0), (4, 1.0, 1.0)],
)
def test_darkness_follows_twilight_in_montreal_in_january(clock, low, high):
    base = drive(N)
    base["time_s"] = START_OF_DAY + 3600 * clock + PERIOD * np.arange(N)
    dark = signals_of(base)["darkness"]
    assert low <= dark[0] <= high
    nowhere = signals_of(base | {"latitude_deg": np.full(N, np.nan), "longitude_deg": np.full(N, np.nan)})
    assert np.all(nowhere["darkness"] == 0)


def test_rain_and_snow_accumulate_on_the_road_by_temperature():
    wet = signals_of(drive(N, ambient_c=8.0), {"precipitation_mm": 2.0, "temperature_c": 8.0})
    assert wet["water"][-1] > 0.0005
    assert np.all(wet["snow"] == 0)
    white = signals_of(drive(N, ambient_c=-8.0), {"precipitation_mm": 2.0, "temperature_c": -8.0})
    assert white["snow"][-1] > 0.001
    assert np.all(white["water"] == 0)
