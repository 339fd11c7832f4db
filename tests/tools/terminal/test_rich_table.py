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


WIDE_HEADS = ("rides", "total", "speeding up", "climate and accessories while driving", "losses in braking", "climbing")


def wide_table(repeated=1):
    columns = [Column(head, number=bool(i)) for i, head in enumerate(("car", *WIDE_HEADS, "2018-11", "unexplained"))]
    made = make_table(columns, "Consumption", "All parts", repeated=repeated)
    made.add_row("taxi-001", *("10.33" for _ in WIDE_HEADS), "7.14 ± 0.15", "−0.09", end_section=True)
    made.add_row("all", *("1,697" for _ in WIDE_HEADS), "7.14 ± 0.15", "−0.09")
    return made


@pytest.mark.parametrize("width", [60, 80, 100, 140])
def test_table_that_is_too_wide_becomes_parts_of_whole_words_with_the_names_of_the_rows(width):
    lines = printed(wide_table(), width)
    assert max(map(len, lines)) <= width
    text = " ".join(lines)
    named = [line for line in lines if line.startswith(" taxi-001 ")]
    assert len(named) == sum(line.startswith(" all ") for line in lines)
    assert (len(named) > 1) == (width < 100)
    assert text.count("10.33") == len(WIDE_HEADS)
    assert text.count("7.14 ± 0.15") == 2
    assert set(" ".join(WIDE_HEADS).split()) | {"2018-11", "unexplained"} <= set(text.split())
    assert (text.count("Consumption"), text.count("All parts")) == (1, 1)


def test_every_part_repeats_as_many_columns_as_are_named():
    lines = printed(wide_table(repeated=2), 70)
    assert [line.split()[1] for line in lines if line.startswith(" taxi-001 ")] == ["10.33"] * 2
    assert sum("rides" in line for line in lines) == 2


def test_cells_that_stay_on_a_line_are_split_off_and_not_cut():
    made = make_table([Column(head, fixed=True) for head in ("car", "shift, UTC", "at first", "2 h before", "outcome")])
    cells = ("taxi-001", "01-16 12:00–14:55", "71 (58 to 83)", "54 (45 to 64)", "2 of 3")
    made.add_row(*cells)
    text = " ".join(printed(made, 50))
    assert all(cell in text for cell in cells)
    assert "…" not in text


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
