"""Test deviations: what one car has, or what began on a date, is found with its car, date and size."""

from functools import cache

import numpy as np
import pytest

from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.siblings.deviations import diagnose_deviations
from socast.core.diagnose.siblings.search import LEVELS
from tests.support.synthetic_windows import compute_coefficients, gather_with_model, make_tables, make_windows

pytestmark = pytest.mark.long

SINCE = "since=2018-06-05"
CAR = "vehicle=taxi-1"


def find(shares, *, cars=4, groups=None, **errors):
    """Return the deviations and the ranking of synthetic cars with planted effects."""
    windows, model = gather_with_model(make_tables(make_windows(cars), shares, **({"of_day": 0.01} | errors)))
    known = np.empty((len(windows.measured), 0))
    result = diagnose_deviations(BaseProjection(windows, model), model, known, of_vehicle=groups)
    return result.deviations, result.cars


@cache
def find_in_one_car(effect):
    """Return the same of cars of which one has an effect."""
    return find({f"{effect} {CAR}": 0.05})


def names(deviation):
    return [cause.effect for cause in deviation.causes]


@pytest.mark.parametrize("effect", ["cornering", "night_lights", "headwind"])
def test_effect_of_one_car_is_found_in_that_car_always(effect):
    (only,), cars = find_in_one_car(effect)
    assert (only.who, only.kind, only.since) == ("taxi-1", "always", None)
    assert effect in names(only)
    assert only.columns == [f"effect_{only.effect}", CAR]
    assert cars[0].car == "taxi-1"
    if only.effect == effect:
        low, high = only.coefficient.ci95
        error = (high - low) / 3.92
        true = compute_coefficients(make_windows(), {f"{effect} {CAR}": 0.05})[f"{effect} {CAR}"]
        assert abs(only.coefficient.value - true) < 3.5 * error


def test_deviation_states_the_number_of_tests_of_all_cars_and_forms():
    of_four = find_in_one_car("headwind")[0][0].tests
    of_six = find({f"headwind {CAR}": 0.05}, cars=6)[0][0].tests
    assert of_four * (3 * 6 + 1) == of_six * (3 * 4 + 1)  # three forms of each car, and all cars from a date on


@pytest.mark.parametrize("effect", ["tyre_pressure", "standby", "roof_load"])
def test_effect_that_began_in_all_cars_is_found_with_its_date(effect):
    """The model has a term of this shape everywhere, which must not exclude a change."""
    (only,), _ = find({f"{effect} {SINCE}": 0.05})
    assert (only.who, only.kind) == ("all", "step")
    assert effect in names(only)
    first, last = only.since_ci90
    assert first <= SINCE.removeprefix("since=") <= last
    assert only.share_ci95[0] < 0.05 < only.share_ci95[1]


def test_effect_that_began_in_one_car_is_found_with_car_and_date():
    (only,), _ = find({f"roof_load {CAR} {SINCE}": 0.08}, of_day=0.005)
    assert (only.who, only.kind) == ("taxi-1", "step")
    assert "roof_load" in names(only)
    first, last = only.since_ci90
    assert first <= SINCE.removeprefix("since=") <= last


def test_plausible_causes_stand_before_implausible_ones():
    """A change of a third of the energy exceeds the range of some causes of its credible set."""
    deviations, _ = find({f"roof_load {SINCE}": 0.35})
    plausible = [cause.plausible for one in deviations for cause in one.causes]
    assert False in plausible
    for one in deviations:
        assert [cause.plausible for cause in one.causes] == sorted((c.plausible for c in one.causes), reverse=True)
        assert one.coefficient.plausible == one.causes[0].plausible
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


def test_findings_without_planted_effect_are_as_rare_as_the_levels_say():
    """A fleet has a false finding with a probability of 0.1 at most, and two of four with one of 0.05."""
    assert sum(LEVELS.values()) == pytest.approx(0.1)
    searches = [find({}, seed=seed, of_day=0.03, of_ride=0.002) for seed in range(4)]
    assert sum(found != [] for found, _ in searches) <= 1
    assert {len(cars) for _, cars in searches} == {4}


def test_fault_of_one_day_is_no_deviation():
    """A single day with much energy in bends determines the coefficient of bends of its car."""
    table = make_windows(4)
    day = (table["vehicle_id"] == "taxi-1") & (table["date"] == table["date"].iloc[-1])
    unknown = 0.15 * table["effect_cornering"] / table["effect_cornering"].mean() * table["distance_km"].mean() * 0.15
    windows, model = gather_with_model(make_tables(table, unknown=np.where(day, unknown, 0.0), of_day=0.01))
    result = diagnose_deviations(BaseProjection(windows, model), model, np.empty((len(windows.measured), 0)))
    assert result.deviations == []


def test_two_deviating_cars_are_both_found():
    found, _ = find({f"night_lights {CAR}": 0.06, "headwind vehicle=taxi-2": 0.06})
    assert {one.who for one in found} == {"taxi-1", "taxi-2"}


def test_cars_are_described_in_spreads_with_intervals():
    _, cars = find({})
    for car in cars:
        assert car.share_ci95[0] < car.share < car.share_ci95[1]
        assert all(spread.error > 0.0 for spread in car.spreads)


def test_group_of_cars_that_changed_is_found_with_its_date():
    """An effect that begins in two of four cars is one of their group, and not of each of them."""
    groups = {"taxi-0": "north", "taxi-1": "south", "taxi-2": "south", "taxi-3": "north"}
    shares = {f"cornering vehicle=taxi-{car} {SINCE}": 0.05 for car in (1, 2)}
    found, _ = find(shares, groups=groups)
    first = found[0]
    assert (first.of, first.who, first.kind) == ("group", "group south", "step")
    assert "cornering" in names(first)
    low, high = first.since_ci90
    assert low <= SINCE.removeprefix("since=") <= high
    assert first.columns == []


def test_groups_do_not_differ_without_planted_effect():
    groups = {"taxi-0": "north", "taxi-1": "south", "taxi-2": "south", "taxi-3": "north"}
    assert find({}, groups=groups)[0] == []
