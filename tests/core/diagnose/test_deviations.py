"""Test deviations: what one car has, or what began on a date, is found with its car, date and size."""

from functools import cache

import numpy as np
import pytest

from socast.core.diagnose.deviations import describe_deviations, rank_cars
from socast.core.diagnose.diagnosis import diagnose
from socast.core.effects import get_library
from tests.support.inferences import infer
from tests.support.synthetic_windows import compute_coefficients, gather_with_model, make_tables, make_windows

pytestmark = pytest.mark.long

DATE = "2018-06-20"
"""A day of driving."""
SINCE = f"since={DATE}"
CAR = "vehicle=taxi-1"
GROUPS = {"taxi-0": "north", "taxi-1": "south", "taxi-2": "south", "taxi-3": "north"}


def find(shares, *, cars=4, groups=None, unknown=0.0, **errors):
    """Return the deviations and the ranking of synthetic cars with planted effects."""
    tables = make_tables(make_windows(cars), shares, unknown=unknown, **({"of_day": 0.01} | errors))
    windows, _, found = infer(tables, groups=groups)
    return describe_deviations(windows, found, dated=True), rank_cars(found)


@cache
def find_in_one_car(effect):
    """Return the same of cars of which one has an effect."""
    return find({f"{effect} {CAR}": 0.05})


def names(deviation):
    return [cause.effect for cause in deviation.causes]


@pytest.mark.parametrize("effect", ["cornering", "wet_road", "headwind"])
def test_effect_of_one_car_is_found_in_that_car_always(effect):
    (only,), _ = find_in_one_car(effect)
    assert (only.who, only.kind, only.since) == ("taxi-1", "always", None)
    assert effect in names(only)
    assert only.columns == [f"effect_{only.effect}", CAR]
    if only.effect == effect:
        low, high = only.coefficient.ci95
        error = (high - low) / 3.92
        true = compute_coefficients(make_windows(), {f"{effect} {CAR}": 0.05})[f"{effect} {CAR}"]
        assert abs(only.coefficient.value - true) < 3.5 * error


def test_car_with_an_effect_is_ranked_first():
    assert find({f"tyre_pressure {CAR}": 0.08})[1][0].car == "taxi-1"


def test_deviation_states_the_number_of_tests_of_all_cars_and_forms():
    """A change, and a difference for good, of each car, and a change of all cars."""
    assert find_in_one_car("headwind")[0][0].tests == 2 * 4 + 1
    assert find({f"headwind {CAR}": 0.022}, cars=6)[0][0].tests == 2 * 6 + 1


@pytest.mark.parametrize("effect", ["tyre_pressure", "standby", "roof_load"])
def test_effect_that_began_in_all_cars_is_found_with_its_date(effect):
    """The model has a term of this shape everywhere, which must not exclude a change."""
    (only,), _ = find({f"{effect} {SINCE}": 0.05})
    assert (only.who, only.kind) == ("all", "step")
    assert effect in names(only)
    first, last = only.since_ci90
    assert first <= DATE <= last
    low, high = only.share_ci95
    assert abs(only.share - 0.05) < 3.5 * (high - low) / 3.92


def test_effect_that_began_in_one_car_is_found_with_car_and_date():
    (only,), _ = find({f"roof_load {CAR} {SINCE}": 0.08}, of_day=0.005)
    assert (only.who, only.kind, only.since) == ("taxi-1", "step", DATE)
    assert "roof_load" in names(only)
    first, last = only.since_ci90
    assert first <= DATE <= last
    assert only.columns == ["effect_roof_load", CAR, SINCE]
    assert len(only.shifts) == 20
    late, early = ([each.share for each in only.shifts if bool(each.size) == there] for there in (True, False))
    assert np.mean(late) - np.mean(early) == pytest.approx(0.08, abs=0.02)


def test_change_that_exceeds_the_range_of_some_causes_has_a_plausible_one():
    deviations, _ = find({f"roof_load {SINCE}": 0.35})
    assert deviations
    for one in deviations:
        assert one.coefficient.plausible
        assert one.days > 1.0


