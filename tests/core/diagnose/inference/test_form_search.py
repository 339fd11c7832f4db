"""What is outside the library is told as such, by a form like it, and takes no name of an effect."""

from functools import cache

import numpy as np
import pytest

from socast.core.diagnose.forms.suggestion import format_formula
from socast.core.diagnose.inference.form_search import ALIKE, KEPT, LEAST_DATES, FormSearch
from socast.core.diagnose.inference.window_columns import gather_window_columns
from socast.core.diagnose.inference.window_model import WindowModel
from socast.core.diagnose.records import UNKNOWN
from tests.support.inferences import infer
from tests.support.synthetic_windows import (
    compute_road_load_energy,
    gather_with_model,
    make_tables,
    make_unknown,
    make_windows,
)

pytestmark = pytest.mark.long

VARIABLES = {"crowded": "occupants", "low battery": "charge", "gusty": "wind"}


@cache
def infer_unknown(form):
    """Return what is found where a cause outside the library is planted."""
    *_, found = infer(make_tables(make_windows(), unknown=make_unknown(form), of_day=0.01), scopes=False)
    return found


@pytest.mark.parametrize("form", VARIABLES)
def test_cause_outside_the_library_is_found_by_a_form_like_it(form):
    likely = [one for one in infer_unknown(form).findings if one.is_likely]
    assert likely[0].form is not None
    assert VARIABLES[form] in likely[0].form.variables
    assert likely[0].probability > 0.95
    explained = np.sum([one.size.estimate.value * one.column for one in likely], axis=0)
    assert np.corrcoef(explained, make_unknown(form))[0, 1] > 0.8


@pytest.mark.parametrize("form", VARIABLES)
def test_no_effect_is_named_for_it(form):
    assert [one.effect for one in infer_unknown(form).findings if one.is_likely and one.form is None] == []


def test_its_forms_share_the_probability():
    first = infer_unknown("low battery").findings[0]
    assert sum(first.forms.values()) == pytest.approx(1.0)
    assert list(first.forms.values()) == sorted(first.forms.values(), reverse=True)
    assert first.causes[UNKNOWN] > 0.9
    assert first.effect == first.variant


def test_an_effect_of_the_library_is_no_unknown_cause():
    *_, found = infer(make_tables(make_windows(), {"headwind": 0.06}, of_day=0.01), scopes=False)
    (only,) = (one for one in found.findings if one.is_likely)
    assert only.effect == "headwind"
    assert only.causes.get(UNKNOWN, 0.0) < 0.1


def test_without_a_cause_no_form_is_likely():
    found = [infer(make_tables(make_windows(3, 16, seed=seed), seed=seed), scopes=False)[2] for seed in range(4)]
    assert sum(one.is_likely for each in found for one in each.findings if one.form) <= 1


def test_search_keeps_few_forms_of_the_same_kind_that_act_on_many_dates():
    windows, model = gather_with_model(make_tables(make_windows(), unknown=make_unknown("crowded")))
    search = FormSearch(windows)
    once = search.extend(WindowModel(gather_window_columns(windows, model)))
    columns = once.columns
    assert 0 < len(columns.unknown) <= KEPT
    assert columns.effects.shape[1] == len(columns.names) + len(columns.unknown)
    kinds = [(each.term.carrier.name, each.term.variables) for each in columns.unknown]
    assert max(map(kinds.count, kinds)) <= ALIKE
    for energy in columns.effects[:, len(columns.names) :].T:
        of_date = np.bincount(columns.date_of_day[columns.day], np.abs(energy))
        assert of_date.sum() ** 2 / (of_date**2).sum() >= LEAST_DATES
    again = search.extend(once).columns
    for each in (columns, again):
        formulas = [format_formula(form.term) for form in each.unknown]
        assert len(set(formulas)) == len(formulas)  # nothing is kept twice, whatever order its variables were tried in


def test_form_that_is_a_missing_effect_in_other_words_is_left_out():
    windows, model = gather_with_model(make_tables(make_windows(), {"wet_road": 0.06}))
    inner = WindowModel(gather_window_columns(windows, model))

    def is_kept(inside):
        found = FormSearch(windows).extend(inner, inside).columns.unknown
        return ("rolling", {"precipitation"}) in [(each.term.carrier.name, each.term.variables) for each in found]

    assert not is_kept(())
    assert is_kept(["wet_road"])  # a model that has it may have it in a wrong form


def test_no_form_reads_a_signal_for_which_another_stands():
    """Without the temperature of the battery, that of the outside stands for it."""
    table = make_windows()
    cold = table["effect_inertia_positive"] * np.maximum(10.0 - table["ambient_c"], 0.0)
    unknown = 0.06 * compute_road_load_energy(table).sum() / cold.sum() * cold.to_numpy()
    rides, windows = make_tables(table, unknown=unknown)
    seen, model = gather_with_model((rides, windows.assign(battery_temperature_c=np.nan)))
    columns = FormSearch(seen).extend(WindowModel(gather_window_columns(seen, model))).columns
    read = {name for form in columns.unknown for name in form.term.variables}
    assert "ambient" in read
    assert "pack_temperature" not in read


def test_products_of_columns_are_those_of_the_sums_of_days(rng):
    windows, model = gather_with_model(make_tables(make_windows(), of_day=0.01))
    inner = WindowModel(gather_window_columns(windows, model))
    further = rng.normal(size=(len(windows.measured), 3))
    sums = inner.sum_days(further)
    raw, beside = inner.prepare_products().multiply(further)
    last = sums.shape[1] - 1
    np.testing.assert_allclose(raw, [sums[:, at, at].sum() for at in range(last - 3, last)])
    np.testing.assert_allclose(beside[-1], sums[:, last - 3 : last, last].sum(axis=0))
    both = inner.add(further)  # the same products, as known effects
    rows = both.locate_known()
    np.testing.assert_allclose(np.diag(both.total[rows, rows]), raw)
    np.testing.assert_allclose(both.total[rows, -1], beside[-1])
    np.testing.assert_allclose(both.total[rows, : rows.start], beside[: rows.start].T, atol=1e-9 * np.abs(beside).max())
