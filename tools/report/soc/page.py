"""Show an evaluation of state-of-charge forecasts: in the terminal, and as one page of tables and figures."""

from typing import Final

from rich.console import Console

from socast.core.evaluate.soc.records import EvaluatedShifts, SocEvaluation
from socast.core.formatting import format_count
from socast.tools.report.document import Report, Section
from socast.tools.report.soc import figures, tables
from socast.tools.report.table import keep_filled
from socast.tools.report.terminal import print_report

TITLE: Final = "Forecasts of the state of charge"
AHEAD: Final = "ahead"
"""Key of the section that is printed last."""
FIGURES: Final = {
    AHEAD: figures.illustrate_time,
    "conditions": figures.illustrate_conditions,
    "reserve": figures.illustrate_risk,
    "examples": figures.illustrate_examples,
}


def show(result: SocEvaluation, console: Console) -> None:
    """Print an evaluation, with its main result last."""
    print_report(build_report(result), console, last=AHEAD)


def build_report(result: SocEvaluation) -> Report:
    """Return the report of an evaluation."""
    sections = build_sections(result)
    return Report("evaluate-soc", "evaluate-soc", TITLE, sections, (), result.notes, result, FIGURES)


def build_sections(result: SocEvaluation) -> list[Section]:
    """Return the sections of an evaluation that have something to show."""
    by_time = [tables.tabulate_by_time(result), *keep_filled(tables.tabulate_intervals(result))]
    sections = [
        Section(AHEAD, "Errors of the forecasts", describe_evaluation(result.about), by_time),
        Section("conditions", "Errors by condition", "", tables.tabulate_conditions(result)),
        Section("legs", "Leg by leg, and around charges", "", tables.tabulate_legs(result)),
        Section(
            "reserve",
            "The risk of ending below a reserve",
            tables.describe_reserve(result),
            tables.tabulate_risk(result),
        ),
    ]
    return [*(each for each in sections if keep_filled(*each.tables)), Section("examples", "Example shifts", "", [])]


def describe_evaluation(about: EvaluatedShifts) -> str:
    """Return which forecasts were evaluated, in words."""
    left = ", ".join(f"{n:,} {why}" for why, n in about.left_out.items())
    cars = f"{format_count(about.vehicles, 'car')} on {format_count(about.vehicle_days, 'vehicle-day')}"
    warm_up = f"{format_count(about.warm_up_shifts, 'shift')} ended before the first interval was available"
    return (
        f"{format_count(about.forecasts, 'forecast')} of {about.judged_shifts:,} of "
        f"{format_count(about.shifts, 'shift')}, by {cars}. "
        f"Evaluated from {about.first_date} to {about.last_date}; {warm_up}. "
        f"Forecasts left out: {left or 'none'}."
    )
