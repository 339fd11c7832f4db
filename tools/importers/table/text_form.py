"""Find the form of a table in text: its header, a row of units, its decimal mark and thousands separators."""

import csv
import re
from collections import Counter
from collections.abc import Sequence
from typing import Final

from socast.tools.importers.table.cells import is_grouped, is_value
from socast.tools.importers.table.units import convertible

MOST_ABOVE: Final = 50
"""Lines among which the header is looked for."""
_OTHER_UNIT: Final = re.compile(
    r"[mun]?s|min|h|d|sec(onds)?|date|time|hh:mm:ss|yyyy-mm-dd|unix|utc|n/?a|nm|rpm|k?pa|psi|bar|hz|g|l|k?wh",
    re.IGNORECASE,
)
"""Unit of a column that is no field, as it stands in a row below the header."""
_MEASURED: Final = (
    "speed_kmh",
    "odometer_km",
    "soc_pct",
    "battery_voltage_v",
    "battery_current_a",
    "hvac_w",
    "ambient_c",
)
"""Fields whose units are looked for in a row of units."""
SEPARATORS: Final = (",", ";", "\t", "|")


def find_header(lines: Sequence[str]) -> int:
    """Return the number of lines above the header: lines without any separator, before one with separators."""
    if len(lines) < 2 or any(separator in lines[0] for separator in SEPARATORS):
        return 0
    found = next((at for at, line in enumerate(lines[:MOST_ABOVE]) if any(mark in line for mark in SEPARATORS)), 0)
    follows = lines[found + 1] if found and found + 1 < len(lines) else ""
    return found if any(mark in lines[found] and mark in follows for mark in SEPARATORS) else 0


def split_cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line."""
    return next(csv.reader([line], delimiter=separator), [])


def find_units(rows: Sequence[Sequence[str]], names: Sequence[str]) -> tuple[str, ...]:
    """Return the units in the first row below the header, empty where it holds something else."""
    if len(rows) < 2 or len(rows[0]) != len(names) or not any(is_value(cell.strip()) for cell in rows[1]):
        return ()
    cells = [cell.strip().strip("[]()") for cell in rows[0]]
    words = [cell for cell in cells if cell and cell != "-"]
    known = sum(
        _OTHER_UNIT.fullmatch(word) is not None or any(convertible(word, field) for field in _MEASURED)
        for word in words
    )
    is_row = words and not any(map(is_value, words)) and known >= max(1, len(words) / 2)
    return tuple(cells) if is_row else ()


def find_decimal(rows: Sequence[Sequence[str]], separator: str) -> str:
    """Return the decimal mark of the numbers in a file; beside a separating comma, numbers with a comma are quoted."""
    cells = [cell.strip() for row in rows for cell in row]
    commas, points = ([cell for cell in cells if _is_decimal(cell, mark)] for mark in (",", "."))
    sure = {mark: sum(is_grouped(cell, mark) for cell in cells) for mark in (",", ".")}
    if not sure[","] and separator == "," and all(is_grouped(cell, ".", is_sure=False) for cell in commas):
        return "."
    return "," if len(commas) + sure[","] > len(points) + sure["."] else "."


def find_grouped(rows: Sequence[Sequence[str]], names: Sequence[str], decimal: str) -> tuple[str, ...]:
    """Return the columns whose numbers have thousands separators, also where one of them stands alone."""
    columns: list[list[str]] = [[] for _ in names]
    for row in rows:
        for cells, cell in zip(columns, row, strict=False):
            if not cell.isdigit():
                cells.append(cell.strip())
    has_points = any(_is_decimal(cell, decimal) for cells in columns for cell in cells) and decimal == "."
    found = []
    for name, cells in zip(names, columns, strict=True):
        others = [cell for cell in cells if _is_decimal(cell, "." if decimal == "," else ",")]
        is_lone = has_points and others and all(is_grouped(cell, decimal, is_sure=False) for cell in others)
        if is_lone or any(is_grouped(cell, decimal) for cell in cells):
            found.append(name)
    return tuple(found)


def _is_decimal(cell: str, mark: str) -> bool:
    """Return whether a cell is a number with a decimal mark."""
    whole, found, part = cell.lstrip("+-").partition(mark)
    return bool(found) and part.isdigit() and (whole.isdigit() or not whole)


def number_duplicates(names: Sequence[str]) -> tuple[str, ...]:
    """Return column names, each of those that appear several times with its number.

    >>> number_duplicates(["a", "b", "a", ""])
    ('a#1', 'b', 'a#2', 'column 4')
    """
    filled = [name or f"column {at}" for at, name in enumerate(names, start=1)]
    count, seen = Counter(filled), Counter[str]()
    numbered = []
    for name in filled:
        seen[name] += 1
        numbered.append(f"{name}#{seen[name]}" if count[name] > 1 else name)
    return tuple(numbered)
