"""Test local effects: an effect of one car or since a date is selected within its scope only."""

import numpy as np
import pandas as pd
import pytest

from core.diagnose.candidates import build_candidates
from core.diagnose.diagnosis import keep_declared_values
from core.diagnose.evidence import ClusterSums
from core.diagnose.forward_selection import ForwardSelection, SelectionSettings
from core.diagnose.local_effects import LEAST_WINDOWS, list_scopes, select_local_effects
from core.diagnose.projection import BaseProjection
from core.models.features import Columns
from tests.support.synthetic_windows import compute_coefficients, gather_with_model, make_tables, make_windows

SINCE = "since=2018-06-05"
CAR = "vehicle=taxi-1"


def select_everywhere_and_locally(shares, *, cars=4, **errors) -> ForwardSelection:
    """Return a selection of effects that hold everywhere, and then of effects within scopes."""
    windows, model = gather_with_model(make_tables(make_windows(cars), shares, **({"of_day": 0.01} | errors)))
    clusters = [ClusterSums(windows.day), ClusterSums(windows.date)]
    selection = ForwardSelection(
        BaseProjection(windows, model), build_candidates(windows, model), clusters, SelectionSettings(0.002, 6, 0)
    )
    selection.select_all()
    select_local_effects(selection, keep_declared_values(build_candidates(windows, model, scopes=True)))
    return selection


def drives_late(date: str) -> int:
    """Return the number of driving days by which a date is later than `SINCE`."""
    days = np.unique(make_windows()["date"])
    first = np.searchsorted(days, SINCE.removeprefix("since="))
    return int(np.searchsorted(days, date.removeprefix("since=")) - first)


def named(selection: ForwardSelection) -> list[tuple[str, tuple[str, ...]]]:
    return [(each.effect, each.candidates.scope) for each in selection.selected]


@pytest.mark.parametrize("effect", ["cornering", "night_lights", "headwind"])
def test_effect_of_one_car_is_selected_for_that_car_only(effect):
    selection = select_everywhere_and_locally({f"{effect} {CAR}": 0.05})
    assert named(selection) == [(effect, (CAR,))]
    (finding,) = selection.list_missing_effects()
    low, high = finding.evidence.compute_interval(0, 0.999)
    assert low < compute_coefficients(make_windows(), {f"{effect} {CAR}": 0.05})[f"{effect} {CAR}"] < high


@pytest.mark.parametrize("effect", ["tyre_pressure", "standby", "roof_load"])
def test_effect_that_began_is_selected_since_its_date(effect):
    """The model has a term of this shape everywhere, which must not exclude the effect within a scope."""
    selection = select_everywhere_and_locally({f"{effect} {SINCE}": 0.05})
    (only,) = named(selection)
    assert only[0] == effect
    (since,) = only[1]
    assert abs(drives_late(since)) <= 2
    assert not selection.candidates.excluded.get(effect)


def test_effect_that_began_in_one_car_is_selected_with_car_and_date():
    selection = select_everywhere_and_locally({f"roof_load {CAR} {SINCE}": 0.08}, of_day=0.005)
    ((effect, (car, since)),) = named(selection)
    assert (effect, car) == ("roof_load", CAR)
    assert abs(drives_late(since)) <= 2


def test_similar_effects_within_scope_form_one_group():
    """Within one car, a constant force and rolling resistance differ only by the number of passengers."""
    selection = select_everywhere_and_locally({f"brake_drag {CAR} {SINCE}": 0.08}, of_day=0.005)
    (finding,) = selection.list_missing_effects()
    assert {"brake_drag", "tyre_pressure"} <= {finding.selected.effect, *(name for name, _ in finding.rivals)}


def test_single_car_has_only_date_scopes():
    selection = select_everywhere_and_locally({f"tyre_pressure {SINCE}": 0.08}, cars=1)
    assert all(each.car is None for each in list_scopes(selection.base.windows))
    ((effect, (since,)),) = named(selection)
    assert effect == "tyre_pressure"
    assert abs(drives_late(since)) <= 2


def test_effect_that_holds_everywhere_is_not_selected_within_scope():
    selection = select_everywhere_and_locally({"headwind": 0.05, "night_lights": 0.04})
    assert sorted(named(selection)) == [("headwind", ()), ("night_lights", ())]


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_selected_within_scopes_without_planted_effect(seed):
    assert named(select_everywhere_and_locally({}, seed=seed, of_day=0.03, of_ride=0.002)) == []


def test_fleet_effect_and_local_effect_are_both_selected():
    selection = select_everywhere_and_locally({"headwind": 0.04, f"night_lights {CAR}": 0.06})
    assert set(named(selection)) == {("headwind", ()), ("night_lights", (CAR,))}


@pytest.fixture(scope="module")
def windows():
    return gather_with_model(make_tables(make_windows()))[0]


class TestPlaces:
    def test_scoped_rows_match_indicator_columns(self, windows):
        for place in list_scopes(windows):
            one = np.prod([Columns(windows.table)[scope] for scope in place.scope], axis=0)
            np.testing.assert_array_equal(place.rows, one == 1.0)
            assert place.car is None or set(windows.vehicle[place.rows]) == {place.car}

    def test_scopes_have_enough_windows_inside_and_outside(self, windows):
        inside = np.array([place.rows.sum() for place in list_scopes(windows)])
        assert inside.min() >= LEAST_WINDOWS
        assert inside.max() <= len(windows.measured) - LEAST_WINDOWS

    def test_scopes_include_cars_dates_and_both(self, windows):
        scopes = [place.scope for place in list_scopes(windows)]
        assert len(scopes) == len(set(scopes))
        cars = {scope for scope in scopes if len(scope) == 1 and scope[0].startswith("vehicle=")}
        dates = {scope for scope in scopes if len(scope) == 1 and scope[0].startswith("since=")}
        assert cars == {(f"vehicle=taxi-{car}",) for car in range(4)}
        assert 3 <= len(dates) <= 10
        assert {scope for scope in scopes if len(scope) == 2} <= {car + date for car in cars for date in dates}
        assert min(pd.Timestamp(date.removeprefix("since=")) for (date,) in dates) > pd.Timestamp("2018-01-01")
