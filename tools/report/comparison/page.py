"""Show a comparison: in the terminal, and as one page of tables and figures."""

from pathlib import Path
from typing import Final

from rich.console import Console
from rich.text import Text

from socast.core.evaluate.compare.records import Comparison, DatasetContrast, RideSample
from socast.tools.report.cells import format_count, format_estimate, format_percent
from socast.tools.report.comparison import figures, tables
from socast.tools.report.comparison.failures import describe_failures, illustrate_failures, list_pictures
from socast.tools.report.comparison.relative_tables import tabulate_relative_errors
from socast.tools.report.comparison.trace import build_ride_illustrations
from socast.tools.report.comparison.trace_page import MADE_BY
from socast.tools.report.evaluation.data_tables import MEASURED_BY
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.evaluation.sections import Section
from socast.tools.report.evaluation.terminal import print_section
from socast.tools.report.page import escape_text, render_document, save

TITLE: Final = "Models against measurement"
FAILURES: Final = "failures"
MODELS: Final = "models"
PLACES: Final = "places"
ORDER: Final = (PLACES, "worst", "against", MODELS)
"""Sections in the terminal; the most important one is printed last."""
MOST_COMMANDS: Final = 3
"""Number of commands that the terminal shows."""


def show(result: Comparison, console: Console) -> None:
    """Print a comparison, from where the first model fails to the errors of all models."""
    console.print(Text(describe_failures(result), style="bold"), highlight=False)
    for line in list_pictures(result, console.width):
        console.print(line, highlight=False)
    shown = [section for section in build_sections(result, commands=False) if section.key in ORDER]
    for section in sorted(shown, key=lambda section: ORDER.index(section.key)):
        print_section(section, console)
        if section.key == "worst":
            _print_commands(result, console)
    for note in result.notes:
        console.print(Text(note, style="yellow"))


def write(result: Comparison, path: Path) -> None:
    """Write a comparison as a self-contained page."""
    notes = "".join(f"<li>{escape_text(note)}</li>" for note in result.notes)
    sections = build_sections(result, commands=True)
    page = render_document(
        "compare", TITLE, "", sections, lambda key: build_illustrations(result, key), f"<ul>{notes}</ul>{MADE_BY}"
    )
    save(page, path)


def build_sections(result: Comparison, *, commands: bool) -> list[Section]:
    """Return the sections of a comparison that have something to show.

    Parameters
    ----------
    commands : bool
        Whether to show the commands that trace rides, the worst rides of every model, and conditions without a
        significant bias; a page has room for them.
    """
    names, against = list(result.models), result.against
    conditions = tables.list_varying_conditions(result)
    biased = conditions if commands else tables.list_biased_conditions(result)
    worst = [
        table
        for name in (names if commands else names[:1])
        for table in tables.tabulate_worst_rides(result, name, commands=commands)
    ]
    contrasts = []
    if against:
        sides = f"First: {against.first}. Second: {against.second}: {_about(against.about)}{_shared(against)}"
        by_condition = [table for name in names for table in tables.tabulate_datasets_by_condition(against, name)]
        contrasts = [
            Section("against", "Differences between the two sets", sides, tables.tabulate_datasets(against)),
            Section(
                "contrast",
                "Both sets by condition",
                "Bias of each model on both sets of rides.",
                by_condition,
                folded=True,
            ),
        ]
    sections = [
        Section(FAILURES, "Where it fails", describe_failures(result), []),
        Section(
            MODELS,
            "The models",
            _about(result.about),
            [
                tables.tabulate_models(result),
                tabulate_relative_errors(result),
                *([tables.tabulate_pairs(result)] if result.pairs else []),
            ],
        ),
        *contrasts,
        Section(
            PLACES,
            "Errors by condition",
            tables.describe_unbiased_conditions([name for name in conditions if name not in biased]),
            [tables.tabulate_errors_by_condition(result, name) for name in biased],
            closed=True,
        ),
        Section("worst", "The worst rides", _explain_worst(result) if commands else "", worst, closed=True),
        Section("traces", "Traces of the worst rides", _count_traces(result) if commands else "", [], closed=True),
    ]
    return [
        section
        for section in sections
        if any(table.rows for table in section.tables) or (section.key in {FAILURES, PLACES, "traces"} and section.text)
    ]


def build_illustrations(result: Comparison, key: str) -> list[Illustration]:
    """Return the figures of a section."""
    if key == FAILURES:
        return illustrate_failures(result)
    if key == MODELS:
        return figures.illustrate_scatters(result)
    if key == PLACES:
        return figures.illustrate_conditions(result)
    if key == "traces":
        return build_ride_illustrations(result.traces or {})
    if result.against and key in {"against", "contrast"}:
        illustrate = figures.illustrate_terms if key == "against" else figures.illustrate_datasets
        return illustrate(result.against)
    return []


def _explain_worst(result: Comparison) -> str:
    """Return how to see what happened in a ride."""
    linked = "Each ride is a link to its trace below. " if result.traces else ""
    return f"{linked}Each command shows the trace of its ride, term by term."


def _count_traces(result: Comparison) -> str:
    """Return how many rides are traced, or an empty text."""
    if not result.traces:
        return ""
    return f"{_counted(len(result.traces), 'ride')}, in the order of the tables. Power: mean of each window."


def _about(about: RideSample) -> str:
    """Return which rides were compared, in words."""
    left = ", ".join(f"{format_count(n)} {why}" for why, n in about.left_out.items())
    measured = {MEASURED_BY[name]: share for name, share in about.measured.items() if share}
    by = ", ".join(f"{name} {format_percent(share, 0)}" for name, share in measured.items())
    cars = f"{_counted(about.vehicles, 'car')}, {_counted(about.vehicle_days, 'vehicle-day')}"
    return (
        f"{format_count(about.rides)} of {format_count(about.read)} rides "
        f"from {about.first_date} to {about.last_date}: "
        f"{cars}. Left out: {left or 'none'}. "
        f"Mean consumption {format_estimate(about.consumption_kwh, 3)} kWh per ride, "
        f"{format_estimate(about.per_100km_kwh)} kWh/100 km. Energy measured by: {by or 'unknown'}."
    )


def _counted(n: int, thing: str) -> str:
    return f"{format_count(n)} {thing}{'' if n == 1 else 's'}"


def _shared(against: DatasetContrast) -> str:
    """Return a warning where rides are in both sets."""
    shared = format_count(against.shared)
    return f" {shared} rides are in both sets, so intervals of differences are too wide." if against.shared else ""


def _print_commands(result: Comparison, console: Console) -> None:
    """Print the commands that trace the worst rides of the first model, one per line, ready to copy."""
    worst = next(iter(result.models.values())).worst
    lines = dict.fromkeys(ride.command for ride in (*worst.absolute, *worst.relative) if ride.command)
    console.print()
    for line in list(lines)[:MOST_COMMANDS]:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if len(lines) > MOST_COMMANDS or len(result.models) > 1:
        console.print(Text("--html and --json have the command for every ride of these tables", style="dim"))
