"""The data dictionary, read from the nomenclature of columns."""  # noqa: INP001

from collections.abc import Sequence
from math import isinf

from markdown_text import code, plain, table

from socast.core import columns
from socast.core.columns import Column


def telemetry_columns() -> str:
    """Return the columns of a decoded sample."""
    return _columns(columns.TELEMETRY)


def signal_columns() -> str:
    """Return the columns that an effect may take as arguments."""
    return _columns(columns.SIGNALS)


def ride_columns() -> str:
    """Return the columns of the ride table."""
    return _columns(columns.RIDE_COLUMNS)


def window_columns() -> str:
    """Return the columns of the window table that the ride table has not."""
    shared = set(columns.RIDE_COLUMNS)
    return _columns([column for column in columns.WINDOW_COLUMNS if column not in shared])


def _columns(group: Sequence[Column]) -> str:
    """Return a table of columns; the range only where one of them has bounds."""
    rows = [
        [code(column.name), _unit(column.unit), _text(column.meaning), _text(column.source), _range(column)]
        for column in group
    ]
    head = ["column", "unit", "meaning", "source", "valid range"]
    return table(head, rows) if any(row[-1] for row in rows) else table(head[:4], [row[:4] for row in rows])


def _unit(unit: str) -> str:
    return "" if unit in {"", "1"} else code(unit)


def _text(words: str) -> str:
    """Return words with their inline code kept."""
    parts = words.split("`")
    return "`".join(part if i % 2 else plain(part) for i, part in enumerate(parts))


def _range(column: Column) -> str:
    """Return the valid range; empty where none is set."""
    if isinf(column.low) and isinf(column.high):
        return ""
    if isinf(column.high):
        return f"at least {column.low:g}"
    return f"{column.low:g} to {column.high:g}"
