"""Make a table of records: its columns, their heads and their formats follow from the declared fields."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

from socast.core.formatting import format_minus
from socast.core.records import Record, Shown, list_shown
from socast.tools.report.cells import (
    UNKNOWN,
    Cell,
    ReportTable,
    Row,
    format_chance,
    format_count,
    format_difference,
    format_energy,
    format_estimate,
    format_percent,
    format_probability,
    format_signed,
)


def format_digits(value: float | None, digits: int = 3) -> str:
    """Return a number with significant digits.

    Examples
    --------
    >>> format_digits(0.06234), format_digits(-1.0), format_digits(None)
    ('0.0623', '−1', '–')
    """
    return UNKNOWN if value is None else format_minus(f"{value:.{digits}g}")


FORMATS: Final[Mapping[str, Callable[[Any], str]]] = MappingProxyType(
    {
        "text": lambda value: UNKNOWN if value in {None, ""} else str(value),
        "names": lambda value: ", ".join(value) or UNKNOWN,
        "scope": lambda value: ", ".join(value) or "all",
        "number of": lambda value: format_count(len(value)),
        "count": format_count,
        "energy": format_energy,
        "estimate": format_estimate,
        "difference": format_difference,
        "difference, one decimal": lambda value: format_difference(value, 1),
        "difference, four decimals": lambda value: format_difference(value, 4),
        "four decimals": lambda value: format_estimate(value, 4),
        "probability": format_probability,
        "percent": format_percent,
        "chance": format_chance,
        "whole percent": lambda value: format_percent(value, 0),
        "fine percent": lambda value: format_percent(value, 2),
        "signed percent": lambda value: UNKNOWN if value is None else format_minus(f"{100.0 * value:+.1f} %"),
        "signed": format_signed,
        "score": lambda value: format_signed(value, 1),
        "three digits": format_digits,
        "two digits": lambda value: format_digits(value, 2),
    }
)
"""Formats that a field can declare, see `socast.core.records.declare`."""


def tabulate_records(
    title: str,
    records: Sequence[Record] | Mapping[str, Record],
    kind: type[Record],
    *,
    corner: str = "",
    fields: Sequence[str] = (),
    more: Sequence[tuple[str, Sequence[str]]] = (),
    label: Callable[[str], str] = str,
    total: str = "",
    notes: tuple[str, ...] = (),
    strong: Callable[[str, int, Any], bool] = lambda *_: False,
    numbered: bool = False,
    formats: Mapping[str, Callable[[Any], str]] = FORMATS,
) -> ReportTable:
    """Return a table with a row for each record and a column for each field that declares a head.

    Parameters
    ----------
    records : sequence or mapping of Record
        The keys of a mapping name the rows, below the head `corner`; otherwise the first field with a head does.
    strong : callable
        Function of the field, the place of the record and its value that returns whether a cell is emphasised.
    """
    shown_fields = list_shown(kind)
    columns = [(name, shown_fields[name]) for name in fields or shown_fields]
    if isinstance(records, Mapping):
        names, every = list(records), list(records.values())
    else:
        (first, head), *columns = columns
        corner, names, every = head.head, [str(getattr(each, first)) for each in records], list(records)

    def make_cell(name: str, shown: Shown, place: int, record: Record) -> Cell:
        value = getattr(record, name)
        text = formats[shown.format](value)
        if limits := getattr(record, shown.interval, None) if shown.interval else None:
            half = (limits[1] - limits[0]) / 2.0
            share = text.removesuffix(" %")
            text = f"{text} ± {half:.2g}" if share == text else f"{share} ± {100.0 * half:.2g} %"
        return Cell(text, strong=strong(name, place, value))

    rows = tuple(
        Row(
            f"{f'{place}. ' if numbered else ''}{label(row_name)}",
            (
                *(make_cell(name, shown, place, record) for name, shown in columns),
                *(Cell(texts[place - 1]) for _, texts in more),
            ),
            total=row_name == total,
        )
        for place, (row_name, record) in enumerate(zip(names, every, strict=True), start=1)
    )
    heads = (*(shown.head for _, shown in columns), *(head for head, _ in more))
    return ReportTable(title, corner, heads, rows, notes)
