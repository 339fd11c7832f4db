"""Families hold what may be missing: effects everywhere, in one car, in a group, and since a date."""

import numpy as np
import pytest

from socast.core.diagnose.inference.scopes import (
    CHANGING,
    LEAST_DATES,
    MOST_DATES,
    PRIOR_ALL,
    PRIOR_CHANGE,
    list_families,
)
from socast.core.effects import get_library
from tests.support.random_columns import draw_columns


def select(families, of, who):
    return [family for family in families if (family.of, family.who) == (of, who)]


@pytest.fixture(scope="module")
def columns():
    return draw_columns(2, cars=3, dates=8, rides=1, windows=1)


@pytest.fixture(scope="module")
def families(columns):
    return list_families(columns, ("snow",), [("group north", np.arange(16))])


def test_effects_of_the_model_are_tested_within_scopes_only(families, columns):
    everywhere = {family.who for family in families if not family.is_scoped}
    assert everywhere == set(columns.names) - {"snow"}
    (always, _) = select(families, "car", "taxi-1")
    assert columns.names.index("snow") in always.effects


def test_changes_leave_days_before_and_after(families, columns):
    for who in columns.cars:
        _, change = select(families, "car", who)
        steps = [place for place in change.places if place.kind == "step"]
        assert [place.since for place in steps] == list(columns.dates[LEAST_DATES : 8 - LEAST_DATES + 1])
        assert all(LEAST_DATES <= place.weight.sum() <= 8 - LEAST_DATES for place in steps)
        assert {columns.names[at] for at in change.effects} == {"standby", "payload"}


def test_only_cars_grow_slowly(families):
    kinds = {(family.of, place.kind) for family in families for place in family.places}
    assert kinds == {
        *(("all", kind) for kind in ("always", "step")),
        *(("group", kind) for kind in ("always", "step")),
        *(("car", kind) for kind in ("always", "step", "ramp")),
    }
    for family in families:
        for place in family.places:
            assert 0.0 <= place.weight.min() <= place.weight.max() <= 1.0


def test_priors_of_changes_do_not_grow_with_the_fleet(families):
    cars = [family.prior for family in families if family.of == "car" and family.places[0].kind != "always"]
    assert sum(cars) == pytest.approx(PRIOR_CHANGE)
    (change,) = select(families, "all", "all")
    assert change.prior == PRIOR_ALL


def test_two_cars_of_a_model_are_not_held_against_each_other():
    families = list_families(draw_columns(2, cars=2, dates=8, rides=1, windows=1), ())
    kinds = [family.places[0].kind for family in families if family.of == "car"]
    assert kinds == ["step", "step"]


def test_dates_of_long_data_are_thinned():
    families = list_families(draw_columns(2, cars=1, dates=28 * 4, rides=1, windows=1), ())
    (change,) = [family for family in families if family.of == "car"]
    assert sum(place.kind == "step" for place in change.places) <= MOST_DATES


def test_scopes_may_be_left_out(columns):
    assert not any(family.is_scoped for family in list_families(columns, (), scopes=False))


def test_effects_that_may_begin_are_in_the_library():
    assert set(CHANGING) <= set(get_library())
