"""The simulated car conserves energy; car, city and weather are plausible."""

from datetime import UTC, datetime

import msgspec
import numpy as np
import pytest

from socast.core.vehicles import load_catalogue
from socast.core.wire.messages import Weather
from socast.tools.simulator import physics
from socast.tools.simulator.physics import PARTS
from socast.tools.simulator.settings import (
    ALL_PHENOMENA,
    NO_FAULTS,
    PLAIN_PHENOMENA,
    STEP,
    Phenomena,
    Simulation,
)
from tests.support.simulated import PERFECT, SUMMER, WINTER, drive_one_shift, run_simulation


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

    @pytest.mark.parametrize("name", [name for name in Phenomena._fields if name != "hills"])
    def test_every_phenomenon_changes_the_result(self, name):
        start = SUMMER if name in {"solar_load", "humidity", "wet_road", "regen_full_battery"} else WINTER
        _, trace, car, _ = drive_one_shift(start, seed=8)
        car = car._replace(winter_rolling=0.15)
        other = ALL_PHENOMENA._replace(**{name: not getattr(ALL_PHENOMENA, name)})
        without = physics.integrate_states(trace, car, 0.97, other)
        both = physics.integrate_states(trace, car, 0.97, ALL_PHENOMENA)
        measured = (
            (both.voltage * both.current + both.loss).sum(),
            (without.voltage * without.current + without.loss).sum(),
        )
        if name == "age":
            assert both.soc[-1] < without.soc[-1]
        else:
            assert abs(measured[0] / measured[1] - 1) > 1e-5

    def test_without_hills_the_land_is_flat(self):
        for phenomena in (ALL_PHENOMENA, PLAIN_PHENOMENA):
            _, flat, _, state = drive_one_shift(phenomena=phenomena._replace(hills=False))
            _, trace, _, _ = drive_one_shift(phenomena=phenomena)
            assert not flat.grade.any()
            assert not state.parts[:, PARTS.index("climbing")].any()
            assert np.ptp(flat.elevation) == 0 < np.ptp(trace.elevation)

    def test_foreign_physics_costs_more_in_the_cold_and_stays_in_bounds(self):
        foreign = ALL_PHENOMENA._replace(foreign=True)
        _, trace, car, usual = drive_one_shift(WINTER, hours=3.0)
        other = physics.integrate_states(trace, car, 0.9, foreign)
        colder = physics.integrate_states(trace._replace(ambient=trace.ambient - 15.0), car, 0.9, foreign)
        assert 0.5 < (0.9 - other.soc[-1]) / (usual.soc[0] - usual.soc[-1]) < 2.0
        assert colder.soc[-1] < other.soc[-1] - 0.02
        half = len(trace.time) // 2
        assert 12.0 < other.cabin[half:].min() < other.cabin[half:].max() < 28.0

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


class TestShift:
    def test_stations_publish_weather_every_hour(self, perfect):
        observations = [
            msgspec.json.decode(m.payload, type=Weather) for m in perfect[0] if m.key.startswith("weather/")
        ]
        for station in {row.station_id for row in observations}:
            times = [row.time_s for row in observations if row.station_id == station]
            assert set(np.diff(times)) == {3600.0}
        assert {row.station_id for row in observations} == {"mctavish", "yul", "yhu"}

    def test_driving_has_plausible_speeds_and_accelerations(self):
        shift, trace, _, _ = drive_one_shift(hours=3)
        timeline = shift.timeline
        assert timeline.after.min() == 0
        assert timeline.after.max() < 130 / 3.6
        assert np.abs(trace.acceleration).max() < 5
        np.testing.assert_array_equal(timeline.before[1:], timeline.after[:-1])
        assert (timeline.moved[timeline.plugged > 0] == 0).all()
