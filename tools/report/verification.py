"""Show how far the compiled filters are from filterpy's, in the terminal."""

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.text import Text

from socast.core.formatting import format_count as count_things
from socast.tools.report.document import Section, print_section
from socast.tools.report.table import FORMATS, UNKNOWN, tabulate_records
from socast.tools.verify.records import CarDifference, FilterDifference, Verification


def show(result: Verification, console: Console, *, cars: bool = False) -> None:
    """Print the differences of the filters, with `cars` also those of each car, and the verdict last."""
    for section in build_sections(result, cars=cars):
        print_section(section, console)
    console.print(Text(describe(result), style="bold"))


def build_sections(result: Verification, *, cars: bool = False) -> list[Section]:
    """Return the sections: all filters, and the cars of each."""
    formats = {**FORMATS, "power_of_ten": format_difference, "verdict": format_verdict}
    notes = tuple(filter(None, map(describe_passed_over, result.filters)))
    title = "Compiled Kalman filters against filterpy"
    filters = tabulate_records("", result.filters, FilterDifference, notes=notes, formats=formats)
    sections = [Section("filters", title, "", [filters])]
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
