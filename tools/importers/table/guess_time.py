"""Guess how a column of a table holds time: numbers in a unit, ISO 8601, or another format of text."""

import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from core.errors import ImportFileError
from tools.importers.table.guess_names import NamedColumn
from tools.importers.table.name_times import guess_name_form
from tools.importers.table.table_file import Block, TableFile

EPOCH_UNITS: Final = (("s", 1e8, 1e10), ("ms", 1e11, 1e13), ("us", 1e14, 1e16), ("ns", 1e17, 1e19))
"""Unit of Unix time, and the numbers that it has from 1973 to 2286."""
_DATES: Final = ("%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y", "%Y/%m/%d", "%d.%m.%y", "%m/%d/%y", "%Y%m%d")
_CLOCKS: Final = (" %H:%M:%S", " %H:%M:%S.%f", " %H:%M", " %I:%M:%S %p", " %I:%M %p", ", %H:%M:%S")
FORMATS: Final = tuple(date + clock for date, clock in product(_DATES, _CLOCKS))
"""Formats of text that are tried after ISO 8601."""
_TIME_OF_DAY: Final = r"\s*\d{1,2}:\d\d(:\d\d(\.\d+)?)?\s*"
_TIME_OF_HALF_DAY: Final = _TIME_OF_DAY + r"([ap]m\s*)?"
TRIED: Final = 2000
"""Cells that are tried."""


class GuessedTime(NamedTuple):
    """Hold how a table writes its time.

    Parameters
    ----------
    columns : tuple of str
        Column of the time, or of date and time of day.
    unit : str, optional
        Unit of numbers.
    form : str, optional
        Format of text; None is ISO 8601.
    has_zone : bool
        Whether each time states its offset, or is Unix time.
    needs_origin : bool
        Whether the numbers count from a time that the file does not state.
    reason : str
        Why.
    day_from_file_name : bool
        Whether the table holds times of day, and the name of its file the day.
    origin_form : str, optional
        Form of the start of the clock in the names of the files.
    """

    columns: tuple[str, ...]
    unit: str | None
    form: str | None
    has_zone: bool
    needs_origin: bool
    reason: str
    day_from_file_name: bool = False
    origin_form: str | None = None


def guess_time(candidates: Sequence[NamedColumn], blocks: Sequence[tuple[TableFile, Block]]) -> GuessedTime:
    """Return how a table writes its time.

    Parameters
    ----------
    candidates : sequence of NamedColumn
        Columns whose names are times.
    blocks : sequence of (TableFile, Block)
        First rows of files.

    Raises
    ------
    ImportFileError
        If no candidate can be read.
    """
    names = [each.name for each in candidates]
    units = {each.name: each.unit for each in candidates}
    path, example = blocks[0][0].path, ""
    less: list[GuessedTime] = []
    for columns in [*_pair_date_and_time(names, blocks), *((name,) for name in names)]:
        cells = _collect(columns, blocks)
        if cells is None or not len(cells):
            continue
        found = _read(columns, cells, units.get(columns[0]))
        if found is not None and not (found.day_from_file_name or found.needs_origin):
            return found
        less += [found] if found else []
        example = str(cells[0].as_py())
    if less:
        found = min(less, key=lambda each: each.day_from_file_name)
        return _find_origin(found, [table.path for table, _ in blocks]) if found.needs_origin else found
    raise ImportFileError(
        f"{path}: column '{names[0]}' holds {example[:40]!r}, which is no time in a known form; "
        "write a map by hand with a format in [time]"
    )


def _pair_date_and_time(names: Sequence[str], blocks: Sequence[tuple[TableFile, Block]]) -> list[tuple[str, ...]]:
    """Return the first two columns as date and time of day, in the order in which they are so."""
    for date, clock in (names[:2], names[:2][::-1]) if len(names) > 1 else ():
        cells = _collect((clock,), blocks)
        if cells is None or not len(cells) or pa.types.is_timestamp(cells.type):
            continue
        if (
            pd.Series([str(cell) for cell in cells.to_pylist()])
            .str.fullmatch(_TIME_OF_HALF_DAY, flags=re.IGNORECASE)
            .mean()
            > 0.9
        ):
            return [(date, clock)]
    return []


