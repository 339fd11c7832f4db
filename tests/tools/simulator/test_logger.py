"""The simulated logger has faults at the given rates and counts them."""

from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pytest

from socast.core.wire.messages import Telemetry, address
from socast.tools.simulator.settings import (
    NO_FAULTS,
    Faults,
    Simulation,
)
from tests.support.simulated import PERFECT, SMALL, WINTER, decode_samples, run_simulation


@pytest.fixture(scope="module")
def faulty():
    return run_simulation(Simulation(vehicles=8, days=2, start=datetime(2018, 1, 15, tzinfo=UTC), seed=7))


@pytest.fixture(scope="module")
def perfect():
    return run_simulation(PERFECT)


def _telemetry(messages):
    return [m for m in messages if address(m.key).kind == "telemetry"]


class TestLogger:
    def test_logger_without_faults_sends_every_sample_completely(self, perfect):
        messages, truth = perfect
        for car in truth.cars:
            rows = decode_samples(messages, car)
            assert [row.seq for row in rows] == list(range(len(rows)))
            assert {round(b.time_s - a.time_s, 3) for a, b in pairwise(rows)} == {3.0}
            assert all(getattr(row, field) is not None for row in rows for field in Telemetry.__struct_fields__[3:])
        assert set(truth.summary()["faults"]) <= {"samples_sent"}

    def test_logger_without_faults_agrees_with_the_truth(self, perfect):
        messages, truth = perfect
        measured = []
        for ride in truth.rides:
            rows = [row for row in decode_samples(messages, ride["vehicle_id"]) if row.ride_id == ride["ride_id"]]
            power = [row.battery_voltage_v * row.battery_current_a for row in rows]
            measured.append(sum(power) * 3 / 3.6e6)
            driven_km = rows[-1].odometer_km - rows[0].odometer_km
            assert driven_km == pytest.approx(ride["distance_km"], rel=0.03, abs=0.04)
            climbed = rows[-1].elevation_m - rows[0].elevation_m
            assert climbed == pytest.approx(ride["gained_m"] - ride["lost_m"], abs=1.0)
        energies = [ride["energy_kwh"] for ride in truth.rides]
        np.testing.assert_allclose(measured, energies, rtol=0.15, atol=0.05)  # one sample covers 3 s
        assert sum(measured) == pytest.approx(sum(energies), rel=0.03)

    def test_faults_occur_at_their_rates(self, faulty):
        _, truth = faulty
        counts, rates = truth.summary()["faults"], Faults()
        sent = counts["samples_sent"]
        for fault in ("jitter", "repeated", "late", "out_of_order", "duplicate", "gap", "null_island", "missing",
                      "spike", "undecodable", "clock_step"):  # fmt: skip
            wanted = getattr(rates, fault) * sent
            assert abs(counts[fault] - wanted) < 5 * np.sqrt(wanted) + 1, fault
        assert counts["tunnel"] > 10
        assert counts["samples_lost"] > 2 * counts["gap"]

    def test_counts_of_faults_agree_with_the_messages(self):
        quiet = replace(SMALL, vehicles=4, shift_hours=3.0)
        for fault, rate in (("duplicate", 0.02), ("gap", 0.002), ("null_island", 0.01), ("repeated", 0.02)):
            messages, truth = run_simulation(replace(quiet, faults=replace(NO_FAULTS, **{fault: rate})))
            rows = decode_samples(messages)
            by_car = [[row for row in rows if row.vehicle_id == car] for car in truth.cars]
            steps = [b.seq - a.seq for car in by_car for a, b in pairwise(car)]
            counted = {
                "duplicate": steps.count(0),
                "gap": sum(step > 1 for step in steps),
                "null_island": sum(row.latitude_deg == 0 == row.longitude_deg for row in rows),
                "repeated": sum(a.time_s == b.time_s for car in by_car for a, b in pairwise(car)),
            }
            count = truth.summary()["faults"][fault]
            assert count > 5
            assert abs(counted[fault] - count) <= (0.1 * count + 2 if fault == "gap" else 0), fault  # gaps may merge

    def test_late_and_overtaken_samples_are_received_later(self):
        faults = replace(NO_FAULTS, late=0.01, out_of_order=0.02)
        messages, truth = run_simulation(replace(SMALL, faults=faults))
        delays = np.array(
            [
                m.receipt_ns / 1e9 - row.time_s
                for m, row in zip(_telemetry(messages), decode_samples(messages), strict=True)
            ]
        )
        counts = truth.summary()["faults"]
        assert (delays > 9).sum() == counts["late"] > 0
        assert ((delays > 3) & (delays < 9)).sum() == counts["out_of_order"] > 0
        assert (delays > 0).all()

    def test_faulty_clock_steps_forward_and_back(self):
        messages, truth = run_simulation(replace(SMALL, vehicles=1, faults=replace(NO_FAULTS, clock_step=0.004)))
        stamps = np.diff([row.time_s for row in decode_samples(messages)])
        assert (np.abs(stamps - 3) > 1).sum() == truth.summary()["faults"]["clock_step"] > 1

    def test_power_cycle_restarts_the_counter(self):
        messages, truth = run_simulation(replace(SMALL, vehicles=1, faults=replace(NO_FAULTS, power_cycle=0.003)))
        seq = [row.seq for row in decode_samples(messages)]
        assert sum(b < a for a, b in pairwise(seq)) == truth.summary()["faults"]["power_cycle"] > 0

    def test_positions_freeze_in_tunnels_and_jump_at_the_exit(self):
        faults = replace(NO_FAULTS, tunnel=1.0, unequipped=1.0)
        simulation = Simulation(
            vehicles=12, start=WINTER, shift_hours=2, seed=4, faults=faults, models=("tesla-model-s",)
        )
        messages, truth = run_simulation(simulation)
        gps = [name for name, car in truth.cars.items() if "wheel_speed" in car["logger_lacks"]]
        speeds = np.concatenate([[row.speed_kmh for row in decode_samples(messages, name)] for name in gps])
        jumps = speeds[speeds > 130]
        assert len(jumps) == sum(truth.faults[name]["tunnel"] for name in gps) > 3
        assert ((jumps > 900) & (jumps < 2000)).all()
        wheels = [name for name in truth.cars if name not in gps]
        assert max(row.speed_kmh for name in wheels for row in decode_samples(messages, name)) < 130

    def test_state_of_charge_has_the_steps_of_the_car(self):
        faults = replace(NO_FAULTS, quantised=1.0)
        messages, truth = run_simulation(replace(SMALL, vehicles=1, faults=faults))
        step = truth.cars["taxi-001"]["soc_step"]
        levels = np.array([row.soc_pct for row in decode_samples(messages)]) / step
        np.testing.assert_allclose(levels, np.round(levels), atol=1e-2)

    def test_rides_include_false_starts_and_errands(self, faulty):
        rides = faulty[1].rides
        seconds = np.array([ride["end_s"] - ride["start_s"] for ride in rides])
        assert 0.02 < (seconds < 15).mean() < 0.12
        assert 0 < (seconds > 3300).mean() < 0.04
