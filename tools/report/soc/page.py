"""Show an evaluation of state-of-charge forecasts: in the terminal, and as one page of tables and figures."""

from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.text import Text

from socast.core.records import to_json_values
from socast.tools.report.cells import format_count
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.evaluation.result import Result, get_mapping
from socast.tools.report.evaluation.sections import Section
from socast.tools.report.evaluation.terminal import print_section
from socast.tools.report.page import escape_text, render_document, save
from socast.tools.report.soc import figures, risk_tables, tables

TITLE: Final = "Forecasts of the state of charge"
AHEAD: Final = "ahead"
"""Key of the section that is printed last."""
RESERVE: Final = "reserve"


def show(result: Any, console: Console) -> None:
    """Print an evaluation, with its main result last."""
    values = to_json_values(result)
    for section in sorted(build_sections(values), key=lambda section: section.key == AHEAD):
        if section.tables:
            print_section(section, console)
    for note in values["notes"]:
        console.print(Text(note, style="yellow"))


def write(result: Any, path: Path) -> None:
    """Write an evaluation as a self-contained page."""
    values = to_json_values(result)
    notes = "".join(f"<li>{escape_text(note)}</li>" for note in values["notes"])
    foot = f"<ul>{notes}</ul><p>Made by <code>socast evaluate-soc</code>.</p>"
    save(
        render_document(
            "evaluate-soc", TITLE, "", build_sections(values), lambda key: build_illustrations(values, key), foot
        ),
        path,
    )


def build_sections(result: Result) -> list[Section]:
    """Return the sections of an evaluation that have something to show."""
    intervals = tables.tabulate_intervals(result)
    sections = [
        Section(
            AHEAD,
            "Errors of the forecasts",
            describe_evaluation(get_mapping(result, "about")),
            [tables.tabulate_by_time(result), *([intervals] if intervals.rows else [])],
        ),
        Section("conditions", "Errors by condition", "", tables.tabulate_conditions(result)),
        Section("legs", "Leg by leg, and around charges", "", tables.tabulate_legs(result)),
        Section(
            RESERVE,
            "The risk of ending below a reserve",
            risk_tables.describe_reserve(result),
            risk_tables.tabulate_risk(result),
        ),
    ]
    shown = [section for section in sections if any(table.rows for table in section.tables)]
    return [*shown, Section("examples", "Example shifts", "", [])]


def build_illustrations(result: Result, key: str) -> list[Illustration]:
    """Return the figures of a section."""
    if key == AHEAD:
        return figures.illustrate_time(result)
    if key == "conditions":
        return figures.illustrate_conditions(result)
    if key == RESERVE:
        return figures.illustrate_risk(result)
    return figures.illustrate_examples(result) if key == "examples" else []


def describe_evaluation(about: Result) -> str:
    """Return which forecasts were evaluated, in words."""
    left = ", ".join(f"{format_count(n)} {why}" for why, n in get_mapping(about, "left_out").items())
    cars = f"{_counted(about['vehicles'], 'car')} on {_counted(about['vehicle_days'], 'vehicle-day')}"
    warm_up = f"{_counted(about['warm_up_shifts'], 'shift')} ended before the first interval was available"
    return (
        f"{_counted(about['forecasts'], 'forecast')} of {format_count(about['judged_shifts'])} of "
        f"{_counted(about['shifts'], 'shift')}, by {cars}. "
        f"Evaluated from {about['first_date']} to {about['last_date']}; {warm_up}. "
        f"Forecasts left out: {left or 'none'}."
    )


def _counted(n: int, thing: str) -> str:
    return f"{format_count(n)} {thing}{'' if n == 1 else 's'}"
