"""Show a comparison: in the terminal, and as one page of tables and figures."""

from collections.abc import Callable, Mapping
from typing import Any, Final

from rich.console import Console
from rich.text import Text

from socast.core.evaluate.compare.records import Comparison, RideSample
from socast.core.formatting import format_count
from socast.tools.report.comparison import figures, tables
from socast.tools.report.comparison.failures import describe_failures, illustrate_failures, list_pictures
from socast.tools.report.comparison.trace import illustrate_traces
from socast.tools.report.document import Illustration, Report, Section, place_notes, print_section
from socast.tools.report.evaluation.tables import MEASURED_BY
from socast.tools.report.table import format_estimate, format_percent

FAILURES: Final = "failures"
MODELS: Final = "models"
PLACES: Final = "places"
FIGURES: Final[Mapping[str, Callable[[Any], list[Illustration]]]] = {
    FAILURES: illustrate_failures,
    MODELS: figures.illustrate_scatters,
    PLACES: figures.illustrate_conditions,
    "traces": illustrate_traces,
    "against": lambda result: figures.illustrate_terms(result.against),
    "contrast": lambda result: figures.illustrate_datasets(result.against),
}
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
    for section in place_notes(sorted(shown, key=lambda section: ORDER.index(section.key)), last=True):
        print_section(section, console)
        if section.key == "worst":
            _print_commands(result, console)
    for note in result.notes:
        console.print(Text(note, style="yellow"))


def build_report(result: Comparison) -> Report:
    """Return the report of a comparison."""
    sections = build_sections(result, commands=True)
    return Report("compare", "compare", "Models against measurement", sections, (), result.notes, result, FIGURES)


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
    biased = [
        name
        for name in conditions
        if commands or any(entry.is_significant for one in result.models.values() for entry in one.by.get(name, ()))
    ]
    worst = [
        table
        for name in (names if commands else names[:1])
        for table in tables.tabulate_worst_rides(result, name, commands=commands)
    ]
    contrasts = []
    if against:
        count, warning = against.shared, "rides are in both sets, so intervals of differences are too wide."
        shared = f" {count:,} {warning}" if count else ""
        sides = f"First: {against.first}. Second: {against.second}: {_about(against.about)}{shared}"
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
    explained = traced = ""
    if commands:
        linked = "Each ride is a link to its trace below. " if result.traces else ""
        explained = f"{linked}Each command shows the trace of its ride, term by term."
    if commands and result.traces:
        traced = f"{format_count(len(result.traces), 'ride')}, in the order of the tables. Power: mean of each window."
    unbiased = ", ".join(name for name in conditions if name not in biased)
    by_model = [tables.tabulate_models(result), tables.tabulate_relative_errors(result)]
    by_model += [tables.tabulate_pairs(result)] if result.pairs else []
    sections = [
        Section(FAILURES, "Where it fails", describe_failures(result), []),
        Section(MODELS, "The models", _about(result.about), by_model),
        *contrasts,
        Section(
            PLACES,
            "Errors by condition",
            f"No significant bias by {unbiased}; --html and --json have these tables." if unbiased else "",
            [tables.tabulate_errors_by_condition(result, name) for name in biased],
            closed=True,
        ),
        Section("worst", "The worst rides", explained, worst, closed=True),
        Section("traces", "Traces of the worst rides", traced, [], closed=True),
    ]
    return [
        section
        for section in sections
        if any(table.rows for table in section.tables) or (section.key in {FAILURES, PLACES, "traces"} and section.text)
    ]


def _about(about: RideSample) -> str:
    """Return which rides were compared, in words."""
    left = ", ".join(f"{n:,} {why}" for why, n in about.left_out.items())
    measured = {MEASURED_BY[name]: share for name, share in about.measured.items() if share}
    by = ", ".join(f"{name} {format_percent(share, 0)}" for name, share in measured.items())
    cars = f"{format_count(about.vehicles, 'car')}, {format_count(about.vehicle_days, 'vehicle-day')}"
    return (
        f"{about.rides:,} of {about.read:,} rides "
        f"from {about.first_date} to {about.last_date}: "
        f"{cars}. Left out: {left or 'none'}. "
        f"Mean consumption {format_estimate(about.consumption_kwh, 3)} kWh per ride, "
        f"{format_estimate(about.per_100km_kwh)} kWh/100 km. Energy measured by: {by or 'unknown'}."
    )


def _print_commands(result: Comparison, console: Console) -> None:
    """Print the commands that trace the worst rides of the first model, one per line, ready to copy."""
    worst = next(iter(result.models.values())).worst
    lines = dict.fromkeys(ride.command for ride in (*worst.absolute, *worst.relative) if ride.command)
    console.print()
    for line in list(lines)[:MOST_COMMANDS]:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if len(lines) > MOST_COMMANDS or len(result.models) > 1:
        console.print(Text("--html and --json have the command for every ride of these tables", style="dim"))
