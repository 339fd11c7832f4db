"""Show a comparison: in the terminal, and as one page of tables and figures."""

from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.text import Text

from socast.core.records import to_json_values
from socast.tools.report.cells import format_count, format_percent
from socast.tools.report.comparison import figures, tables
from socast.tools.report.comparison import trace as traced
from socast.tools.report.comparison.failures import describe_failures, illustrate_failures, list_pictures
from socast.tools.report.comparison.relative_tables import tabulate_relative_errors
from socast.tools.report.evaluation.data_tables import MEASURED_BY
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.evaluation.result import Result, get_mapping, get_number, get_part
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


def show(result: Any, console: Console) -> None:
    """Print a comparison, from where the first model fails to the errors of all models; or the trace of a ride."""
    values = to_json_values(result)
    if "trace" in values:
        for section in reversed(build_trace_sections(values["trace"])):
            print_section(section, console)
        return
    console.print(Text(describe_failures(values), style="bold"), highlight=False)
    for line in list_pictures(values, console.width):
        console.print(line, highlight=False)
    shown = [section for section in build_sections(values, commands=False) if section.key in ORDER]
    for section in sorted(shown, key=lambda section: ORDER.index(section.key)):
        print_section(section, console)
        if section.key == "worst":
            _print_commands(values, console)
    for note in values["notes"]:
        console.print(Text(note, style="yellow"))


def write(result: Any, path: Path) -> None:
    """Write a comparison, or the trace of a ride, as a self-contained page."""
    values = to_json_values(result)
    made_by = "<p>Made by <code>socast compare</code>.</p>"
    if "trace" in values:
        drawn = traced.build_illustrations(values["trace"])
        ride = get_part(values, "trace", "ride")
        title = f"Ride {ride['ride_key']}"
        page = render_document(
            "compare",
            title,
            "",
            build_trace_sections(values["trace"]),
            lambda key: drawn if key == "trace" else [],
            made_by,
        )
    else:
        notes = "".join(f"<li>{escape_text(note)}</li>" for note in values["notes"])
        page = render_document(
            "compare",
            TITLE,
            "",
            build_sections(values, commands=True),
            lambda key: build_illustrations(values, key),
            f"<ul>{notes}</ul>{made_by}",
        )
    save(page, path)


def build_sections(result: Result, *, commands: bool) -> list[Section]:
    """Return the sections of a comparison that have something to show.

    Parameters
    ----------
    commands : bool
        Whether to show the commands that trace rides, the worst rides of every model, and conditions without a
        significant bias; a page has room for them.
    """
    names = tables.list_models(result)
    conditions = tables.list_varying_conditions(result)
    biased = conditions if commands else tables.list_biased_conditions(result)
    worst = [
        table
        for name in (names if commands else names[:1])
        for table in tables.tabulate_worst_rides(result, name, commands=commands)
    ]
    against = get_mapping(result, "against")
    sides = f"First: {against['first']}. Second: {against['second']}: {_about(against['about'])}" if against else ""
    sections = [
        Section(FAILURES, "Where it fails", describe_failures(result), []),
        Section(
            MODELS,
            "The models",
            _about(result["about"]),
            [
                tables.tabulate_models(result),
                tabulate_relative_errors(result),
                *([tables.tabulate_pairs(result)] if result.get("pairs") else []),
            ],
        ),
        Section(
            "against", "Differences between the two sets", sides + _shared(against), tables.tabulate_datasets(result)
        ),
        Section(
            "contrast",
            "Both sets by condition",
            "Bias of each model on both sets of rides.",
            [table for name in names for table in tables.tabulate_datasets_by_condition(result, name)],
            folded=True,
        ),
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


def build_illustrations(result: Result, key: str) -> list[Illustration]:
    """Return the figures of a section."""
    if key == FAILURES:
        return illustrate_failures(result)
    if key == MODELS:
        return figures.illustrate_scatters(result)
    if key == PLACES:
        return figures.illustrate_conditions(result)
    if key == "against":
        return figures.illustrate_terms(result)
    if key == "traces":
        return traced.build_ride_illustrations(get_mapping(result, "traces"))
    return figures.illustrate_datasets(result) if key == "contrast" else []


def build_trace_sections(trace: Result) -> list[Section]:
    """Return the sections of a trace."""
    return [
        Section(
            "trace",
            "Prediction and measurement along the ride",
            traced.describe_ride(trace),
            [traced.tabulate_models(trace)],
        ),
        Section("terms", "Terms of the predictions", "", traced.tabulate_terms(trace)),
        Section("windows", "Window by window", "", [traced.tabulate_windows(trace)]),
    ]


def _explain_worst(result: Result) -> str:
    """Return how to see what happened in a ride."""
    linked = "Each ride is a link to its trace below. " if get_mapping(result, "traces") else ""
    return f"{linked}Each command shows the trace of its ride, term by term."


def _count_traces(result: Result) -> str:
    """Return how many rides are traced, or an empty text."""
    traces = get_mapping(result, "traces")
    return f"{_counted(len(traces), 'ride')}, in the order of the tables. Power: mean of each window." if traces else ""


def _about(about: Result) -> str:
    """Return which rides were compared, in words."""
    left = ", ".join(f"{format_count(n)} {why}" for why, n in get_mapping(about, "left_out").items())
    measured = {MEASURED_BY[name]: share for name, share in get_mapping(about, "measured").items() if get_number(share)}
    by = ", ".join(f"{name} {format_percent(share, 0)}" for name, share in measured.items())
    cars = f"{_counted(about['vehicles'], 'car')}, {_counted(about['vehicle_days'], 'vehicle-day')}"
    return (
        f"{format_count(about['rides'])} of {format_count(about['read'])} rides "
        f"from {about['first_date']} to {about['last_date']}: "
        f"{cars}. Left out: {left or 'none'}. "
        f"Mean consumption {tables.format_estimate(about['consumption_kwh'], 3)} kWh per ride, "
        f"{tables.format_estimate(about['per_100km_kwh'])} kWh/100 km. Energy measured by: {by or 'unknown'}."
    )


def _counted(n: int, thing: str) -> str:
    return f"{format_count(n)} {thing}{'' if n == 1 else 's'}"


def _shared(against: Result) -> str:
    """Return a warning where rides are in both sets."""
    shared = get_number(against.get("shared"))
    return (
        (f" {format_count(shared)} rides are in both sets, so intervals of differences are too wide.") if shared else ""
    )


def _print_commands(result: Result, console: Console) -> None:
    """Print the commands that trace the worst rides of the first model, one per line, ready to copy."""
    names = tables.list_models(result)
    worst = get_mapping(result, "models", names[0], "worst")
    lines = dict.fromkeys(str(ride["command"]) for rides in worst.values() for ride in rides if "command" in ride)
    console.print()
    for line in list(lines)[:MOST_COMMANDS]:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if len(lines) > MOST_COMMANDS or len(names) > 1:
        console.print(Text("--html and --json have the command for every ride of these tables", style="dim"))
