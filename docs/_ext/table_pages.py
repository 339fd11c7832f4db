"""The data dictionary, read from the nomenclature of columns."""  # noqa: INP001

from collections.abc import Sequence
from math import isinf

from markdown_text import code, plain, table

from core import columns
from core.columns import Column


def telemetry_columns() -> str:
    """Return the columns of a decoded sample."""
    return _columns(columns.TELEMETRY)


def signal_columns() -> str:
    """Return the columns that an effect may take as arguments."""
    return _columns(columns.SIGNALS)


def _columns(group: Sequence[Column]) -> str:
    """Return a table of columns; the range only where one has a bound."""
    bounded = any(_range(column) for column in group)
    rows = [[code(column.name), _unit(column.unit), plain(column.meaning), _range(column)] for column in group]
    head = ["column", "unit", "meaning", "valid range"]
    return table(head, rows) if bounded else table(head[:3], [row[:3] for row in rows])


def _unit(unit: str) -> str:
    return "" if unit == "1" else code(unit)


def _range(column: Column) -> str:
    """Return the valid range; empty where none is set."""
    if isinf(column.low) and isinf(column.high):
        return ""
    if isinf(column.high):
        return f"at least {column.low:g}"
    return f"{column.low:g} to {column.high:g}"