def _find_origin(found: GuessedTime, paths: Sequence[Path]) -> GuessedTime:
    """Return a clock that starts at 0 with the form of its start in the names of the files, where they have it."""
    form = guess_name_form(paths)
    if form is None:
        return found
    return found._replace(reason="numbers from a start that the name of the file holds", origin_form=form)


def _collect(columns: Sequence[str], blocks: Sequence[tuple[TableFile, Block]]) -> Any:
    """Return the first cells of a time, joined by a space where there are two columns."""
    for _, block in blocks:
        if all(name in block for name in columns):
            if len(columns) == 1:
                return block[columns[0]].drop_null().slice(0, TRIED)
            texts = [pc.utf8_trim_whitespace(pc.cast(block[name], pa.string())) for name in columns]
            return pc.binary_join_element_wise(*texts, " ").drop_null().slice(0, TRIED)
    return None


def _read(columns: tuple[str, ...], cells: Any, unit: str | None) -> GuessedTime | None:
    """Return how cells hold time, None where they hold none."""
    if pa.types.is_timestamp(cells.type):
        zone = cells.type.tz
        return GuessedTime(
            columns, None, None, zone is not None, False, f"Parquet time stamps{f' in {zone}' if zone else ''}"
        )
    texts = pd.Series([str(cell) for cell in cells.to_pylist()])
    if texts.str.fullmatch(_TIME_OF_DAY).mean() > 0.9:
        return _read_times_of_day(columns, texts)
    numbers = pd.to_numeric(texts.str.replace(",", ".", regex=False), errors="coerce")
    if numbers.notna().mean() > 0.9:
        return _read_numbers(columns, numbers.dropna().to_numpy(), unit)
    if pd.to_datetime(texts, format="ISO8601", errors="coerce", utc=True).notna().mean() > 0.9:
        has_zone = bool(texts.str.contains(r"\d[Tt ]\d.*(?:Z|[+-]\d\d:?(?:\d\d)?)$", regex=True).mean() > 0.9)
        return GuessedTime(columns, None, None, has_zone, False, "ISO 8601" + (" with offset" if has_zone else ""))
    fitting = [form for form in FORMATS if pd.to_datetime(texts, format=form, errors="coerce").notna().mean() > 0.9]
    if not fitting:
        return None
    best = min(fitting, key=lambda form: _measure_span(texts, form))
    others = [form for form in fitting if form[:2] != best[:2]]
    doubt = f", not {others[0]}, by the shorter span of time" if others else ""
    return GuessedTime(columns, None, best, False, False, f"the text has this format{doubt}")


def _read_times_of_day(columns: tuple[str, ...], texts: "pd.Series[str]") -> GuessedTime:
    """Return the format of times of day; the name of the file holds the day."""
    seconds = "%H:%M:%S" if texts.str.count(":").median() > 1 else "%H:%M"
    form = f"{seconds}.%f" if bool(texts.str.contains(".", regex=False).mean() > 0.5) else seconds
    reason = "times of day; the name of the file holds the day"
    return GuessedTime(columns, None, form, False, False, reason, day_from_file_name=True)


def _read_numbers(columns: tuple[str, ...], numbers: Any, unit: str | None) -> GuessedTime | None:
    """Return the unit of times in numbers."""
    if len(columns) > 1:
        return None
    middle = float(np.median(numbers))
    for epoch, low, high in EPOCH_UNITS:
        if low <= middle < high:
            return GuessedTime(columns, epoch, None, True, False, f"numbers near {middle:.4g} are Unix time in {epoch}")
    reason = "the numbers are too small for Unix time, so they count from a start that the file does not state"
    return GuessedTime(columns, unit or "s", None, False, True, reason)


def _measure_span(texts: "pd.Series[str]", form: str) -> float:
    """Return the time from the first to the last text, read in a format. [s]"""
    parsed = pd.to_datetime(texts, format=form, errors="coerce").dropna()
    return float((parsed.max() - parsed.min()).total_seconds())