def test_causes_of_the_same_shape_are_in_one_credible_set():
    """Within one car, a constant force and rolling resistance differ only by the number of passengers."""
    (only,), _ = find({f"brake_drag {CAR} {SINCE}": 0.08}, of_day=0.005)
    assert {"brake_drag", "tyre_pressure"} <= set(names(only))
    assert sum(cause.probability for cause in only.causes) >= 0.9


def test_single_car_is_held_against_its_own_past_only():
    found, cars = find({f"tyre_pressure {SINCE}": 0.15}, cars=1, seed=2)
    assert [one.kind for one in found] == ["step"]
    assert "tyre_pressure" in names(found[0])
    assert cars == []


def test_fault_of_one_day_is_an_episode_and_no_deviation():
    """A single day with much energy in bends determines the coefficient of bends of its car."""
    table = make_windows(4)
    day = (table["vehicle_id"] == "taxi-1") & (table["date"] == table["date"].iloc[-1])
    unknown = 0.15 * table["effect_cornering"] / table["effect_cornering"].mean() * table["distance_km"].mean() * 0.15
    tables = make_tables(table, unknown=np.where(day, unknown, 0.0), of_day=0.01)
    result = diagnose(*tables, gather_with_model(tables)[1], leave_out=())
    assert [(one.car, one.dates) for one in result.episodes] == [("taxi-1", [table["date"].iloc[-1]])]
    assert result.deviations == []


def test_two_deviating_cars_are_both_found():
    found, _ = find({f"wet_road {CAR}": 0.05, "headwind vehicle=taxi-2": 0.05})
    assert {one.who for one in found} == {"taxi-1", "taxi-2"}


def test_cars_are_described_in_spreads_with_intervals():
    _, cars = find({})
    for car in cars:
        assert car.share_ci95[0] < car.share < car.share_ci95[1]
        assert all(spread.error > 0.0 for spread in car.spreads)


def test_group_of_cars_that_changed_is_found_with_its_date():
    """An effect that begins in two of four cars is one of their group, and not of each of them."""
    found, _ = find({f"roof_load vehicle=taxi-{car} {SINCE}": 0.05 for car in (1, 2)}, groups=GROUPS)
    first = found[0]
    assert (first.of, first.who, first.kind) == ("group", "group south", "step")
    assert "roof_load" in names(first)
    low, high = first.since_ci90
    assert low <= DATE <= high
    assert first.columns == []


@pytest.mark.parametrize("growth", [0.0, 1.0 / 3.0])
@pytest.mark.parametrize(("cars", "days"), [(2, 5), (3, 3), (4, 2), (5, 4), (8, 1)])
def test_few_cars_and_days_give_a_result(cars, days, growth):
    """A change needs three dates before and after, so that cars of few shifts have none."""
    table = make_windows(cars, days, max(3, -(-24 // (cars * days))), 8)
    day = table.groupby("vehicle_id")["date"].rank(method="dense") - 1.0
    unknown = growth * table["effect_rolling"] * table["rolling_resistance"] * day
    unknown = np.where(table["vehicle_id"] == "taxi-0", unknown, 0.0)
    groups = {f"taxi-{car}": ("north", "south")[car % 2] for car in range(cars)}
    windows, _, found = infer(make_tables(table, unknown=unknown), groups=groups)
    for one in describe_deviations(windows, found, dated=True):
        assert np.isfinite([one.share, *one.share_ci95, one.q, one.evidence]).all()
        assert sum(cause.probability for cause in one.causes) >= 0.9


def test_nothing_is_found_without_any_candidate():
    windows, _, found = infer(make_tables(make_windows(2, 6, 3, 8)), without=get_library())
    assert describe_deviations(windows, found, dated=True) == []


def test_nothing_is_said_of_a_change_where_dates_are_invented():
    windows, _, found = infer(make_tables(make_windows(), {f"roof_load {CAR} {SINCE}": 0.08}, of_day=0.005))
    assert describe_deviations(windows, found, dated=True) != []
    assert describe_deviations(windows, found, dated=False) == []
