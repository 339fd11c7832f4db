"""Test what is printed of tables that differ."""

from io import StringIO

import pandas as pd
import pytest
from rich.console import Console

from socast.tools.testing.difference_report import format_comparison, show_comparison
from socast.tools.testing.table_differences import compare_tables

TIMES = [1_516_104_246.0 + 60 * i for i in range(40)]
CARS = pd.DataFrame(
    {"vehicle_id": [f"taxi-{i % 4}" for i in range(40)], "time_s": TIMES, "model": "m/1", "soc_pct": 80.0}
)


def describe(found, **options):
    return format_comparison(compare_tables(CARS, found, rows="forecast", **options))


def test_same_tables_are_one_line():
    assert describe(CARS) == "40 forecasts as expected"


def test_fields_are_shown_with_unit_count_largest_and_first_differences():
    soc = (80.0 + CARS.index / 1000).where(CARS.index >= 3, 80.0).where(CARS.index != 17, 84.0)
    text = describe(CARS.assign(soc_pct=soc), tolerances={"soc_pct": 0.0025})
    assert (
        "soc_pct [%]: differs in 37 of 40 forecasts, 4 cars, by up to 4 (5 %) of taxi-1 at 2018-01-16T12:21:06Z" in text
    )
    rows = [line.split() for line in text.splitlines()]
    assert ["taxi-3", "12:07:06", "UTC", "80", "80.003", "+0.003", "0.0025"] in rows
    assert text.splitlines()[-1] == " and 1 more car"


def test_cars_that_differ_alike_are_one_row():
    text = describe(CARS.assign(model="m/2"))
    assert "model: differs in 40 of 40 forecasts, 4 cars\n" in text
    assert "4 cars  12:04:06 UTC           m/1       m/2" in text


def test_missing_rows_are_told_by_car_with_the_first_time():
    text = describe(CARS.drop(index=[5, 9]))
    assert text.splitlines()[1] == "missing: 2 forecasts of taxi-1 from 2018-01-16T12:09:06Z"


def test_values_show_the_digits_that_differ():
    text = describe(CARS.assign(soc_pct=80.000001))
    assert "80.000001" in text
    assert "+1e-06" in text


def test_fields_beyond_the_first_are_counted():
    one, other = (CARS.assign(**{f"x{i}_km": float(i + more) for i in range(9)}) for more in (0, 1))
    text = format_comparison(compare_tables(one, other))
    assert "and 3 more fields: x6_km (40), x7_km (40), x8_km (40)" in text
    assert len(text.splitlines()) < 60


@pytest.mark.parametrize("width", [80, 120])
def test_tables_fit_the_terminal(width):
    text = StringIO()
    found = CARS.assign(soc_pct=CARS["soc_pct"] + CARS.index / 1e6)
    show_comparison(compare_tables(CARS, found), Console(file=text, width=width))
    assert "difference" in text.getvalue()  # the heading is whole
