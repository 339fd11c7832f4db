"""Print a comparison of tables: one line, and for each field how much differs and what differs first."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from io import StringIO
from math import inf, isnan
from typing import Any, Final

from rich.console import Console

from socast.core.formatting import format_count
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.testing.table_differences import FieldDifference, TableComparison, ValueDifference
from socast.tools.testing.tolerances import find_unit

MOST_FIELDS: Final = 6
"""Largest number of fields whose first differences are listed."""
MOST_CARS: Final = 3
"""Largest number of cars that are listed for a field."""
MOST_NAMES: Final = 10
"""Largest number of names in a line."""
WIDTH: Final = 100
"""Width of a difference in the output of pytest. [characters]"""


def show_comparison(comparison: TableComparison, console: Console) -> None:
    """Print in one line whether tables agree; else also what of each field differs first, and how much in all."""
    _print(console, comparison.describe())
    for what, absent in (("missing", comparison.missing), ("not expected", comparison.additional)):
        if absent:
            _print(console, f"{what}: {_list_absent(absent, comparison.rows)}")
    groups: dict[str, list[FieldDifference]] = defaultdict(list)
    for each in comparison.differences:
        groups[each.field].append(each)
    fields = list(groups.items())
    for field, group in fields[:MOST_FIELDS]:
        _print(console, "")
        _show_field(field, group, comparison, console)
    if others := fields[MOST_FIELDS:]:
        counts = [f"{field} ({sum(each.differing for each in group):,})" for field, group in others]
        _print(console, f"\nand {format_count(len(others), 'more field')}: {', '.join(counts)}")


def format_comparison(comparison: TableComparison) -> str:
    """Return what `show_comparison` prints."""
    text = StringIO()
    show_comparison(comparison, Console(file=text, width=WIDTH))
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


def make_record(comparison: TableComparison | str) -> dict[str, Any]:
    """Return a comparison, or why there is none, as plain values for JSON, under `comparison`."""
    if isinstance(comparison, str):
        return {"comparison": {"summary": comparison}}
    absent = {
        name: {subject: number for subject, (number, _) in getattr(comparison, name).items()}
        for name in ("missing", "additional")
    }
    differences = [
        {
            "subject": each.subject,
            "field": each.field,
            "differing": each.differing,
            "compared": each.compared,
            "first": {name: getattr(each.first, name) for name in ("time", "expected", "found")},
            "largest": {name: getattr(each.largest, name) for name in ("time", "expected", "found")},
        }
        for each in comparison.differences
    ]
    record = {
        "is_equal": comparison.is_equal,
        "summary": comparison.describe(),
        "rows": comparison.rows,
        "compared": comparison.compared,
        **absent,
        "differences": differences,
    }
    return {"comparison": record}


def _show_field(field: str, group: Sequence[FieldDifference], comparison: TableComparison, console: Console) -> None:
    """Print how much a field differs in all, and the first differences, those of a few cars."""
    unit = find_unit(field)
    count = f"{sum(each.differing for each in group):,} of {format_count(comparison.compared, comparison.rows)}"
    subject = "car" if not isnan(group[0].first.time) else "row"
    where = group[0].subject if len(group) == 1 else f"{len(group):,} {subject}s"
    _print(console, f"{field}{f' [{unit}]' if unit else ''}: differs in {count}, {where}{_describe_largest(group)}")
    joined = list(_join_subjects(group, subject))
    days = {f"{datetime.fromtimestamp(each.time, UTC):%Y-%m-%d}" for _, each in joined if not isnan(each.time)}
    day = days.pop() if len(days) == 1 else ""
    numbers = any(not isnan(each.allowed) for _, each in joined)
    head = [Column(subject)] + ([Column(f"first at{f' ({day})' if day else ''}")] if subject == "car" else [])
    head += [Column("expected", number=numbers), Column("found", number=numbers)]
    head += [Column(each, number=True) for each in ("difference", "tolerance")] if numbers else []
    table = make_table(head)
    for name, each in joined[:MOST_CARS]:
        cells = [name] + ([_format_time(each.time, day)] if subject == "car" else [])
        cells += [_format_value(each.expected, each.size), _format_value(each.found, each.size)]
        cells += [_format_number(each.size, "+.2g"), _format_number(each.allowed, ".2g")] if numbers else []
        table.add_row(*cells)
    console.print(table)
    if (more := len(joined) - MOST_CARS) > 0:
        _print(console, f" and {format_count(more, f'more {subject}')}")


def _describe_largest(group: Sequence[FieldDifference]) -> str:
    """Return the largest difference of a field among all cars, as the end of a sentence."""
    sized = [each for each in group if not isnan(each.largest.size)]
    if not sized:
        return ""
    most = max(sized, key=lambda each: abs(each.largest.size))
    size, time = most.largest.size, most.largest.time
    share = f" ({100 * abs(size / most.largest.expected):.2g} %)" if most.largest.expected else ""
    at = f" of {most.subject}" + ("" if isnan(time) else f" at {_format_time(time)}")
    return f", by up to {abs(size):.3g}{share}{at}"


def _join_subjects(group: Sequence[FieldDifference], subject: str) -> Iterator[tuple[str, ValueDifference]]:
    """Yield cars and their first differences; those whose field differs in the same way are one row."""
    alike: dict[tuple[str, str], list[FieldDifference]] = defaultdict(list)
    for each in group:
        alike[repr(each.first.expected), repr(each.first.found)].append(each)
    for first, *others in alike.values():
        yield format_count(1 + len(others), subject) if others else first.subject, first.first


def _list_absent(absent: Mapping[str, tuple[int, float]], rows: str) -> str:
    shown = [
        f"{format_count(number, rows)} of {subject}" + ("" if isnan(time) else f" from {_format_time(time)}")
        for subject, (number, time) in sorted(absent.items())[:MOST_NAMES]
    ]
    return "; ".join(shown) + (f"; and {len(absent) - MOST_NAMES:,} more" if len(absent) > MOST_NAMES else "")


def _print(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)


def _format_time(time: float, day: str = "") -> str:
    """Return a time in UTC; only that of the day where the day is known."""
    at = datetime.fromtimestamp(time, UTC)
    return f"{at:%H:%M:%S} UTC" if day else f"{at:%Y-%m-%dT%H:%M:%SZ}"


def _format_value(value: Any, difference: float) -> str:
    """Return a value with as many digits as show its difference, five at least."""
    if value is None:
        return "–"
    if not isinstance(value, float):
        return str(value)
    if isnan(difference) or not difference:
        return f"{value:.5g}"
    digits = next(n for n in range(5, 18) if n == 17 or abs(value) < abs(difference) * 10 ** (n - 1))
    return f"{value:.{digits}g}"


def _format_number(value: float, form: str) -> str:
    return "" if isnan(value) else "any" if value == inf else format(value, form)
