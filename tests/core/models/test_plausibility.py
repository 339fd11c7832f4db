"""Test that coefficients are compared with the plausible ranges of their effects, by the figures of the car."""

import msgspec
import pytest

from socast.core.models import ANY, BASIC_PHYSICAL, Fit, Term
from socast.core.models.plausibility import (
    compute_plausible_range,
    describe_implausible,
    get_plausible_ranges,
    list_implausible,
)

LEAF = "nissan-leaf-2013"


def make_term(*columns: str) -> Term:
    return Term(name="x", columns=columns, unit="1")


def test_range_is_relative_to_the_figure_of_the_car():
    assert compute_plausible_range(make_term("effect_aero_drag", "drag_area_m2"), {"drag_area_m2": 0.5}) == (0.6, 4.0)
    assert compute_plausible_range(make_term("effect_aero_drag"), {}) == (0.3, 2.0)


def test_accessories_by_curve_have_the_range_of_their_effect():
    assert compute_plausible_range(make_term("accessories_kwh"), {}) == (0.2, 3.0)


def test_scopes_do_not_change_the_range():
    assert compute_plausible_range(make_term("effect_climbing", "vehicle=taxi-1"), {}) == (0.6, 1.6)


@pytest.mark.parametrize(
    "columns",
    [(), ("distance_km",), ("effect_rolling", "odometer_km"), ("effect_rolling", "effect_climbing")],
)
def test_terms_that_are_not_one_effect_have_no_range(columns):
    assert compute_plausible_range(make_term(*columns), {}) is None


def test_unknown_figure_of_the_car_gives_no_range():
    assert compute_plausible_range(make_term("effect_rolling", "rolling_resistance"), {}) is None


def test_implausible_coefficients_are_listed_by_vehicle_model():
    names = [term.name for term in BASIC_PHYSICAL.terms]
    values = tuple(-2.7 if name == "rolling" else 1.0 for name in names)
    fits = {ANY: BASIC_PHYSICAL.fits[ANY], LEAF: Fit(coefficients=values)}
    model = msgspec.structs.replace(BASIC_PHYSICAL, fits=fits)
    assert list_implausible(BASIC_PHYSICAL) == {}
    assert list_implausible(model) == {LEAF: ("rolling",)}
    assert get_plausible_ranges(model, LEAF)["rolling"] == (0.5, 3.125)
    assert describe_implausible(model) == [
        f"{LEAF}: coefficient of rolling -2.7 is outside its plausible range, 0.5 to 3.12"
    ]
