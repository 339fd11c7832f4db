"""A form outside the library resembles an effect on the same load; an effect of implausible size is such a cause."""

import pytest

from socast.core.diagnose.forms.building_blocks import CARRIERS, VARIABLES
from socast.core.diagnose.forms.terms import FormTerm, list_modulators
from socast.core.diagnose.inference.window_columns import gather_window_columns
from socast.core.diagnose.unknown_causes import describe_unknown, find_resembling
from tests.support.inferences import infer
from tests.support.synthetic_windows import gather_with_model, make_tables, make_windows

CARRIER = {each.name: each for each in CARRIERS}
VARIABLE = {each.name: each for each in VARIABLES}


@pytest.fixture(scope="module")
def seen():
    """Return windows with their columns."""
    windows, model = gather_with_model(make_tables(make_windows()))
    return windows, gather_window_columns(windows, model)


@pytest.mark.parametrize(
    ("carrier", "variable", "shape", "effect"),
    [
        ("rolling", "ambient", "below", "cold_rolling"),
        ("braking", "pack_temperature", "below", "cold_regen_limit"),
        ("braking", "charge", "above", "regen_full_battery"),
        ("auxiliary", "ambient", "above", "cabin_cooling"),
        ("braking", "wind", "linear", None),
        ("climbing", "ambient", "below", None),
    ],
)
def test_form_resembles_effect_of_the_same_load_and_condition(seen, carrier, variable, shape, effect):
    windows, columns = seen
    values = VARIABLE[variable].value(windows.table)
    found = set()
    for each in list_modulators(VARIABLE[variable], values):
        if each.shape == shape:
            form = FormTerm(CARRIER[carrier], (each,))
            energy = CARRIER[carrier].energy(windows.table) * each.evaluate(values)
            found.add(find_resembling(form, energy, columns))
    assert effect in found
    assert found <= {effect, None}


def test_effect_of_implausible_size_is_something_else_that_resembles_it():
    windows, _, inference = infer(make_tables(make_windows(4, 14, 2, 6), {"headwind": 0.06}, of_day=0.01))
    (cause,) = describe_unknown(windows, inference, dated=True)
    assert cause.formula == f"headwind at {cause.coefficient.value / 1.6:.1f} times its largest plausible coefficient"
    assert (cause.resembles, cause.coefficient.unit, cause.file) == ("headwind", "m^2", "")


def test_implausible_change_is_told_with_car_and_date_unless_dates_are_invented():
    planted = {"roof_load vehicle=taxi-1 since=2018-05-17": 0.6}
    windows, _, inference = infer(make_tables(make_windows(4, 14, 2, 6), planted, of_day=0.01))
    told = [cause.formula for cause in describe_unknown(windows, inference, dated=True)]
    assert any("in taxi-1 since 2018-05-17 at" in formula for formula in told)
    assert not any("since" in cause.formula for cause in describe_unknown(windows, inference, dated=False))
