"""What an import read, what it could not read, and whether the values agree with each other."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.text import Text

from socast.core.formatting import format_count
from socast.tools.importers.table.agreement import Check
from socast.tools.importers.table.agreement_sums import CarSums
from socast.tools.importers.table.cells import suggest_decimal
from socast.tools.importers.table.units import has_power


class ImportSummary(NamedTuple):
    """Hold the summary of an import.

    Parameters
    ----------
    files, rows, samples : int
        Files and rows read, and samples written.
    hours : float
        Time between rows that lie close together. [h]
    causes : Counter of str
        Rows that could not be read, by cause.
    places : mapping of str to str
        Place of the first row of each cause.
    cells : Counter of str
        Cells that hold no number, by column.
    examples : mapping of str to str
        Text of the first such cell of each column.
    decimal : str
        Decimal mark with which numbers were read.
    """

    out: Path
    files: int
    rows: int
    samples: int
    hours: float
    causes: Counter[str]
    places: Mapping[str, str]
    cells: Counter[str]
    examples: Mapping[str, str]
    decimal: str
    notes: Sequence[str]
    cars: Sequence[CarSums]
    checks: Sequence[Check]


def describe_missing(fields: Collection[str]) -> list[str]:
    """Return a line for each of speed and energy that no field gives."""
    lines = []
    if "speed_kmh" not in fields:
        lines.append(
            "no speed was found: nothing can be predicted; name its column in [fields] of the map, such as "
            "speed_kmh = { column = 'v', unit = 'km/h' }"
        )
    if not has_power(fields):
        found = "the state of charge alone" if "soc_pct" in fields else "nothing"
        lines.append(
            f"no power was found, and no voltage with current: {found} measures the energy; if the file has a power, "
            "name its column in [fields] of the map, such as battery_power_kw = { column = 'p', unit = 'W' }"
        )
    return lines


def print_summary(summary: ImportSummary, console: Console) -> None:
    """Print a summary, one line for each statement."""
    for line, style in list_lines(summary):
        console.print(Text(line, style), soft_wrap=True)


def list_lines(summary: ImportSummary) -> list[tuple[str, str]]:
    """Return the lines of a summary with their styles."""
    cars = len(summary.cars)
    first = (
        f"{summary.out}: {format_count(summary.samples, 'sample')} of {format_count(cars, 'car')}, "
        f"{summary.hours:.1f} h, from {format_count(summary.rows, 'row')} in {format_count(summary.files, 'file')}"
    )
    lines = [(first, "")]
    for cause, count in summary.causes.most_common():
        place = f"; {summary.places[cause]}" if cause in summary.places else ""
        lines.append((f"left out: {format_count(count, 'row')} with {cause}{place}", "yellow"))
    for column, count in summary.cells.most_common():
        text = summary.examples[column]
        remedy = suggest_decimal(text, summary.decimal)
        lines.append((f"unknown: {count:,} cells of '{column}' hold no number, such as {text!r}{remedy}", "yellow"))
    lines += [(note, "yellow") for note in summary.notes]
    lines += [
        (_describe(check), "" if check.passed else "dim" if check.passed is None else "red") for check in summary.checks
    ]
    return lines


def _describe(check: Check) -> str:
    """Return a check as one line: value, limit and remedy."""
    if check.passed is None:
        return f"not checked: {check.name}: {check.found}"
    if check.passed:
        return f"agrees: {check.name}: {check.found} (limit: {check.limit})"
    return f"does not agree: {check.name}: {check.found} (limit: {check.limit}); {check.remedy}"
