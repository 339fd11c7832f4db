"""The report of an evaluation of state-of-charge forecasts: in the terminal, and as one page of tables and figures."""

from html import escape
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.text import Text

from core.evaluate.paper.results import plain
from tools.report.cells import count
from tools.report.evaluation.illustrations import Illustration
from tools.report.evaluation.result import Result, mapping
from tools.report.evaluation.sections import Section
from tools.report.evaluation.terminal import print_section
from tools.report.page import document, save
from tools.report.soc import figures, risk_tables, tables

TITLE: Final = "Forecasts of the state of charge"
AHEAD: Final = "ahead"
"""The section that ends the output, where the eye is."""
RESERVE: Final = "reserve"


def show(result: Any, console: Console) -> None:
    """Print an evaluation, and last what a reader looks for first.

    Parameters
    ----------
    result : mapping
        Of the evaluation.
    console : Console
        At least 120 columns wide.
    """
    found = plain(result)
    for section in sorted(sections(found), key=lambda section: section.key == AHEAD):
        if section.tables:
            print_section(section, console)
    for note in found["notes"]:
        console.print(Text(note, style="yellow"))


def write(result: Any, path: Path) -> None:
    """Write an evaluation as a page that needs nothing else.

    Raises
    ------
    SettingsError
        Where the file cannot be written.
    """
    found = plain(result)
    notes = "".join(f"<li>{escape(note)}</li>" for note in found["notes"])
    foot = f"<ul>{notes}</ul><p>Made by <code>socast evaluate-soc</code>.</p>"
    save(document(TITLE, "", sections(found), lambda key: illustrations(found, key), foot), path)


def sections(result: Result) -> list[Section]:
    """Return the sections of an evaluation that have something to show."""
    found = [
        Section(AHEAD, "How good the forecasts were", about(mapping(result, "about")), [tables.ahead(result)]),
        Section("conditions", "Under which conditions", "", tables.condition_tables(result)),
        Section("legs", "Leg by leg, up to the next charge", "", tables.leg_tables(result)),
        Section(RESERVE, "The risk of ending below a reserve", risk_tables.about(result), risk_tables.tables(result)),
    ]
    shown = [section for section in found if any(table.rows for table in section.tables)]
    return [*shown, Section("examples", "Shifts as examples", "", [])]


def illustrations(result: Result, key: str) -> list[Illustration]:
    """Return the figures of a section."""
    if key == AHEAD:
        return figures.of_time(result)
    if key == "conditions":
        return figures.of_conditions(result)
    if key == RESERVE:
        return figures.of_risk(result)
    return figures.of_examples(result) if key == "examples" else []


def about(told: Result) -> str:
    """Return what was judged, in words."""
    left = ", ".join(f"{count(n)} {why}" for why, n in mapping(told, "left_out").items())
    cars = f"{_counted(told['vehicles'], 'car')} on {_counted(told['vehicle_days'], 'car-day')}"
    warm_up = f"{_counted(told['warm_up_shifts'], 'shift')} came before enough was learned for an interval"
    return (
        f"{_counted(told['forecasts'], 'forecast')} of {count(told['judged_shifts'])} of "
        f"{_counted(told['shifts'], 'shift')}, by {cars}. Judged from {told['first_date']} to {told['last_date']}; "
        f"{warm_up}. Forecasts left out: {left or 'none'}."
    )


def _counted(n: int, thing: str) -> str:
    return f"{count(n)} {thing}{'' if n == 1 else 's'}"
