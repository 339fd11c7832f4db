"""Convert the cells of a table to numbers and flags."""

from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from core.batch import Floats

Bools = NDArray[np.bool_]

_NUMBER: Final = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"


def to_bools(array: pa.Array) -> Bools:
    """Return an array of pyarrow as numpy."""
    flags: Bools = array.to_numpy(zero_copy_only=False).astype(bool)
    return flags


def to_numbers(cells: pa.Array, decimal: str) -> tuple[Floats, pa.Array]:
    """Return cells as numbers, NaN where unknown, and those cells that are no numbers."""
    if pa.types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    if not (pa.types.is_string(cells.type) or pa.types.is_large_string(cells.type)):
        numbers = pc.cast(cells, pa.float64(), safe=False)
        return numbers.to_numpy(zero_copy_only=False).astype("f8"), cells.slice(0, 0)
    texts = pc.utf8_trim_whitespace(cells)
    if decimal == ",":
        texts = pc.replace_substring(texts, ",", ".")
    is_number = pc.match_substring_regex(texts, _NUMBER)
    wrong = cells.filter(pc.fill_null(pc.invert(is_number), False))
    numbers = pc.cast(pc.if_else(is_number, texts, pa.scalar(None, texts.type)), pa.float64())
    return numbers.to_numpy(zero_copy_only=False).astype("f8"), wrong


def suggest_decimal(text: str, decimal: str) -> str:
    """Return the remedy for a cell that is no number because of its decimal comma, empty for all other cells.

    Parameters
    ----------
    text : str
        The cell.
    decimal : str
        Decimal mark with which it was read.

    Examples
    --------
    >>> suggest_decimal("10,5", "."), suggest_decimal("fast", ".")
    ("; set decimal = ',' in [file]", '')
    """
    is_comma = text.count(",") == 1 and decimal == "."
    return "; set decimal = ',' in [file]" if is_comma and text.replace(",", "").lstrip("+-").isdigit() else ""
