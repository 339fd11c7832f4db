"""The simulated car conserves energy; car, city and weather are plausible."""

from datetime import UTC, datetime

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.vehicles import load_catalogue
from core.wire.messages import Weather
from tests.support.simulated import PERFECT, SUMMER, WINTER, drive_one_shift, run_simulation
from tools.simulator import physics
from tools.simulator.physics import PARTS
from tools.simulator.settings import (
    ALL_PHENOMENA,
    NO_FAULTS,
    PLAIN_PHENOMENA,
    STEP,
    Phenomena,
    Simulation,
)
from tools.simulator.weather import compute_sun_height, make_sky
from tools.simulator.world import (
    EXPRESSWAYS,
    compute_elevation,
    draw_destination,
    find_crossing,
    is_in_tunnel,
    make_route,
    to_wgs84,
)


@pytest.fixture(scope="module")
def perfect():
    return run_simulation(PERFECT)


class TestPhysics:
    @pytest.mark.parametrize("phenomena", [ALL_PHENOMENA, PLAIN_PHENOMENA])
    @pytest.mark.parametrize("start", [WINTER, SUMMER])
    def test_parts_add_up_to_the_power_of_the_battery(self, phenomena, start):
        shift, _, car, state = drive_one_shift(start, phenomena=phenomena)
        terminal = state.voltage * state.current
        np.testing.assert_allclose(state.parts.sum(axis=1), terminal, rtol=1e-7, atol=1e-3)
        capacity = car.capacity * (1 - car.wear * phenomena.age)
        inside = (terminal + state.loss).sum() * STEP
        assert (shift.soc - state.soc[-1]) * capacity == pytest.approx(inside, rel=1e-9)

    @pytest.mark.parametrize("name", Phenomena._fields)
    def test_every_phenomenon_changes_the_result(self, name):
        start = SUMMER if name in {"solar_load", "humidity", "wet_road", "regen_full_battery"} else WINTER
        _, trace, car, _ = drive_one_shift(start, seed=8)
        car = car._replace(winter_rolling=0.15)
        without = physics.integrate_states(trace, car, 0.97, ALL_PHENOMENA._replace(**{name: False}))
        both = physics.integrate_states(trace, car, 0.97, ALL_PHENOMENA)
        measured = (
            (both.voltage * both.current + both.loss).sum(),
            (without.voltage * without.current + without.loss).sum(),
        )
        if name == "age":
            assert both.soc[-1] < without.soc[-1]
        else:
            assert abs(measured[0] / measured[1] - 1) > 1e-5

    def test_plain_physics_has_only_the_basic_parts_and_climate(self):
        _, _, _, state = drive_one_shift(phenomena=PLAIN_PHENOMENA)
        used = {part for part, energy in zip(PARTS, np.abs(state.parts).sum(axis=0), strict=True) if energy > 0}
        assert used == {"rolling", "climbing", "drag", "inertia", "powertrain_losses", "electronics", "cabin_heating"}
        assert state.loss.sum() == 0

    def test_without_climate_there_is_no_heating_or_cooling(self):
        for start in (WINTER, SUMMER):
            _, _, _, state = drive_one_shift(start, phenomena=PLAIN_PHENOMENA._replace(climate=False))
            assert not state.hvac.any()

    def test_inertia_and_climbing_are_conservative(self):
        shift, trace, car, state = drive_one_shift(hours=3)
        energy = dict(zip(PARTS, state.parts.sum(axis=0) * STEP, strict=True))
        kinetic = 0.5 * car.mass * shift.timeline.after[-1] ** 2
        assert energy["inertia"] == pytest.approx(1.04 * kinetic, abs=1e-6 * energy["rolling"])
        height = trace.elevation[-1] - trace.elevation[0]
        assert energy["climbing"] == pytest.approx(car.mass * 9.80665 * height, abs=0.01 * energy["rolling"])

    def test_cold_cabin_and_pack_warm_up(self):
        _, trace, _, state = drive_one_shift()
        assert state.cabin[0] < 0 < 15 < state.cabin[2400]
        assert state.hvac[200] > 1.3 * np.median(state.hvac[-2400:])
        assert state.pack[-1] > trace.ambient[0]

    @pytest.mark.parametrize("model", sorted(load_catalogue()))
    def test_every_car_of_the_catalogue_completes_winter_shifts(self, model):
        cold = Simulation(vehicles=4, start=datetime(2018, 1, 20, tzinfo=UTC), seed=6, models=(model,))
        truth = run_simulation(cold)[1]
        assert min(ride["soc_end_pct"] for ride in truth.rides) > 2
        assert len(truth.rides) > 40

    @pytest.mark.parametrize(
        ("start", "low", "high"), [(datetime(2018, 1, 15, tzinfo=UTC), 0.18, 0.34), (SUMMER, 0.12, 0.22)]
    )
    def test_consumption_is_plausible(self, start, low, high):
        _, truth = run_simulation(Simulation(vehicles=5, start=start, shift_hours=4, seed=2, faults=NO_FAULTS))
        assert low < truth.summary()["kwh_per_km"] < high
        assert min(ride["soc_end_pct"] for ride in truth.rides) > 5
        minutes = np.array([ride["end_s"] - ride["start_s"] for ride in truth.rides]) / 60
        assert 8 < minutes.mean() < 20


