"""Test slices: planted biases are found with words and interval, and data without structure give no slice."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.diagnose.slices.predicates import CONDITION_SCALES, choose_thresholds, list_conditions
from socast.core.diagnose.slices.search import find_slices

pytestmark = pytest.mark.long


def fleet(count, vehicles=6, days=20, seed=0):
    """Return rides of one year, and errors with a part per ride (0.1 kWh) and a part per vehicle-day (0.03 kWh)."""
    rng = np.random.default_rng(seed)
    car, day = rng.integers(0, vehicles, count), rng.integers(0, days, count)
    start = 1516000000.0 + 86400.0 * np.floor(day * 365.0 / days) + rng.uniform(0.0, 8.0, count) * 3600.0
    ambient = 5.0 - 14.0 * np.cos(2 * np.pi * day / days) + rng.normal(0.0, 2.0, count)
    distance = rng.lognormal(1.6, 0.6, count)
    rides = pd.DataFrame(
        {
            "vehicle_id": np.array([f"taxi-{i:03d}" for i in range(vehicles)])[car],
            "vehicle_model": np.array(["one", "two"])[car % 2],
            "date": pd.to_datetime(start, unit="s").strftime("%Y-%m-%d"),
            "start_s": start,
            "winter": (day < days // 4).astype(np.int64),
            "summer": (day >= days // 4).astype(np.int64),
            "ambient_c": ambient,
            "distance_km": distance,
            "average_speed_kmh": 20.0 + 4.0 * np.log(distance) + rng.normal(0.0, 4.0, count),
            "stops": rng.poisson(distance).astype(np.float64),
            "wind_speed_kmh": rng.gamma(3.0, 5.0, count),
            "precipitation_mm_h": np.where(rng.random(count) < 0.8, 0.0, rng.exponential(1.0, count)),
            "parked_s": rng.lognormal(7.0, 1.5, count),
            "soc_start_pct": rng.uniform(30.0, 98.0, count),
            "occupants": rng.integers(1, 5, count).astype(np.float64),
            "longitude_start_deg": -73.6,
        }
    )
    of_day = rng.normal(0.0, 0.03, (vehicles, days))[car, day]
    return rides, rng.normal(0.0, 0.1, count) + of_day, car * days + day


def test_slices_without_structure_keep_false_discovery_rate():
    rides, error, day = fleet(240, vehicles=5, days=12)
    error = error + 0.3 * (rides["ambient_c"] < 0.0).to_numpy()
    order = np.argsort(day, kind="stable")
    false = 0
    for seed in range(100):  # errors go to other vehicle-days, those of a day together
        rank = np.random.default_rng(seed).permutation(60)
        permuted = np.empty(len(error))
        permuted[order] = error[np.argsort(rank[day], kind="stable")]
        false += bool(find_slices(rides, permuted, seed=seed))
    assert false <= 11  # 5 are allowed on average, and more than 11 of 100 have a chance of 0.4 %


def test_planted_bias_of_one_cold_vehicle_is_found_with_covering_interval():
    covered, named, runs = 0, 0, 8
    for seed in range(runs):
        rides, error, _ = fleet(2000, vehicles=4, days=100, seed=seed)
        cold = ((rides["ambient_c"] < -5.0) & (rides["vehicle_id"] == "taxi-003")).to_numpy()
        result = find_slices(rides, error + 0.3 * cold, seed=seed)
        right = [each for each in result if {"colder than -5 °C", "taxi-003"} <= set(each.conditions)]
        named += len(right) == 1 and len(right[0].conditions) == 2
        covered += bool(right) and right[0].ci95[0] <= 0.3 <= right[0].ci95[1]
        for each in result:
            assert each.where == ", ".join(each.conditions)
            assert each.ci95[0] < each.bias_kwh < each.ci95[1]
            assert each.q <= 0.05
        assert all(each.rides < np.count_nonzero(cold) for each in right)  # of the half that confirms
    assert named >= runs - 1
    assert covered >= runs - 2


@pytest.mark.parametrize(
    ("column", "limit", "words"),
    [
        ("average_speed_kmh", 25.0, "faster than 25 km/h"),
        ("stops", 8.0, "8 stops or more"),
        ("soc_start_pct", 80.0, "battery above 80 % at the start"),
    ],
)
def test_single_condition_slices_have_round_thresholds(column, limit, words):
    rides, error, _ = fleet(800)
    result = find_slices(rides, error - 0.1 * (rides[column] >= limit).to_numpy())
    assert result[0].where == words
    assert result[0].bias_kwh == pytest.approx(-0.1, abs=0.03)


def test_two_separate_faults_are_both_found_without_duplicates():
    rides, error, _ = fleet(2000)
    wet = (rides["precipitation_mm_h"] >= 0.5).to_numpy()
    error = error + 0.15 * (rides["vehicle_id"] == "taxi-001").to_numpy() - 0.15 * wet
    result = find_slices(rides, error)
    assert {"taxi-001", "rain or snow above 0.5 mm/h"} <= {each.where for each in result}
    assert len(find_slices(rides, error, most=1)) == 1


def test_fault_since_date_is_described_by_its_date():
    rides, error, _ = fleet(800)
    date = sorted(set(rides["date"]))[11]
    result = find_slices(rides, error + 0.1 * (rides["date"] >= date).to_numpy())
    assert result[0].where in {f"since {date}", f"before {date}"}


def test_slices_depend_on_seed_but_not_on_row_order():
    rides, error, _ = fleet(600)
    error = error + 0.15 * (rides["ambient_c"] < 0.0).to_numpy()
    order = np.random.default_rng(1).permutation(len(rides))
    assert find_slices(rides, error)
    assert find_slices(rides, error) == find_slices(rides.iloc[order], error[order])
    assert find_slices(rides, error, seed=1) == find_slices(rides, error, seed=1) != find_slices(rides, error, seed=2)


def test_slices_are_found_despite_unknown_values():
    rides, error, _ = fleet(800)
    cold = (rides["ambient_c"] < 0.0).to_numpy()
    error = error + 0.2 * cold
    holed = rides.assign(occupants=np.nan, wind_speed_kmh=np.nan, vehicle_model=None)
    holed.loc[::7, "ambient_c"] = np.nan
    error[::11] = np.nan
    (best, *_) = find_slices(holed, error)
    assert best.where == "colder than 0 °C"
    names = ["vehicle_id", "date", "start_s", "ambient_c"]
    assert find_slices(holed[names], error)[0].where == "colder than 0 °C"


@pytest.mark.parametrize("count", [0, 1, 2, 10, 30])
def test_too_few_rides_give_no_slice(count):
    rides, error, _ = fleet(40)
    assert find_slices(rides.iloc[:count], error[:count]) == []
    assert find_slices(rides, np.full(40, np.nan)) == []
    assert find_slices(rides, np.zeros(40)) == []


@given(st.integers(0, 1000), st.integers(1, 3), st.floats(0.1, 3.0))
@settings(max_examples=25, deadline=None)
def test_thresholds_are_round_and_divide_rides(seed, power, size):
    values = size * np.random.default_rng(seed).normal(5.0, 10.0, 200) ** power
    for scale in CONDITION_SCALES:
        result = choose_thresholds(values, scale)
        assert result == sorted(set(result))
        for at in result:
            assert 0 < np.count_nonzero(values < at) < len(values)
            assert not scale.steps or any(abs(at / step - round(at / step)) < 1e-9 for step in scale.steps)


def test_conditions_match_their_words():
    rides, _, _ = fleet(300)
    known, masks = list_conditions(rides)
    by_words = {condition.words: mask for condition, mask in zip(known, masks, strict=True)}
    assert np.array_equal(by_words["colder than 0 °C"], rides["ambient_c"] < 0.0)
    assert np.array_equal(by_words["parked for more than 1 h before"], rides["parked_s"] >= 3600.0)
    assert np.array_equal(by_words["fewer than 3 people aboard"], rides["occupants"] < 3)
    assert np.array_equal(by_words["taxi-002"], rides["vehicle_id"] == "taxi-002")
    assert len({mask.tobytes() for mask in masks}) == len(masks)
    hour = (rides["start_s"] / 3600.0 - 73.6 / 15.0) % 24.0
    assert np.array_equal(by_words["between 6 and 9 h"], (hour >= 6.0) & (hour < 9.0))


def test_names_without_letters_get_title():
    rides, _, _ = fleet(100)
    known, _ = list_conditions(rides.assign(driver_id=np.arange(100) % 3))
    assert {"driver 0", "driver 1", "driver 2"} <= {condition.words for condition in known}


def test_conditions_on_invented_dates_are_omitted():
    rides, _, _ = fleet(400)
    of_dates = {"season", "hour", "date <", "date >"}
    kinds = [{each.kind for each in list_conditions(rides, dated=dated)[0]} for dated in (True, False)]
    assert of_dates <= kinds[0]
    assert kinds[1] == kinds[0] - of_dates
