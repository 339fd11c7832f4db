"""Test the comparison of tables."""

import pandas as pd
import pytest

from socast.core.errors import SettingsError
from socast.tools.testing.table_differences import compare_tables

CARS = pd.DataFrame(
    {
        "vehicle_id": ["b", "a", "b"],
        "time_s": [1.0, 2.0, 3.0],
        "model": "m/1",
        "soc_pct": [80.0, 70.0, 60.0],
        "range_km.mean": [100.0, None, 90.0],
    }
)


def change(row, **values):
    table = CARS.astype(object)
    for name, value in values.items():
        table.loc[row, name.replace("range_km", "range_km.mean")] = value
    return table.infer_objects()


def test_same_tables_are_equal_whatever_the_order_of_the_rows_of_different_keys():
    comparison = compare_tables(CARS, CARS.iloc[::-1], rows="forecast")
    assert comparison.is_equal
    assert comparison.describe() == "3 forecasts as expected"


def test_fields_that_differ_are_listed_by_the_time_at_which_they_first_do():
    found = change(2, soc_pct=60.5, model="m/2")
    found.loc[0, "soc_pct"] = 81.5
    comparison = compare_tables(CARS, found)
    assert [(each.subject, each.field, each.differing, each.compared) for each in comparison.differences] == [
        ("b", "soc_pct", 2, 2),
        ("b", "model", 1, 2),
    ]
    first = comparison.differences[0]
    assert (first.first.time, first.first.expected, first.first.found, first.first.size) == (1.0, 80.0, 81.5, 1.5)
    assert first.largest.size == 1.5
    assert comparison.describe() == "3 values of 2 fields differ (soc_pct, model); 3 rows compared"


def test_missing_and_additional_rows_are_differences():
    comparison = compare_tables(CARS.iloc[:2], CARS.iloc[[0, 2]], rows="forecast")
    assert comparison.missing == {"a": (1, 2.0)}
    assert comparison.additional == {"b": (1, 3.0)}
    assert comparison.describe() == "1 forecast missing; 1 forecast not expected; 1 forecast compared"


def test_rows_of_the_same_key_are_compared_in_their_order():
    twice = pd.concat([CARS.iloc[[0]], CARS.iloc[[0]].assign(soc_pct=10.0)])
    assert compare_tables(twice, twice).is_equal
    assert not compare_tables(twice, twice.iloc[::-1]).is_equal


def test_unknown_value_differs_from_a_number_and_not_from_another_unknown_one():
    comparison = compare_tables(CARS, change(1, range_km=50.0))
    (only,) = comparison.differences
    assert (only.first.expected, only.first.found) == (None, 50.0)
    assert compare_tables(CARS, change(1, range_km=None)).is_equal


@pytest.mark.parametrize(
    ("tolerances", "equal"),
    [
        ({"soc_pct": 0.6}, False),
        ({"range_km": 1.5}, False),
        ({"soc_pct": 0.6, "range_km": 1.5}, True),
        ({"soc_pct": "1 %", "range_km": "1 %"}, True),
        ({"soc": 0.6, "range_km": "0.9 %"}, False),
        ({"soc": "any", "range": "any"}, True),
    ],
)
def test_tolerance_holds_for_its_fields_only(tolerances, equal):
    found = change(0, soc_pct=80.5, range_km=99.0)
    assert compare_tables(CARS, found, tolerances=tolerances).is_equal is equal


def test_difference_of_the_size_of_the_tolerance_is_none():
    assert compare_tables(CARS, change(0, soc_pct=80.5), tolerances={"soc_pct": 0.5}).is_equal


def test_any_value_of_a_text_is_allowed_by_any():
    assert compare_tables(CARS, change(0, model="m/9"), tolerances={"model": "any"}).is_equal
    assert not compare_tables(CARS, change(0, model="m/9"), tolerances={"soc": "any"}).is_equal


def test_column_of_one_table_only_differs():
    comparison = compare_tables(CARS, CARS.assign(further_km=1.0))
    assert {each.field for each in comparison.differences} == {"further_km"}


def test_counters_and_plain_tables_are_named_by_their_index_or_row():
    counters = pd.DataFrame({"count": [1, 2]}, index=pd.Index(["gap", "late"], name="counter"))
    (only,) = compare_tables(counters, counters.replace(2, 3)).differences
    assert (only.subject, only.first.expected, only.first.found) == ("late", 2, 3)
    (only,) = compare_tables(pd.DataFrame({"x": [1, 2]}), pd.DataFrame({"x": [1, 4]})).differences
    assert only.subject == "row 1"


def test_given_key_names_a_row():
    table = pd.DataFrame({"depot": ["n", "s"], "energy_kwh": [1.0, 2.0]})
    assert compare_tables(table, table.iloc[::-1], key=["depot"]).is_equal
    with pytest.raises(SettingsError, match="key 'dept': there is no such column; did you mean depot"):
        compare_tables(table, table, key=["dept"])


def test_times_that_agree_to_a_millisecond_name_the_same_row():
    assert compare_tables(CARS, CARS.assign(time_s=CARS["time_s"] + 1e-5)).is_equal


def test_truth_values_and_infinite_numbers_are_compared():
    table = pd.DataFrame({"fit": [True, False], "x": [float("inf"), 1.0]})
    assert compare_tables(table, table).is_equal
    assert len(compare_tables(table, table.assign(fit=True)).differences) == 1
    assert len(compare_tables(table, table.assign(x=1.0)).differences) == 1


def test_empty_tables_are_equal():
    assert compare_tables(CARS.iloc[:0], CARS.iloc[:0]).is_equal
    assert compare_tables(CARS, CARS.iloc[:0]).missing == {"a": (1, 2.0), "b": (2, 1.0)}
