"""Test what is told of the logger of a car as a whole, and which rides its faults make unfit."""

import numpy as np
import pytest

from socast.core.cleaning.clock import ROLLOVER
from socast.core.totals.logger_faults import describe_faults, list_facts
from tests.support.telemetry import PERIOD, drive, joined, leaf, ran, telemetry, without

N = 300


def metered(n=N, seed=1, **columns):
    """Return a drive with the battery power of a small car."""
    made = drive(n, seed=seed, **columns)
    v = made["speed_kmh"] / 3.6
    power = 1500.0 * v * np.gradient(v, PERIOD) + 180.0 * v + 0.4 * v**3 + 900.0
    power += np.random.default_rng(seed).normal(0.0, 100.0, n)
    return made | {"battery_voltage_v": np.full(n, 360.0), "battery_current_a": power / 360.0}


def table(columns, **fields):
    pipeline, _ = ran([leaf(**fields), *telemetry(columns)])
    return pipeline.take_rides(), pipeline.quality()


def test_clock_that_rolled_over_is_dated_right_and_told():
    columns = metered()
    rides, _ = table(columns)
    early, quality = table(columns | {"time_s": columns["time_s"] - ROLLOVER})
    assert early["start_s"][0] == rides["start_s"][0]
    assert quality["logger_faults"] == {"clock_rollover": {"a": 1}}
    assert "1024 weeks" in describe_faults(quality["logger_faults"])[0]


def test_healthy_car_has_no_fault():
    rides, quality = table(metered())
    assert rides["fit_for_training"].all()
    assert quality["logger_faults"] == {}
    assert describe_faults({}) == []


def test_line_names_the_cars_with_most_rides_first():
    faults = {"current_inverted": {"b": 1, "a": 3}, "stamps_shared": {"b": 2}}
    first, second = describe_faults(faults)
    assert first.startswith("a (3 rides), b (1 ride): ")
    assert second.startswith("b (2 rides): ")
    assert [len(facts) for facts in list_facts(faults).values()] == [2, 1]


@pytest.mark.parametrize("power", [2.3e3, 7.2e3, 50e3])
@pytest.mark.parametrize("wait", [2, 20])
def test_charging_without_a_flag_ends_the_ride_and_costs_it_nothing(power, wait):
    first, second = metered(seed=1), metered(seed=2)
    pause = drive(400, speed=0.0, battery_voltage_v=360.0, battery_current_a=1.0)
    pause["battery_current_a"][wait:380] = -power / 360.0
    parts = []
    for i, part in enumerate((first, pause, second)):
        parts.append(part | {"time_s": part["time_s"] + PERIOD * sum((N, 400, N)[:i])})
    columns = without(joined(*parts), "ride_id", "seq")
    columns["latitude_deg"] = np.concatenate(
        [first["latitude_deg"], np.full(400, first["latitude_deg"][-1]), second["latitude_deg"]]
    )
    rides, quality = table(columns)
    alone = [table(without(part, "ride_id", "seq"))[0].iloc[0] for part in (first, second)]
    assert len(rides) == 2
    assert quality["samples"]["charging_inferred"] > 350
    for ride, own in zip(rides.itertuples(), alone, strict=True):
        assert ride.fit_for_training
        assert ride.energy_kwh == pytest.approx(own["energy_kwh"], abs=0.06 if power > 1e4 else 0.03)


def test_named_ride_with_charging_in_it_is_unfit():
    speed = np.concatenate([drive(N, seed=seed)["speed_kmh"] for seed in (1, 2)]) / 3.6
    speed[N - 20 : N + 20] = 0.0
    columns = metered(2 * N, speed=speed)
    columns["battery_current_a"][N - 10 : N + 15] = -20.0
    rides, _ = table(columns)
    assert rides["unfit_reason"].tolist() == ["charged"]


@pytest.mark.parametrize("fall", [3.0, 8.0])
def test_first_fall_of_a_stale_charge_after_sleep_is_no_consumption(fall):
    first, second = drive(N, seed=1), drive(N, seed=2)
    first["soc_pct"] = np.round(90.0 - 5.0 * np.arange(N) / N, 1)
    second["soc_pct"] = np.where(np.arange(N) < 14, first["soc_pct"][-1], 0.0)
    second["soc_pct"][14:] = np.round(first["soc_pct"][-1] - fall - 5.0 * np.arange(N - 14) / N, 1)
    second["time_s"] = second["time_s"] + N * PERIOD + 43_200.0
    columns = without(joined(first, second), "ride_id", "seq")
    rides, _ = table(columns)
    assert rides["fit_for_training"].tolist() == [True, False]
    assert rides["unfit_reason"][1] == "soc_stale"


def test_frozen_current_makes_the_ride_unfit():
    columns = metered(600)
    columns["battery_current_a"][200:320] = columns["battery_current_a"][200]
    rides, _ = table(columns)
    assert rides["unfit_reason"].tolist() == ["power_frozen"]


def test_tunnel_whose_time_the_logger_lost_is_driven_at_the_speed_before_it():
    columns = metered(400, speed=14.0)
    jump = np.degrees(3000.0 / 6_371_008.8)
    columns["latitude_deg"] = columns["latitude_deg"] + jump * (np.arange(400) >= 200)
    columns["speed_kmh"][200] = 1000.0
    rides, _ = table(columns)
    assert rides["unfit_reason"].tolist() == ["bridge_unmeasured"]
    assert rides["distance_km"][0] == pytest.approx(columns["metres"][-1] / 1e3 + 3.0, rel=0.01)
    level, _ = table(metered(400, speed=14.0))
    per_km = [each["effect_aero_drag"][0] / each["distance_km"][0] for each in (rides, level)]
    assert per_km[0] == pytest.approx(per_km[1], rel=0.05)
