"""Show an evaluation of state-of-charge forecasts: in the terminal, and as one page of tables and figures."""

from pathlib import Path
from typing import Final

from rich.console import Console
from rich.text import Text

from socast.core.evaluate.soc.records import EvaluatedShifts, SocEvaluation
from socast.tools.report.cells import format_count
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.evaluation.sections import Section
from socast.tools.report.evaluation.terminal import print_section
from socast.tools.report.page import escape_text, render_document, save
from socast.tools.report.soc import figures, risk_tables, tables

TITLE: Final = "Forecasts of the state of charge"
AHEAD: Final = "ahead"
"""Key of the section that is printed last."""
RESERVE: Final = "reserve"


def show(result: SocEvaluation, console: Console) -> None:
    """Print an evaluation, with its main result last."""
    for section in sorted(build_sections(result), key=lambda section: section.key == AHEAD):
        if section.tables:
            print_section(section, console)
    for note in result.notes:
        console.print(Text(note, style="yellow"))


def write(result: SocEvaluation, path: Path) -> None:
    """Write an evaluation as a self-contained page."""
    notes = "".join(f"<li>{escape_text(note)}</li>" for note in result.notes)
    foot = f"<ul>{notes}</ul><p>Made by <code>socast evaluate-soc</code>.</p>"
    sections = build_sections(result)
    save(render_document("evaluate-soc", TITLE, "", sections, lambda key: build_illustrations(result, key), foot), path)


def build_sections(result: SocEvaluation) -> list[Section]:
    """Return the sections of an evaluation that have something to show."""
    intervals = tables.tabulate_intervals(result)
    sections = [
        Section(
            AHEAD,
            "Errors of the forecasts",
            describe_evaluation(result.about),
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


def build_illustrations(result: SocEvaluation, key: str) -> list[Illustration]:
    """Return the figures of a section."""
    if key == AHEAD:
        return figures.illustrate_time(result)
    if key == "conditions":
        return figures.illustrate_conditions(result)
    if key == RESERVE:
        return figures.illustrate_risk(result)
    return figures.illustrate_examples(result) if key == "examples" else []


def describe_evaluation(about: EvaluatedShifts) -> str:
    """Return which forecasts were evaluated, in words."""
    left = ", ".join(f"{format_count(n)} {why}" for why, n in about.left_out.items())
    cars = f"{_counted(about.vehicles, 'car')} on {_counted(about.vehicle_days, 'vehicle-day')}"
    warm_up = f"{_counted(about.warm_up_shifts, 'shift')} ended before the first interval was available"
    return (
        f"{_counted(about.forecasts, 'forecast')} of {format_count(about.judged_shifts)} of "
        f"{_counted(about.shifts, 'shift')}, by {cars}. "
        f"Evaluated from {about.first_date} to {about.last_date}; {warm_up}. "
        f"Forecasts left out: {left or 'none'}."
    )


def _counted(n: int, thing: str) -> str:
    return f"{format_count(n)} {thing}{'' if n == 1 else 's'}"
