"""Show how far the compiled filters are from filterpy's: in the terminal, and as a page with a figure of it."""

from collections.abc import Mapping, Sequence
from math import log10
from typing import Final

from rich.console import Console
from rich.text import Text

from socast.core.formatting import format_count as count_things
from socast.tools.report.document import Illustration, Report, Section, print_section
from socast.tools.report.figure_style import REFERENCE_LINE, draw_dots, get_style, make_figure
from socast.tools.report.table import FORMATS, UNKNOWN, tabulate_records
from socast.tools.verify.records import CarDifference, FilterDifference, Verification

TITLE: Final = "Compiled Kalman filters against filterpy"
LEAST_DRAWN: Final = 1e-17
"""Difference at which smaller ones are drawn, none among them. [1]"""
QUANTITIES: Final = {"mean": "estimate", "covariance": "covariance"}
"""Field of a difference -> what differs."""
AXIS: Final = {
    "type": "log",
    "title_text": "relative difference [1]",
    "exponentformat": "power",
    "nticks": 6,
    "tickangle": 0,
}
CAPTION: Final = (
    "Largest relative difference of each car between a compiled filter and filterpy's, and the largest of all cars. "
    "The dashed line is the goal. Smaller is better; what is below 1e-17, or zero, is drawn there."
)


def show(result: Verification, console: Console, *, cars: bool = False) -> None:
    """Print the differences of the filters, with `cars` also those of each car, and the verdict last."""
    for section in build_sections(result, cars=cars):
        print_section(section, console)
    console.print(Text(describe(result), style="bold"))


def build_report(result: Verification, *, cars: bool = False) -> Report:
    """Return the report of the differences; the page shows the cars too, folded away without `cars`."""
    filters, of_cars = build_sections(result, cars=True)
    sections = [filters._replace(title="All filters"), of_cars._replace(closed=not cars)]
    return Report("verify", "verify", TITLE, sections, [describe(result)], (), result, {filters.key: _illustrate})


def _illustrate(result: Verification) -> list[Illustration]:
    """Return the figure of the differences, nothing where no step was compared."""
    known = [each for each in result.filters if each.compared]
    if not known:
        return []
    of_cars = [(each.filter, car) for each in known for car in each.cars if car.compared]
    every = [(each.filter, each) for each in known]
    traces = [
        draw_dots(name, get_style(place), *_list_points(differences), outline=outline)
        for name, place, differences, outline in (("each car", 2, of_cars, True), ("largest", 4, every, False))
    ]
    largest = max(value for trace in traces for value in trace.x)
    made = make_figure(
        traces,
        160 + 80 * len(known),
        x={**AXIS, "range": [log10(LEAST_DRAWN) - 0.5, max(log10(each) for each in (largest, result.goal)) + 1.0]},
        y={"autorange": "reversed", "type": "category", "title_text": "quantity"},
    )
    made.add_vline(x=result.goal, line=REFERENCE_LINE)
    at = {"x": log10(result.goal), "y": 1.0, "yref": "paper", "yanchor": "bottom"}  # of a logarithmic axis
    made.add_annotation(text="goal", showarrow=False, **at)
    return [Illustration("differences", "Relative differences", f"{CAPTION} {describe(result)}", made)]


def _list_points(differences: Sequence[tuple[str, FilterDifference | CarDifference]]) -> tuple[list[float], list[str]]:
    """Return the differences of filters, and the rows in which they are drawn."""
    points = [
        (max(value, LEAST_DRAWN), f"{name},<br>{what}")
        for name, each in differences
        for field, what in QUANTITIES.items()
        if (value := getattr(each, field)) is not None
    ]
    return [value for value, _ in points], [row for _, row in points]


def build_sections(result: Verification, *, cars: bool = False) -> list[Section]:
    """Return the sections: all filters, and the cars of each."""
    formats = {**FORMATS, "power_of_ten": format_difference, "verdict": format_verdict}
    notes = tuple(filter(None, map(describe_passed_over, result.filters)))
    filters = tabulate_records("", result.filters, FilterDifference, notes=notes, formats=formats)
    sections = [Section("filters", TITLE, "", [filters])]
    if cars:
        tables = [
            tabulate_records(
                each.filter,
                each.cars,
                CarDifference,
                more=[("passed over", [list_causes(car.passed_over) for car in each.cars])],
                formats=formats,
            )
            for each in result.filters
        ]
        sections.append(Section("cars", "Cars", "", tables))
    return sections


def describe(result: Verification) -> str:
    """Return the verdict on all filters."""
    compared, steps = (sum(getattr(each, name) for each in result.filters) for name in ("compared", "steps"))
    of_steps = f"{compared:,} of {count_things(steps, 'step')} were compared"
    missed = [each.filter for each in result.filters if each.meets_goal is False]
    if missed:
        return f"{of_steps}; the difference exceeds the goal of {result.goal:.0e}: {', '.join(missed)}."
    if not compared:
        return "No step was compared: the recordings hold no state of charge and no elevation of rides."
    absent = [each.filter for each in result.filters if each.meets_goal is None]
    rest = f" Nothing could be compared: {', '.join(absent)}." if absent else ""
    return f"{of_steps}; no difference exceeds the goal of {result.goal:.0e}.{rest}"


def describe_passed_over(difference: FilterDifference) -> str:
    """Return the causes for which steps of a filter were passed over; nothing without one."""
    return f"Passed over, {difference.filter}: {list_causes(difference.passed_over)}." if difference.passed else ""


def list_causes(passed_over: Mapping[str, int]) -> str:
    """Return causes with their numbers.

    Examples
    --------
    >>> list_causes({"charging": 1200, "reset after silence": 3})
    'charging 1,200, reset after silence 3'
    """
    causes: Sequence[str] = [f"{cause} {count:,}" for cause, count in passed_over.items()]
    return ", ".join(causes)


def format_difference(difference: float | None) -> str:
    """Return a relative difference.

    Examples
    --------
    >>> format_difference(3.21e-14), format_difference(None)
    ('3.2e-14', '–')
    """
    return UNKNOWN if difference is None else f"{difference:.1e}"


def format_verdict(meets_goal: bool | None) -> str:
    """Return whether the goal is met, in a word."""
    return {True: "met", False: "missed", None: UNKNOWN}[meets_goal]
