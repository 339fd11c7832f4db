"""Convert the cells of a table to numbers and flags."""

import re
from functools import cache
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints

Bools = NDArray[np.bool_]

_NUMBER: Final = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
_BLANKS: Final = " \u00a0\u202f'’"
"""Marks that divide thousands and nothing else."""
_VALUE: Final = re.compile(r"[+-]?\d+([.,]\d+)?|\d{1,4}[-/.]\d\d?[-/.]\d{1,4}([ T].*)?")
"""A number or a date, with which no header is filled."""


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
