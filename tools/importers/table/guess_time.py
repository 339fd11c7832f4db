"""Guess how a column of a table holds time: numbers in a unit, ISO 8601, or another format of text."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from socast.core.batch import Floats
from socast.core.errors import ImportFileError
from socast.tools.importers.table.guess_names import NamedColumn
from socast.tools.importers.table.table_file import Block, TableFile
from socast.tools.importers.table.text_times import ISO_OFFSET, list_forms, parse_times, to_unix
from socast.tools.importers.table.time_words import (
    FIRST_EPOCH,
    LAST_EPOCH,
    SERIAL,
    TimeSource,
    describe_doubt,
    find_time_unit,
    guess_name_form,
)

EPOCH_UNITS: Final = ("s", "ms", "us", "ns")
"""Units of Unix time."""
LONGEST_STEP: Final = 3600.0
"""Usual time between two rows above which numbers are no Unix time in a unit. [s]"""
SERIALS: Final = (36526.0, 73050.0)
"""The same days in a spreadsheet."""
GPS_ZERO: Final = "1980-01-05T23:59:42+00:00"
"""Time of the number 0 of GPS weeks, less the 18 leap seconds that UTC lags behind since 2017."""
LEAST_SHARE: Final = 0.9
"""Share of the cells that a form must read."""
_TIME_OF_DAY: Final = r"\s*\d{1,2}:\d\d(:\d\d(\.\d+)?)?\s*"
_TIME_OF_HALF_DAY: Final = _TIME_OF_DAY + r"([ap]m\s*)?"
_DATE: Final = r"\s*(\d{1,4}[-/. ]+[\w.]{1,12}[-/. ]+\d{1,4}\.?|\d{8}|\d{4}-\d\d-\d\d[T ]00:00(:00)?(\.0+)?)\s*"
TRIED: Final = 2000
"""Cells of each file that are tried."""

Blocks = Sequence[tuple[TableFile, Block]]


class GuessedTime(NamedTuple):
    """Hold how a table writes its time.

    Parameters
    ----------
    columns : tuple of str
        Column of the time, or of date and time of day.
    form : str, optional
        Format of text; None is ISO 8601.
    has_zone : bool
        Whether each time states its offset, or is Unix time.
    needs_origin : bool
        Whether the numbers count from a time that the file does not state.
    day_from_file_name : bool
        Whether the table holds times of day, and the name of its file the day.
    origin_form : str, optional
        Form of the start of the clock in the names of the files.
    others : tuple of str
        Other formats that read the text as well.
    origin, zone, offset_column, add_weeks, origin_column
        What the map says of them, None or 0 where it says nothing.
    """

    columns: tuple[str, ...]
    unit: str | None
    form: str | None
    has_zone: bool
    needs_origin: bool
    reason: str
    day_from_file_name: bool = False
    origin_form: str | None = None
    others: tuple[str, ...] = ()
    origin: str | None = None
    zone: str | None = None
    offset_column: str | None = None
    add_weeks: int = 0
    doubts: tuple[str, ...] = ()
    origin_column: str | None = None

    @property
    def is_absolute(self) -> bool:
        """Whether the cells alone state a date and a time."""
        return not (self.needs_origin or self.day_from_file_name)

    def to_source(self, unit: float | None = None, origin: float | None = None) -> TimeSource:
        """Return the clock to read the first rows with, in UTC where no zone is stated."""
        seconds = unit or (find_time_unit(self.unit) if self.unit else None)
        zero = pd.Timestamp(self.origin).timestamp() if self.origin else 0.0
        return TimeSource(
            self.columns,
            seconds,
            self.form,
            ZoneInfo("UTC"),
            zero if origin is None else origin,
            self.day_from_file_name,
            None,
            self.offset_column,
            self.add_weeks,
            self.unit == SERIAL,
        )


def list_clocks(candidates: Sequence[NamedColumn], blocks: Blocks) -> list[GuessedTime]:
    """Return the clocks that can be read, in the order of their columns."""
    names = [each.name for each in candidates]
    units = {each.name: each.unit for each in candidates}
    path, example = blocks[0][0].path, ""
    found = []
    for columns in [*_pair_weeks(names, blocks), *_pair_date_and_time(names, blocks), *((name,) for name in names)]:
        cells = collect_cells(columns, blocks)
        if cells is None or not len(cells):
            continue
        if (clock := _read(columns, cells, units.get(columns[-1]))) is not None:
            found.append(clock)
        example = str(cells[0].as_py())
    if not found:
        raise ImportFileError(
            f"{path}: column '{names[0]}' holds {example[:40]!r}, which is no time in a known form; "
            "write a map by hand with a format in [time]"
        )
    return found


def find_origin(found: GuessedTime, paths: Sequence[Path]) -> GuessedTime:
    """Return a clock that starts at 0 with the form of its start in the names of the files, where they have it."""
    form = guess_name_form(paths)
    if form is None:
        return found
    return found._replace(reason="numbers from a start that the name of the file holds", origin_form=form)


def _pair_weeks(names: Sequence[str], blocks: Blocks) -> list[tuple[str, ...]]:
    """Return the columns of GPS weeks and of the time in the week."""
    week = [name for name in names if re.search(r"week", name, re.IGNORECASE)]
    of_week = [name for name in names if re.search(r"tow|time ?of ?week", name.replace("_", " "), re.IGNORECASE)]
    weeks = [name for name in week if name not in of_week]
    if not weeks or not of_week:
        return []
    cells = collect_cells((weeks[0],), blocks)
    numbers = pd.to_numeric(pd.Series(cells.to_pylist() if cells is not None else []), errors="coerce")
    return [(weeks[0], of_week[0])] if len(numbers) and numbers.between(1, 4096).mean() > LEAST_SHARE else []


def _pair_date_and_time(names: Sequence[str], blocks: Blocks) -> list[tuple[str, ...]]:
    """Return the first column of dates and the first one of times of day."""
    shares: dict[str, list[str]] = {_TIME_OF_HALF_DAY: [], _DATE: []}
    for name in names:
        cells = collect_cells((name,), blocks)
        if cells is None or not len(cells) or pa.types.is_timestamp(cells.type):
            continue
        texts = pd.Series([str(cell) for cell in cells.to_pylist()])
        for pattern, found in shares.items():
            if texts.str.fullmatch(pattern, flags=re.IGNORECASE).mean() > LEAST_SHARE:
                found.append(name)
    clocks, dates = shares.values()
    return [(dates[0], clocks[0])] if dates and clocks else []


def collect_cells(columns: Sequence[str], blocks: Blocks) -> Any:
    """Return cells of a time from all files, joined by a space where there are two columns; None where none has it."""
    parts = []
    for _, block in blocks:
        if not all(name in block for name in columns):
            continue
        if len(columns) == 1:
            cells = block[columns[0]].drop_null()
        else:
            texts = [pc.utf8_trim_whitespace(pc.cast(block[name], pa.string())) for name in columns]
            cells = pc.binary_join_element_wise(*texts, " ").drop_null()
        if len(cells) > TRIED:
            cells = cells.take(pa.array(np.linspace(0, len(cells) - 1, TRIED).astype("i8")))
        parts.append(cells)
    if not parts:
        return None
    same = {part.type for part in parts}
    return pa.concat_arrays(parts if len(same) == 1 else [pc.cast(part, pa.string()) for part in parts])


def _read(columns: tuple[str, ...], cells: Any, unit: str | None) -> GuessedTime | None:
    """Return how cells hold time, None where they hold none."""
    if pa.types.is_timestamp(cells.type):
        zone = cells.type.tz
        return GuessedTime(
            columns, None, None, zone is not None, False, f"Parquet time stamps{f' in {zone}' if zone else ''}"
        )
    texts = pd.Series([str(cell) for cell in cells.to_pylist()])
    if texts.str.fullmatch(_TIME_OF_DAY).mean() > LEAST_SHARE:
        return _read_times_of_day(columns, texts)
    if len(columns) > 1 and "week" in columns[0].lower():
        of_week = pd.to_numeric(texts.str.split().str[-1], errors="coerce")
        unit = "ms" if of_week.max() > 604800.0 else "s"
        reason = "GPS weeks and the time in the week, with 18 leap seconds"
        return GuessedTime(columns, unit, None, True, False, reason, origin=GPS_ZERO)
    arrow = pa.array([text.strip() for text in texts], pa.string())
    numbers = pd.to_numeric(texts.str.replace(",", ".", regex=False), errors="coerce")
    if numbers.notna().mean() > LEAST_SHARE:
        return _read_numbers(columns, numbers.dropna().to_numpy(), unit, arrow)
    if pd.to_datetime(texts, format="ISO8601", errors="coerce", utc=True).notna().mean() > LEAST_SHARE:
        has_zone = bool(texts.str.contains(ISO_OFFSET, regex=True).mean() > LEAST_SHARE)
        return GuessedTime(columns, None, None, has_zone, False, "ISO 8601" + (" with offset" if has_zone else ""))
    return _read_text(columns, arrow)


def _read_text(columns: tuple[str, ...], texts: pa.Array) -> GuessedTime | None:
    """Return the forms of times in text, None where they have none."""
    forms = list_forms(texts.to_pylist())
    parsed = {form: parse_times(texts, form) for form in forms}
    shares = {form: float(np.mean(~np.isnat(parsed[form].stamps))) for form in forms}
    best = max(shares.values(), default=0.0)
    if best <= LEAST_SHARE:
        return None
    fitting = [form for form, share in shares.items() if share == best]
    form = fitting[0]
    stated = float(np.mean(np.isfinite(parsed[form].offsets)))
    words = "the text has this format" + (" and states its offset" if stated > LEAST_SHARE else "")
    doubts: list[str] = []
    if "%b" in form:
        words += ", months by their names"
        names = dict.fromkeys(re.findall(r"[^\W\d_]+", " ".join(texts.to_pylist()[:: max(1, len(texts) // 50)])))
        doubts = [f"'{name}' in column '{columns[0]}' is {doubt}" for name in names if (doubt := describe_doubt(name))]
        doubts = [f"{each}; where the second is meant, write months as numbers" for each in doubts]
    return GuessedTime(
        columns,
        None,
        form,
        stated > LEAST_SHARE,
        False,
        "; ".join([words, *doubts]),
        others=tuple(fitting[1:]),
        doubts=tuple(doubts),
    )


def _read_times_of_day(columns: tuple[str, ...], texts: "pd.Series[str]") -> GuessedTime:
    """Return the format of times of day; the name of the file holds the day."""
    seconds = "%H:%M:%S" if texts.str.count(":").median() > 1 else "%H:%M"
    form = f"{seconds}.%f" if bool(texts.str.contains(".", regex=False).mean() > 0.5) else seconds
    reason = "times of day; the name of the file holds the day"
    return GuessedTime(columns, None, form, False, False, reason, day_from_file_name=True)


def _read_numbers(columns: tuple[str, ...], numbers: Floats, unit: str | None, texts: pa.Array) -> GuessedTime | None:
    """Return the unit of times in numbers."""
    if len(columns) > 1:
        return None
    if float(np.median(numbers)) > 1e9 and (compact := _read_text(columns, texts)) and _is_recent(compact, texts):
        return compact._replace(reason="digits of year, month, day and time of day")
    low, middle, high = np.percentile(numbers, [1, 50, 99]).tolist()
    step = _find_step(numbers)
    for epoch in EPOCH_UNITS:
        seconds = find_time_unit(epoch) or 1.0
        if low * seconds >= FIRST_EPOCH and high * seconds < LAST_EPOCH and step * seconds <= LONGEST_STEP:
            return GuessedTime(columns, epoch, None, True, False, f"numbers near {middle:.4g} are Unix time in {epoch}")
    if low >= SERIALS[0] and high < SERIALS[1] and 0.0 < step * 86400.0 <= LONGEST_STEP and np.any(numbers % 1.0):
        reason = f"numbers near {middle:.6g} with fractions are days of a spreadsheet, in local time"
        return GuessedTime(columns, SERIAL, None, False, False, reason)
    reason = "the numbers are too small for Unix time, so they count from a start that the file does not state"
    return GuessedTime(columns, unit, None, False, True, reason)


def _is_recent(clock: GuessedTime, texts: pa.Array) -> bool:
    """Return whether nearly all times of a clock lie from 2000 to 2100."""
    times = to_unix(parse_times(texts, clock.form).stamps)
    return bool(np.mean((times >= FIRST_EPOCH) & (times < LAST_EPOCH)) > LEAST_SHARE)


def _find_step(numbers: Floats) -> float:
    """Return the usual difference between two different numbers that follow each other."""
    steps = np.abs(np.diff(numbers))
    return float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
