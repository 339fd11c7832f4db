"""Test what is learned of a car's display: its capacity and curve, pooled over a fleet, causal and robust."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.cleaning.quality import CAUSES
from socast.core.columns import JOULES_PER_KWH
from socast.core.pipeline import Pipeline
from socast.core.totals.accumulator import AMOUNTS, EDGES, Accumulator, Sums, Totals
from socast.core.totals.display_record import create_unknown_yields
from socast.core.totals.display_yield import READING_SDS, RELEARN_AFTER, DisplayYields
from socast.core.totals.measured_energy import RIDE_SD, find_usable_capacity, measure_by_soc
from socast.core.vehicles.fleet import Cars
from socast.core.wire.message_order import VehicleChange
from socast.core.wire.messages import Vehicle
from tests.core.totals.test_measured_energy import shift
from tests.support.telemetry import chunked, leaf, ran, telemetry

CATALOGUE = 24.0
NONE = Accumulator(0).none()


def fleet(lanes):
    """Return cars of one vehicle model."""
    cars = Cars()
    changes = [
        VehicleChange(0, lane, Vehicle(vehicle_id="", time_s=0.0, model="nissan-leaf-2013")) for lane in range(lanes)
    ]
    cars.kinds(np.zeros(0, np.int64), changes, lanes)
    return cars


def charge(energy, start, capacity, curve):
    """Return the charge after a ride that uses an energy: the inverse of s + b (s^2 - s)."""
    left = start + curve * (start**2 - start) - energy / capacity
    if curve == 0.0:
        return left
    return (-(1.0 - curve) + np.sqrt((1.0 - curve) ** 2 + 4.0 * curve * left)) / (2.0 * curve)


def ride(rng, lane=0, capacity=CATALOGUE, curve=0.0, noise=0.002, quantum=0.001):
    """Return the totals of one random ride."""
    energy, start = rng.uniform(0.5, 4.0), rng.uniform(0.5, 0.98)
    end = charge(energy, start, capacity, curve) + rng.normal(0.0, noise)
    amounts, first = np.zeros((1, len(AMOUNTS))), np.zeros((1, len(EDGES)))
    told = {"duration": 900.0, "metered": 900.0, "energy": energy * JOULES_PER_KWH, "distance": 6000.0}
    for name, value in told.items():
        amounts[0, AMOUNTS.index(name)] = value
    first[0, EDGES.index("kind")], first[0, EDGES.index("soc_step")] = 1.0, quantum
    last = first.copy()
    first[0, EDGES.index("soc")] = np.round(start / quantum) * quantum
    last[0, EDGES.index("soc")] = np.round(end / quantum) * quantum
    zero = np.zeros(1, np.int64)
    return Totals(zero, np.array([lane]), zero, zero, amounts, first, last, np.zeros((1, 30)), create_unknown_yields(1))


def learn(displays, totals, lanes=1):
    """Return the totals of a closed ride with its yield, from which the yields of later rides are learned."""
    return displays.attach(Sums(totals, NONE, NONE, NONE), lanes).rides


@pytest.mark.parametrize("seed", range(20, 24))
@pytest.mark.parametrize(("capacity", "curve"), [(24.0, 0.0), (15.0, 0.1), (27.0, -0.1)])
def test_capacity_and_curve_are_learned_with_honest_uncertainty(seed, capacity, curve):
    rng, displays = np.random.default_rng(seed), DisplayYields(fleet(1))
    for _ in range(60):
        known = learn(displays, ride(rng, capacity=capacity, curve=curve))
    display = known.display[0]
    assert find_usable_capacity(known)[0][0] == pytest.approx(capacity, rel=0.03)
    assert abs(display["inverse"] - 1.0 / capacity) < 3.5 * np.sqrt(display["inverse_variance"])
    assert abs(display["curve"] - curve) < 3.5 * np.sqrt(display["curve_variance"])


def test_energy_of_the_next_ride_is_within_its_uncertainty():
    score = []
    for seed in range(100, 130):
        rng = np.random.default_rng(seed)
        capacity, curve = CATALOGUE * rng.normal(0.85, 0.12), rng.normal(0.0, 0.05)
        noise = rng.choice(READING_SDS, p=1.0 / READING_SDS / (1.0 / READING_SDS).sum())
        displays = DisplayYields(fleet(1))
        for number in range(20):
            today = capacity * rng.normal(1.0, RIDE_SD)
            known = learn(displays, ride(rng, capacity=today, curve=curve, noise=noise))
            if number % 3 == 0:
                energy, sd = measure_by_soc(known)
                score.append((energy[0] - known.amount("energy")[0] / JOULES_PER_KWH) / sd[0])
    score = np.array(score)
    assert 0.85 < np.mean(np.abs(score) < 1.645) < 0.96
    assert abs(np.mean(score)) < 0.15


def test_outlier_moves_the_yield_little_and_is_contradictory():
    rng, displays = np.random.default_rng(7), DisplayYields(fleet(1))
    for _ in range(20):
        before = learn(displays, ride(rng))
    assert before.display["contradicted"][0] == 0.0
    assert learn(displays, ride(rng, capacity=40.0)).display["contradicted"][0] == 1.0
    after = learn(displays, ride(rng))
    assert find_usable_capacity(after)[0][0] == pytest.approx(find_usable_capacity(before)[0][0], rel=0.02)


def test_lasting_change_of_the_display_is_learned_anew():
    rng, displays = np.random.default_rng(8), DisplayYields(fleet(1))
    for _ in range(40):
        learn(displays, ride(rng))
    verdicts = [learn(displays, ride(rng, capacity=38.0)).display["contradicted"][0] for _ in range(20)]
    assert RELEARN_AFTER <= sum(verdicts) <= 2 * RELEARN_AFTER
    assert sum(verdicts[8:]) == 0.0
    assert find_usable_capacity(learn(displays, ride(rng)))[0][0] == pytest.approx(38.0, rel=0.05)


def test_full_display_and_missing_values_teach_nothing():
    rng, displays = np.random.default_rng(9), DisplayYields(fleet(1))
    for spoil in ("first_soc", "last_soc", "metered", "soc_faults"):
        totals = ride(rng, capacity=12.0)
        if spoil == "first_soc":
            totals.at_first("soc")[0] = 1.0
        elif spoil == "last_soc":
            totals.at_last("soc")[0] = np.nan
        else:
            totals.amount(spoil)[0] = {"metered": 100.0, "soc_faults": 1.0}[spoil]
        learn(displays, totals)
    assert find_usable_capacity(learn(displays, ride(rng)))[0][0] == pytest.approx(CATALOGUE)


def test_charge_that_stands_still_teaches_nothing_and_contradicts_no_meter():
    rng, displays = np.random.default_rng(11), DisplayYields(fleet(1))
    for _ in range(20):
        learn(displays, ride(rng))
    before = displays.dump()
    for _ in range(2 * RELEARN_AFTER):
        still = ride(rng)
        still.at_last("soc")[0] = still.at_first("soc")[0]
        assert learn(displays, still).display["contradicted"][0] == 0.0
    assert displays.dump() == before


def test_cars_of_a_model_share_what_was_learned_from_the_next_day_on():
    rng, lanes = np.random.default_rng(10), 9
    displays = DisplayYields(fleet(lanes))
    for _ in range(15):
        for lane in range(lanes - 1):
            learn(displays, ride(rng, lane, capacity=16.0), lanes)
    fresh = ride(rng, lanes - 1)
    capacity, before = find_usable_capacity(displays.describe(fresh, lanes))
    assert capacity[0] == pytest.approx(CATALOGUE)
    displays.apply_daily_update()
    capacity, sd = find_usable_capacity(displays.describe(fresh, lanes))
    assert capacity[0] == pytest.approx(16.0, rel=0.05)
    assert 0.05 * 16.0 < sd[0] < 0.5 * before[0]  # cars of one model still differ


def test_pooling_does_not_count_the_data_of_a_car_twice():
    rng, displays = np.random.default_rng(11), DisplayYields(fleet(1))
    for _ in range(3):
        learn(displays, ride(rng, capacity=16.0))
    before = displays.describe(ride(rng), 1)
    displays.apply_daily_update()
    after = displays.describe(ride(rng), 1)
    assert after.display[0] == before.display[0]


def pushed(messages, cuts=()):
    pipeline = Pipeline(keep_forecasts=False)
    for chunk in chunked(messages, cuts):
        pipeline.push(chunk)
    return pipeline


def fleet_messages():
    """Return rides of two cars over a midnight, one of which loses voltage and current in the middle."""
    one, other = shift(capacity=15.0, rides=5), shift(capacity=16.0, rides=5)
    one["battery_current_a"][700:] = np.nan
    messages = [leaf("a"), leaf("b")]
    for columns in (one, other):
        columns["time_s"] += 86_400.0 - 8 * 3600.0 - 1500.0  # midnight is in the second ride
    for pair in zip(telemetry(one, "a"), telemetry(other, "b"), strict=True):
        messages += pair
    return messages


MESSAGES = fleet_messages()


@settings(max_examples=8)
@given(cuts=st.lists(st.integers(0, len(MESSAGES)), max_size=12))
def test_any_chunking_gives_the_same_yields(cuts):
    whole, _ = ran(MESSAGES, keep_forecasts=False)
    parts, _ = ran(MESSAGES, cuts, keep_forecasts=False)
    rides = whole.take_rides()
    assert (rides["energy_source"] == "soc").any()
    assert rides["usable_capacity_kwh"].nunique() > 5
    pd.testing.assert_frame_equal(rides, parts.take_rides(), check_exact=True)
    pd.testing.assert_frame_equal(whole.take_windows(), parts.take_windows(), check_exact=True)
    assert whole.snapshot() == parts.snapshot()


@pytest.mark.parametrize("at", [500, 1211, 2400])
def test_restart_continues_what_was_learned(at):
    whole = pushed(MESSAGES)
    first = pushed(MESSAGES[:at])
    early = first.take_rides()
    second = Pipeline(keep_forecasts=False)
    second.restore(first.snapshot())
    second.push(MESSAGES[at:])
    rides = pd.concat([part for part in (early, second.take_rides()) if len(part)], ignore_index=True)
    pd.testing.assert_frame_equal(rides, whole.take_rides(), check_exact=True)
    assert second.snapshot() == whole.snapshot()


def test_warm_up_takes_over_what_was_learned():
    earlier = pushed(MESSAGES)
    earlier.finish()
    later = Pipeline(keep_forecasts=False)
    later.learn_from(earlier)
    later.push(MESSAGES)
    capacity = later.take_rides().groupby("vehicle_id")["usable_capacity_kwh"].first()
    assert capacity["a"] == pytest.approx(15.0, rel=0.1)
    assert capacity["b"] == pytest.approx(16.0, rel=0.1)


@pytest.mark.parametrize(("stale_fall", "contradicted"), [(0.001, 1.0), (0.12, 0.0)])
def test_stale_charge_excuses_a_contradiction_that_it_explains(stale_fall, contradicted):
    """A ride of which the charge shows too much energy by a tenth of the battery."""
    rng, displays = np.random.default_rng(7), DisplayYields(fleet(1))
    for _ in range(20):
        learn(displays, ride(rng, lane=0))
    totals = ride(rng)
    totals.at_last("soc")[0] -= 0.1
    totals.amount("soc_faults")[0], totals.amount("stale_fall")[0] = 1.0, stale_fall
    totals.quality[0, CAUSES.index("soc_stale")] = 1.0
    assert learn(displays, totals).display["contradicted"][0] == contradicted


def test_curve_is_learned_without_bias_from_a_coarse_display():
    """The noise of the fall is in the bend of the charge, too; the energy takes its place there."""
    curves = []
    for seed in range(30, 36):
        rng, displays = np.random.default_rng(seed), DisplayYields(fleet(1))
        for _ in range(300):
            learn(displays, ride(rng, curve=0.12, noise=0.004, quantum=0.01))
        curves.append(float(displays.describe(ride(rng), 1).display["curve"][0]))
    assert np.mean(curves) == pytest.approx(0.12, abs=0.04)
