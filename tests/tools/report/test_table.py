"""Columns of numbers are aligned to the right and columns of words to the left, in the terminal and in pages."""

import re

import pytest
from rich.console import Console

from socast.tools.report.document import Section, print_section
from socast.tools.report.page import render_tables
from socast.tools.report.table import UNKNOWN, Cell, ReportTable, Row


def make_table(*columns):
    """Return a table with these texts in its columns."""
    rows = tuple(Row(f"car-{i}", tuple(map(Cell, texts))) for i, texts in enumerate(zip(*columns, strict=True)))
    return ReportTable("Cars", "car", tuple(f"head {i}" for i in range(len(columns))), rows)


@pytest.mark.parametrize(
    "texts",
    [
        ["12", UNKNOWN],
        ["−0.5 (−6.8 to +6.2)", ""],
        ["< 0.001", "0.034"],
        ["12", "more than a year"],
        [UNKNOWN, ""],
        ["less than 0.1 %", f"{UNKNOWN} ●"],
    ],
)
def test_column_of_numbers_is_numeric(texts):
    assert make_table(texts).numeric == (True,)


@pytest.mark.parametrize(
    "texts", [["new tyres", UNKNOWN], ["2018-11-10 +16.1 %", UNKNOWN], ["leaf", "3 of them", "i3"]]
)
def test_column_of_words_or_dates_is_not_numeric(texts):
    assert make_table(texts).numeric == (False,)


def test_page_marks_heading_and_cells_of_words_alone():
    page = render_tables("Cars", [], [make_table(["1", "22"], ["tyres", "of the brakes"])])
    assert re.findall(r' class="words">([^<]*)<', page) == ["head 1", "tyres", "of the brakes"]
    assert "<td>22</td>" in page


def test_terminal_aligns_words_to_the_left():
    console = Console(width=80)
    with console.capture() as captured:
        print_section(Section("cars", "Cars", "", [make_table(["1", "22"], ["tyres", "of the brakes"])]), console)
    lines = captured.get().splitlines()
    short, long = (next(line for line in lines if word in line) for word in ("tyres", "of the brakes"))
    assert short.index("tyres") == long.index("of the brakes")
    assert short.index("1  ") == long.index("22") + 1
