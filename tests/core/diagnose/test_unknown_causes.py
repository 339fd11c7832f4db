"""A form outside the library resembles the effect on the same load whose conditions it shares."""

import pytest

from socast.core.diagnose.forms.building_blocks import CARRIERS, VARIABLES
from socast.core.diagnose.forms.terms import FormTerm, list_modulators
from socast.core.diagnose.inference.window_columns import gather_window_columns
from socast.core.diagnose.unknown_causes import find_resembling
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
