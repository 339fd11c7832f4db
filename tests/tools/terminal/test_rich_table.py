"""Test that tables fit the terminal with whole numbers."""

import re
from io import StringIO

import pytest
from rich.console import Console
from rich.text import Text

from socast.tools.terminal.rich_table import LOOSE, WHOLE, Column, make_description, make_table, measure_parts

CELLS = ("extended_physical", "137", "0.064 ± 0.011 (16.9 %)", "−0.049 ± 0.014 * (−12.8 %)", "25.5 %", "11.03 ×")
HEADS = ("rides", "mean absolute error, kWh", "bias, kWh", "within ±5 %", "over noise")


def printed(renderable, width):
    console = Console(width=width, file=StringIO())
    console.print(renderable)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def table(*, cells=CELLS):
    made = make_table([Column("model"), *(Column(head, number=True) for head in HEADS)])
    made.add_row(Text(cells[0]), *cells[1:])
    return made


@pytest.mark.parametrize("width", [80, 90, 100, 120, 140])
def test_no_line_of_a_table_ends_inside_a_number(width):
    lines = printed(table(), width)
    assert max(map(len, lines)) <= width
    text = "\n".join(lines)
    for number in ("0.064 ± 0.011", "16.9 %", "−0.049 ± 0.014 *", "−12.8 %", "25.5 %", "11.03 ×"):
        assert number in text


@pytest.mark.parametrize("tied", [WHOLE, LOOSE])
@pytest.mark.parametrize(
    "whole",
    [
        "1.09 m²",
        "3 m³",
        "5 m",
        "1,500 J/kg",
        "360 V",
        "12 m/s²",
        "0.0398 → 0.0374",
        "(0.000 to 0.012)",
        "(−0.1 to 2)",
        "4 h",
    ],
)
def test_number_stays_with_its_unit_and_the_ends_of_its_range(whole, tied):
    assert measure_parts(f"a {whole} b", tied) == len(whole)


def test_words_after_a_number_are_not_tied_to_it():
    assert measure_parts("5 vehicles 3 more 2 to 4 km", WHOLE) == len("vehicles")


def test_uncertainty_moves_to_the_next_line_before_words_are_broken():
    lines = printed(table(), 74)
    assert sum("extended_physical" in line for line in lines) == 1
    assert any(re.search(r"± 0\.011\b", line) for line in lines)
    assert all(not line.rstrip().endswith("±") for line in lines)


def test_heading_is_broken_before_text():
    made = make_table([Column("ride"), Column("predicted", number=True)])
    made.add_row("taxi-003#13", "0.949")
    lines = printed(made, 22)
    assert any("taxi-003#13" in line for line in lines)
    assert not any("predicted" in line for line in lines)


def test_table_that_cannot_fit_is_still_printed_within_the_terminal():
    assert max(map(len, printed(table(), 40))) <= 40


def test_wide_terminal_needs_no_line_break():
    assert len(printed(table(), 140)) == 5  # three rules, the heading and the row


def test_same_table_is_fitted_anew_to_each_terminal():
    made = table()
    narrow = printed(made, 80)
    assert printed(made, 140) == printed(table(), 140)
    assert printed(made, 80) == narrow


def test_cells_keep_their_style_and_markup():
    made = table(cells=("model", "[bold]1[/bold]", *CELLS[2:]))
    console = Console(width=120, file=StringIO(), force_terminal=True, color_system="standard")
    console.print(made)
    assert "\x1b[1m1\x1b[0m" in console.file.getvalue()


def test_description_does_not_end_a_line_inside_a_number():
    lines = printed(make_description([("error", "a mean of 0.25 ± 0.03 kWh, 12 % of all")]), 24)
    assert "± 0.03 kWh" in " ".join(lines)
    assert any("0.25 ± 0.03 kWh" in line for line in lines)
