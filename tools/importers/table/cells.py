"""Find the form of a table in text, and convert its cells to numbers and flags."""

import csv
import re
from collections import Counter
from collections.abc import Sequence
from functools import cache
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.tools.importers.table.units import convertible

Bools = NDArray[np.bool_]

_NUMBER: Final = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
_BLANKS: Final = " \u00a0\u202f'’"
"""Marks that divide thousands and nothing else."""
_VALUE: Final = re.compile(r"[+-]?\d+([.,]\d+)?|\d{1,4}[-/.]\d\d?[-/.]\d{1,4}([ T].*)?")
"""A number or a date, with which no header is filled."""
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


def to_bools(array: pa.Array) -> Bools:
    """Return an array of pyarrow as numpy."""
    flags: Bools = array.to_numpy(zero_copy_only=False).astype(bool)
    return flags


def encode_words(cells: pa.Array) -> tuple[list[str], Ints]:
    """Return the different words in cells, and the place of that of each cell; the place after them is unknown."""
    coded = pc.dictionary_encode(pc.cast(cells, pa.string()))
    words = coded.dictionary.to_pylist()
    places: Ints = pc.fill_null(coded.indices, len(words)).to_numpy(zero_copy_only=False)
    return words, places


def to_numbers(cells: pa.Array, decimal: str, *, has_thousands: bool = False) -> tuple[Floats, pa.Array]:
    """Return cells as numbers, NaN where unknown, and those cells that are no numbers.

    Parameters
    ----------
    has_thousands : bool
        Whether the other mark divides thousands in this column, also where a number has only one of them.
    """
    if pa.types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    if not (pa.types.is_string(cells.type) or pa.types.is_large_string(cells.type)):
        numbers = pc.cast(cells, pa.float64(), safe=False)
        return numbers.to_numpy(zero_copy_only=False).astype("f8"), cells.slice(0, 0)
    texts = pc.utf8_trim_whitespace(cells)
    if has_thousands:
        texts = _join_thousands(texts, decimal, is_sure=False)
    plain = pc.replace_substring(texts, ",", ".") if decimal == "," else texts
    is_number = pc.match_substring_regex(plain, _NUMBER)
    if pc.any(pc.invert(is_number)).as_py():
        texts = _join_thousands(texts, decimal, is_sure=True)
        plain = pc.replace_substring(texts, ",", ".") if decimal == "," else texts
        is_number = pc.match_substring_regex(plain, _NUMBER)
    wrong = cells.filter(pc.fill_null(pc.invert(is_number), False))
    numbers = pc.cast(pc.if_else(is_number, plain, pa.scalar(None, plain.type)), pa.float64())
    return numbers.to_numpy(zero_copy_only=False).astype("f8"), wrong


def is_grouped(text: str, decimal: str, *, is_sure: bool = True) -> bool:
    """Return whether a number has thousands separators.

    Parameters
    ----------
    is_sure : bool
        Whether the mark must be one that cannot be decimal: it divides twice, or a decimal mark follows.

    Examples
    --------
    >>> [is_grouped(text, ".") for text in ("1,234.5", "1,234,567", "12 345", "1,234", "1'234.5", "12.5")]
    [True, True, True, False, True, False]
    """
    return re.match(_find_pattern(decimal, is_sure), text) is not None


def is_value(text: str) -> bool:
    """Return whether a cell is a number or a date."""
    return _VALUE.fullmatch(text) is not None


@cache
def _find_pattern(decimal: str, is_sure: bool) -> str:
    """Return the pattern of numbers with thousands separators."""
    mark, point = (r"\.", ",") if decimal == "," else (",", r"\.")
    blanks = rf"[+-]?[1-9]\d{{0,2}}([{_BLANKS}]\d{{3}})+({point}\d*)?"
    group = r"\d{3}" if decimal == "," else r"\d{2,3}"  # of two in India
    several = rf"[+-]?[1-9]\d{{0,2}}({mark}{group})+{mark}\d{{3}}({point}\d*)?"
    one = rf"[+-]?[1-9]\d{{0,2}}{mark}\d{{3}}{point}\d+"
    lone = "" if is_sure else rf"|[+-]?[1-9]\d{{0,2}}{mark}\d{{3}}({point}\d*)?"
    return rf"^({blanks}|{several}|{one}{lone})$"


def _join_thousands(texts: pa.Array, decimal: str, *, is_sure: bool) -> pa.Array:
    """Return texts without thousands separators."""
    has_marks = pc.fill_null(pc.match_substring_regex(texts, _find_pattern(decimal, is_sure)), False)
    if not pc.any(has_marks).as_py():
        return texts
    mark = "." if decimal == "," else ","
    return pc.if_else(has_marks, pc.replace_substring_regex(texts, rf"[{mark}{_BLANKS}]", ""), texts)


def suggest_decimal(text: str, decimal: str) -> str:
    """Return the remedy for a cell that is no number because of its decimal comma, empty for all other cells.

    Examples
    --------
    >>> suggest_decimal("10,5", "."), suggest_decimal("fast", ".")
    ("; set decimal = ',' in [file]", '')
    >>> suggest_decimal("12,345", ".")
    "; set decimal = ',' in [file], or export without thousands separators"
    """
    is_comma = text.count(",") == 1 and decimal == "."
    if not is_comma or not text.replace(",", "").lstrip("+-").isdigit():
        return ""
    may_divide = is_grouped(text, decimal, is_sure=False)
    return "; set decimal = ',' in [file]" + (", or export without thousands separators" if may_divide else "")


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
