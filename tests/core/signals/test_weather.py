"""Test the weather at the position and time of a car."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.settings import Limits
from socast.core.signals.weather import CLEARING, DRYING, KEPT, THAWING, Sky, Stations, held, snow_left, water_left
from socast.core.wire.messages import Weather
from tests.support.telemetry import PERIOD, PLACE, START, drive, leaf, observed, ran, telemetry, without


def station(name="yul", time=0.0, place=PLACE, **fields):
    return Weather(name, time, *map(float, place), **fields)


def sky_at(stations, time, place=PLACE) -> Sky:
    latitude, longitude = np.radians(place)
    return stations.sky(np.atleast_1d(np.float64(time)), np.atleast_1d(latitude), np.atleast_1d(longitude))


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(-20, 30)), min_size=1, max_size=30), st.integers(0, 40))
def test_latest_past_observation_is_used_for_any_order_of_arrival(observations, now):
    stations = Stations()
    latest = {}
    for time, temperature in observations:
        stations.observe(station(time=float(time), temperature_c=float(temperature)))
        latest[time] = temperature
    past = [time for time in latest if time <= now]
    expected = latest[max(past)] if past else np.nan
    assert sky_at(stations, now).ambient[0] - 273.15 == pytest.approx(expected, nan_ok=True)


@given(st.integers(0, 2**32 - 1))
def test_nearest_station_with_a_past_observation_is_used(seed):
    rng = np.random.default_rng(seed)
    stations = Stations()
    places = rng.uniform([44, -75], [47, -72], (6, 2))
    begins = rng.integers(0, 10, 6)
    for i, (place, begin) in enumerate(zip(places, begins, strict=True)):
        stations.observe(station(f"s{i}", float(begin), place, temperature_c=float(i)))
    for now in range(10):
        car = rng.uniform([44, -75], [47, -72])
        north = places[:, 0] - car[0]
        east = (places[:, 1] - car[1]) * np.cos(np.radians(places[:, 0]))
        far = np.where(begins <= now, np.hypot(north, east), np.inf)
        expected = np.argmin(far) if np.isfinite(far.min()) else np.nan
        assert sky_at(stations, now, car).ambient[0] - 273.15 == pytest.approx(expected, nan_ok=True)


def look_at_every_station(stations, time, latitude, longitude):
    """Return the weather by a loop over all stations."""
    best, values = np.full(len(time), np.inf), np.full((len(Sky._fields), len(time)), np.nan)
    for _, times, rows, *place in stations.dump():
        north, east = latitude - place[0], np.abs(longitude - place[1])
        east = np.minimum(east, 2.0 * np.pi - east) * np.cos(place[0])
        far = np.nan_to_num(north * north + east * east, nan=1e9)
        latest = np.searchsorted(times, time, side="right") - 1
        nearer = (far < best) & (latest >= 0)
        best[nearer] = far[nearer]
        values[:, nearer] = np.array(rows)[latest[nearer]].T
    return Sky(*values)


@pytest.mark.parametrize("seed", range(20))
def test_search_equals_a_loop_over_all_stations_to_the_bit(seed):
    rng = np.random.default_rng(seed)
    stations = Stations()
    span = rng.choice([0.02, 1.0, 80.0])
    places = (rng.uniform(-span, span, (300, 2)) * (1.0, 2.0)).round(int(rng.integers(1, 5)))  # some coincide
    for number in rng.integers(0, 300, 900).tolist():
        time = float(rng.integers(0, 30))
        moved = places[number] + (0.01 if rng.random() < 0.1 else 0.0)
        stations.observe(station(f"s{number}", time, moved, temperature_c=float(rng.normal()), precipitation_mm=1.0))
    rows = 200
    latitude, longitude = np.radians(rng.uniform(-span, span, (2, rows)) * [[1.0], [2.0]]).round(4)
    latitude[::17], longitude[::13] = np.nan, np.nan
    time = rng.integers(-1, 20, rows).astype(float)
    expected = look_at_every_station(stations, time, latitude, longitude)
    for one, other in zip(stations.sky(time, latitude, longitude), expected, strict=True):
        assert np.array_equal(one, other, equal_nan=True)


def test_car_without_position_gets_the_weather_of_a_station():
    stations = Stations()
    stations.observe(station(temperature_c=4.0))
    sky = stations.sky(np.array([1.0]), np.array([np.nan]), np.array([np.nan]))
    assert sky.ambient[0] == pytest.approx(277.15)


def test_nearest_station_is_found_across_the_date_line():
    stations = Stations()
    stations.observe(station("far", place=(0.0, 170.0), temperature_c=1.0))
    stations.observe(station("near", place=(0.0, -179.9), temperature_c=2.0))
    assert sky_at(stations, 1.0, (0.0, 179.9)).ambient[0] == pytest.approx(275.15)


@pytest.mark.parametrize(("source", "north", "east"), [(0, 1, 0), (90, 0, 1), (180, -1, 0), (270, 0, -1)])
def test_wind_components_are_positive_for_wind_from_north_and_east(source, north, east):
    stations = Stations()
    stations.observe(station(wind_speed_kmh=36.0, wind_from_deg=float(source)))
    sky = sky_at(stations, 1.0)
    assert sky.wind_speed[0] == pytest.approx(10.0)
    assert (sky.wind_north[0], sky.wind_east[0]) == pytest.approx((10.0 * north, 10.0 * east), abs=1e-9)


def test_precipitation_rate_uses_the_time_since_the_last_observation():
    stations = Stations()
    stations.observe(station(time=0.0, precipitation_mm=1.8))
    assert sky_at(stations, 1.0).precipitation[0] * 3.6e6 == pytest.approx(
        1.8
    )  # over an hour, because there is no earlier observation
    stations.observe(station(time=1800.0, precipitation_mm=1.8))
    assert sky_at(stations, 1800.0).precipitation[0] * 3.6e6 == pytest.approx(3.6)


def test_value_out_of_range_is_unknown():
    stations = Stations()
    stations.observe(station(temperature_c=1e6, wind_speed_kmh=-4.0, wind_from_deg=1e300, humidity_pct=400.0))
    stations.observe(station("b", precipitation_mm=-1.0, pressure_hpa=0.0, solar_w_m2=1e9))
    for name, values in sky_at(stations, 1.0)._asdict().items():
        assert values[0] == 0 if name in ("observed", "water", "snow") else np.isnan(values[0]), name
    for values in sky_at(Stations(), 1.0):
        assert np.isnan(values[0])


@pytest.mark.parametrize("place", [(1e308, 0.0), (0.0, 1e308), (91.0, 0.0), (0.0, 400.0)])
def test_observation_with_impossible_position_is_rejected_and_counted(place):
    stations = Stations()
    assert stations.admit(station("lost", place=place, temperature_c=1.0)) == "out_of_range"
    pipeline, _ = ran([observed(place=place), observed()])
    assert pipeline.quality()["received"]["weather"] == 1
    assert pipeline.quality()["undecodable"] == {"out_of_range": 1}
    assert np.isnan(sky_at(stations, 1.0, (0.0, 0.0)).ambient[0])


def test_moving_station_has_its_newest_position():
    stations = Stations()
    stations.observe(station("ship", 0.0, (0.0, 0.0), temperature_c=1.0))
    stations.observe(station("quay", 0.0, (10.0, 10.0), temperature_c=2.0))
    stations.observe(station("ship", 10.0, (10.0, 20.0), temperature_c=3.0))
    assert sky_at(stations, 11.0, (10.0, 19.0)).ambient[0] == pytest.approx(276.15)


def test_number_of_kept_observations_is_limited():
    stations = Stations()
    for hour in range(3 * KEPT):
        stations.observe(station(time=3600.0 * hour, temperature_c=1.0))
    assert len(stations.dump()[0][1]) == KEPT


def test_silent_station_is_forgotten_and_the_others_are_as_if_it_had_never_been():
    stations, without_it = Stations(), Stations()
    for number, name in enumerate("abcd"):
        seen = station(name, time=100.0 * (name != "b"), place=(45.0, number), temperature_c=float(number))
        stations.observe(seen)
        if name != "b":
            without_it.observe(seen)
    sky_at(stations, 200.0)
    stations.forget_silent(50.0)
    assert repr(stations.dump()) == repr(without_it.dump())
    assert sky_at(stations, 200.0, (45.0, 1.2)).ambient[0] == pytest.approx(275.15)
    stations.observe(station("e", 300.0, (45.0, 1.2), temperature_c=9.0))
    assert sky_at(stations, 300.0, (45.0, 1.2)).ambient[0] == pytest.approx(282.15)


def test_station_that_is_silent_for_days_is_forgotten_at_the_daily_update():
    day = 86_400.0
    sent = [telemetry(drive(40, time_s=START + number * day + PERIOD * np.arange(40))) for number in range(4)]
    often = [observed("often", START + number * day, temperature_c=1.0) for number in range(4)]
    messages = [observed("once"), *(m for pair in zip(often, sent, strict=True) for m in (pair[0], *pair[1]))]
    for cuts in ((), range(0, len(messages), 3)):
        pipeline, _ = ran(messages, cuts, limits=Limits(silent_days=2.0))
        assert [name for name, *_ in pipeline.totals.stations.dump()] == ["often"]
        pipeline, _ = ran(messages, cuts, limits=Limits(silent_days=5.0))
        assert [name for name, *_ in pipeline.totals.stations.dump()] == ["once", "often"]


def test_loaded_state_equals_the_dumped_state():
    stations = Stations()
    stations.observe(station(time=3.0, temperature_c=1.25, wind_speed_kmh=7.0, wind_from_deg=200.0))
    loaded = Stations()
    loaded.load(stations.dump())
    assert repr(loaded.dump()) == repr(stations.dump())
    for one, other in zip(sky_at(stations, 9.0), sky_at(loaded, 9.0), strict=True):
        assert np.array_equal(one, other, equal_nan=True)


def test_missing_outside_temperature_is_filled_and_counted():
    columns = without(drive(100, speed=10.0), "metres")
    columns["ambient_c"] = np.full(100, -3.0)
    columns["ambient_c"][20:60] = np.nan
    messages = telemetry(columns)
    warm = observed(time=START + 30 * PERIOD, temperature_c=7.0)
    pipeline, _ = ran([leaf(), *messages[:40], warm, *messages[40:]])
    quality = pipeline.quality()["samples"]
    assert quality["ambient_assumed"] == 20  # no observation had arrived
    assert quality["ambient_filled"] == 20
    mean = (-3.0 * 59 + 15.0 * 20 + 7.0 * 20) / 99  # the first row has no duration
    assert pipeline.take_rides()["ambient_c"][0] == pytest.approx(mean)


def test_observation_applies_only_to_rows_after_its_time():
    columns = without(drive(100, speed=10.0), "metres")
    messages = telemetry(columns)
    future = observed(time=START + 80 * PERIOD, temperature_c=7.0, wind_speed_kmh=18.0, wind_from_deg=90.0)
    pipeline, _ = ran([leaf(), future, *messages])
    rides = pipeline.take_rides()
    assert rides["quality_ambient_filled"][0] == 20
    assert rides["wind_speed_kmh"][0] == pytest.approx(18.0)
    assert rides["wind_from_deg"][0] == pytest.approx(90.0)


# Rain and snow on the road

HOUR = 3600.0


def road_at(stations, time):
    """Return the depths of rain and snow on the road. [mm]"""
    sky = sky_at(stations, time)
    weather = sky.ambient, sky.precipitation, time - sky.observed
    return float(water_left(sky.water, *weather)[0]) * 1e3, float(snow_left(sky.snow, *weather)[0]) * 1e3


@given(st.floats(0, 1e-2), st.floats(0, 1e-5), st.floats(0, 1e5), st.floats(0, 1e5), st.floats(60, 1e5))
def test_depth_after_two_times_equals_depth_after_their_sum(depth, rate, first, second, memory):
    at_once = held(depth, rate, first + second, memory)
    assert held(held(depth, rate, first, memory), rate, second, memory) == pytest.approx(at_once, abs=1e-12)
    assert 0 <= at_once <= max(depth, rate * memory) + 1e-15


def observed_hourly(millimetres, celsius):
    stations = Stations()
    for i, (fell, degrees) in enumerate(zip(millimetres, celsius, strict=True)):
        stations.observe(station(time=HOUR * i, precipitation_mm=fell, temperature_c=degrees))
    return stations


def test_rain_of_an_hour_decays_with_the_drying_time():
    """2 mm fall in an hour, with a time constant of an hour: 2 (1 - 1/e) mm are left.

    Two hours later, e^-2 of that depth is left.
    """
    stations = observed_hourly([0, 2, 0, 0], [9] * 4)
    after = 2 * (1 - np.exp(-HOUR / DRYING)) * DRYING / HOUR
    assert road_at(stations, HOUR - 1)[0] == 0
    assert road_at(stations, HOUR) == (pytest.approx(after), 0)
    assert road_at(stations, 3 * HOUR)[0] == pytest.approx(after * np.exp(-2 * HOUR / DRYING))
    assert road_at(stations, 3 * HOUR + 1800)[0] == pytest.approx(after * np.exp(-2.5 * HOUR / DRYING))


def test_constant_rain_reaches_a_steady_depth():
    stations = observed_hourly([3] * 12, [9] * 12)
    balance = 3 * DRYING / HOUR
    depths = [road_at(stations, time)[0] for time in np.arange(6 * HOUR, 11 * HOUR, 300)]
    assert depths == pytest.approx([balance] * len(depths), rel=0.01)


def test_snow_falls_below_one_degree_and_leaves_faster_in_a_thaw():
    frost = observed_hourly([0, 2, 0, 0, 0], [-6] * 5)
    lying = 2 * (1 - np.exp(-HOUR / CLEARING)) * CLEARING / HOUR
    assert road_at(frost, HOUR) == (0, pytest.approx(lying))
    assert road_at(frost, 4 * HOUR)[1] == pytest.approx(lying * np.exp(-3 * HOUR / CLEARING))
    thaw = observed_hourly([0, 2, 0, 0, 0], [-6, -6, 4, 4, 4])
    assert road_at(thaw, 4 * HOUR)[1] == pytest.approx(lying * np.exp(-3 * HOUR / THAWING))
    assert road_at(observed_hourly([0, 2], [3, 3]), HOUR)[1] == 0


def test_precipitation_at_unknown_temperature_is_rain_and_unknown_amount_is_zero():
    stations = Stations()
    stations.observe(station(time=0.0, precipitation_mm=1.0))
    assert road_at(stations, 1.0)[0] > 0.5
    assert road_at(stations, 1.0)[1] == 0
    stations.observe(station("b", time=0.0, temperature_c=3.0))
    assert road_at(observed_hourly([None, None], [3, -3]), HOUR) == (0, 0)


def test_depths_on_the_road_do_not_depend_on_the_order_of_arrival():
    rain = np.random.default_rng(3).choice([0.0, 0.0, 1.5], 20)
    cold = np.random.default_rng(4).normal(1.0, 4.0, 20)
    in_order = observed_hourly(rain, cold)
    shuffled = Stations()
    order = [0, *(1 + np.random.default_rng(5).permutation(19))]
    sent = [station(time=HOUR * i, precipitation_mm=rain[i], temperature_c=cold[i]) for i in range(20)]
    for i in order:
        shuffled.observe(sent[i])
    for i in range(20):  # each is sent again, because the time since the observation before it is known only then
        shuffled.observe(sent[i])
    assert repr(shuffled.dump()) == repr(in_order.dump())


def test_observation_older_than_all_kept_ones_changes_nothing():
    stations = observed_hourly([1.0] * (KEPT + 5), [-3.0] * (KEPT + 5))
    before = repr(stations.dump())
    assert stations.observe(station(time=0.5, precipitation_mm=500.0, temperature_c=-3.0)) is None
    assert repr(stations.dump()) == before