class TestWorld:
    def test_weather_has_seasons_and_persistence(self):
        sky = make_sky(datetime(2018, 1, 1, tzinfo=UTC).timestamp(), 365, 3)
        month = np.array([datetime.fromtimestamp(t, UTC).month for t in sky.time])
        assert -16 < sky.temperature[month == 1].mean() < -4
        assert 17 < sky.temperature[month == 7].mean() < 25
        days = sky.temperature[: len(sky.temperature) // 24 * 24].reshape(-1, 24).mean(axis=1)
        normal = np.convolve(np.pad(days, 15, mode="edge"), np.ones(31) / 31, mode="valid")
        anomaly = days - normal
        assert 0.3 < np.corrcoef(anomaly[1:], anomaly[:-1])[0, 1] < 0.9
        wind = sky.wind_east
        assert np.corrcoef(wind[1:], wind[:-1])[0, 1] > 0.85
        wet = sky.precipitation > 0
        assert wet[1:][wet[:-1]].mean() > 3 * wet.mean()
        assert 600 < sky.precipitation.sum() < 1600
        assert sky.snow[month == 7].max() < 0.01 < sky.snow[month == 1].mean()
        assert sky.solar[compute_sun_height(sky.time) == 0].max() == 0

    def test_stations_publish_weather_every_hour(self, perfect):
        observations = [
            msgspec.json.decode(m.payload, type=Weather) for m in perfect[0] if m.key.startswith("weather/")
        ]
        for station in {row.station_id for row in observations}:
            times = [row.time_s for row in observations if row.station_id == station]
            assert set(np.diff(times)) == {3600.0}
        assert {row.station_id for row in observations} == {"mctavish", "yul", "yhu"}

    @given(st.integers(0, 10_000), st.floats(400, 25_000))
    def test_routes_follow_streets(self, seed, distance):
        rng = np.random.default_rng(seed)
        start = find_crossing(float(rng.uniform(-9000, 9000)), float(rng.uniform(-6000, 6000)))
        goal = draw_destination(*start, distance, rng)
        way = make_route(start, goal, rng)
        assert goal != start
        for line in EXPRESSWAYS:
            assert abs(goal[1 - line.axis] - line.at) > 100
            turns = np.abs((way.v, way.u)[line.axis] - line.at) < 5
            turns &= np.append(False, way.turn)
            assert not is_in_tunnel(way.u, way.v, np.full(len(way.u), line.axis * np.pi / 2))[turns].any()
        assert (way.u[0], way.v[0]) == start
        assert (way.u[-1], way.v[-1]) == goal
        assert (np.minimum(np.abs(np.diff(way.u)), np.abs(np.diff(way.v))) < 1e-9).all()
        assert (np.diff(way.along) > 0).all()
        assert len(way.limit) == len(way.turn) == len(way.along) - 1

    def test_ground_is_smooth_with_a_hill_in_the_centre(self):
        x = np.arange(-9000.0, 9000.0, 10.0)
        for y in (-4000.0, 0.0, 2500.0):
            slope = np.diff(compute_elevation(x, np.full_like(x, y))) / 10.0
            assert np.abs(slope).max() < 0.12
            assert np.abs(np.diff(slope)).max() < 0.01
        middle = compute_elevation(np.zeros(1), np.zeros(1))[0]
        assert middle > 150 + compute_elevation(np.array([6000.0]), np.array([4000.0]))[0]
        latitude, longitude = to_wgs84(np.zeros(1), np.zeros(1))
        assert (latitude[0], longitude[0]) == pytest.approx((45.5, -73.6), abs=0.02)

    def test_tunnels_lie_on_expressways(self):
        assert sum(len(line.tunnels) for line in EXPRESSWAYS) >= 3
        assert all(900 <= 1.2 * (end - begin) < 2000 for line in EXPRESSWAYS for begin, end in line.tunnels)

    def test_driving_has_plausible_speeds_and_accelerations(self):
        shift, trace, _, _ = drive_one_shift(hours=3)
        timeline = shift.timeline
        assert timeline.after.min() == 0
        assert timeline.after.max() < 130 / 3.6
        assert np.abs(trace.acceleration).max() < 5
        np.testing.assert_array_equal(timeline.before[1:], timeline.after[:-1])
        assert (timeline.moved[timeline.plugged > 0] == 0).all()
