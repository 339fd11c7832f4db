"""Read the clock of a table: the Unix times of its rows, also in the hour that a clock repeats."""

from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from socast.core.batch import Floats, Ints
from socast.core.columns import SECONDS_PER_DAY
from socast.tools.importers.table.cells import Bools, to_bools, to_numbers
from socast.tools.importers.table.table_file import Block, TableFile
from socast.tools.importers.table.text_times import parse_times, read_offsets, to_unix
from socast.tools.importers.table.time_words import TimeSource, find_day, find_origin

NEIGHBOUR: Final = 600.0
"""Longest time from a row of the repeated hour to the row beside it that shows which of both hours it is. [s]"""
SECONDS_PER_WEEK: Final = 7 * SECONDS_PER_DAY
EXCEL_ZERO: Final = np.datetime64("1899-12-30", "us")
"""Day 0 of a spreadsheet, for all days after February 1900."""


class RowTimes(NamedTuple):
    """Hold the times of rows.

    Parameters
    ----------
    times : (n,) float64
        Unix time, NaN where unknown. [s]
    missing, unclear : (n,) bool
        Rows without a time, and rows with a local time that the change of the clock repeats or skips.
    """

    times: Floats
    missing: Bools
    unclear: Bools


class TimeReader:
    """Read the times of tables block by block.

    Attributes
    ----------
    has_local_times : bool
        Whether some times so far stated no offset.
    """

    def __init__(self, source: TimeSource) -> None:
        self.source = source
        self.has_local_times = False
        self._path: Path | None = None
        self._last: dict[int, float] = {}
        self._days = 0
        self._last_of_file = np.nan
        self._last_offset = np.nan
        self._newest, self._zero = -np.inf, source.origin
        self._zero_of_file: float | None = None

    def read(self, table: TableFile, block: Block, vehicles: Ints) -> RowTimes:
        """Return the times of the rows of a block."""
        if self._path != table.path:
            self._path, self._last, self._days = table.path, {}, 0
            self._last_of_file = self._last_offset = np.nan
            self._zero_of_file = None
            if self.source.gap_s is not None and np.isfinite(self._newest):
                self._zero = float(np.ceil(self._newest + self.source.gap_s))
        cells = [block[name] for name in self.source.columns]
        missing: Bools = np.logical_or.reduce([to_bools(pc.is_null(each)) for each in cells])
        day = find_day(table.path) if self.source.day_from_file_name else None
        unclear = np.zeros(len(missing), bool)
        if self.source.unit_s is not None:
            times, unclear = self._count(table, cells, vehicles, day, block)
        elif pa.types.is_timestamp(cells[0].type):
            times, unclear = self._localize(cells[0].to_pandas(), vehicles)
        else:
            texts = [pc.utf8_trim_whitespace(pc.cast(each, pa.string())) for each in cells]
            joined = texts[0] if len(texts) == 1 else pc.binary_join_element_wise(*texts, " ")
            times, unclear = self._parse(joined, vehicles, day, block)
        times = times + self.source.add_weeks * SECONDS_PER_WEEK
        self._newest = max(self._newest, float(np.nanmax(times, initial=-np.inf)))
        return RowTimes(times if day is None else self._add_days(times), missing, unclear)

    def _count(
        self, table: TableFile, cells: list[Any], vehicles: Ints, day: str | None, block: Block
    ) -> tuple[Floats, Bools]:
        """Return the Unix times of numbers [s], and which of them are unclear."""
        numbers = [to_numbers(each, table.decimal)[0] for each in cells]
        unit = self.source.unit_s or 1.0
        if self.source.is_serial:
            valid = np.isfinite(numbers[0]) & (np.abs(numbers[0]) < 1e6)
            millis = np.round(np.where(valid, numbers[0], 0.0) * SECONDS_PER_DAY * 1e3).astype("i8")
            stamps = EXCEL_ZERO + millis.astype("timedelta64[ms]")
            stamps[~valid] = np.datetime64("NaT")
            return self._localize(pd.Series(stamps), vehicles)
        if self.source.origin_column is not None:
            return self._find_first(block, numbers[-1] * unit) + numbers[-1] * unit, np.zeros(len(numbers[-1]), bool)
        times = self._find_zero(table.path, day) + numbers[-1] * unit
        if len(numbers) > 1:
            times = times + numbers[0] * SECONDS_PER_WEEK
        return times, np.zeros(len(times), bool)

    def _find_first(self, block: Block, counted: Floats) -> float:
        """Return the Unix time of the number 0 in a file, by the first time in another column; NaN without one. [s]"""
        cells = block.get(self.source.origin_column or "")
        if self._zero_of_file is None and cells is not None:
            if pa.types.is_timestamp(cells.type):
                times, _ = self._localize(cells.to_pandas(), np.zeros(len(cells), "i4"))
            else:
                texts = pc.utf8_trim_whitespace(pc.cast(cells, pa.string()))
                times, _ = self._parse(texts, np.zeros(len(cells), "i4"), None, {})
            known = np.flatnonzero(np.isfinite(times) & np.isfinite(counted))
            if len(known):
                self._zero_of_file = float(times[known[0]] - counted[known[0]])
        return np.nan if self._zero_of_file is None else self._zero_of_file

    def _find_zero(self, path: Path, day: str | None) -> float:
        """Return the Unix time of the number 0 in a file. [s]"""
        if self.source.origin_form is not None:
            return find_origin(path, self.source.origin_form, self.source.zone)
        return self._zero if day is None else pd.Timestamp(day, tz=self.source.zone).timestamp()

    def _parse(self, texts: pa.Array, vehicles: Ints, day: str | None, block: Block) -> tuple[Floats, Bools]:
        """Return the Unix times of texts [s], NaN where unreadable, and which of them are unclear."""
        form = self.source.form
        if day is not None:
            texts = pc.binary_join_element_wise(pa.scalar(day), texts, " ")
            form = None if form is None else f"%Y-%m-%d {form}"
        parsed = parse_times(texts, form)
        offsets = parsed.offsets
        stated = block.get(self.source.offset_column or "")
        if stated is not None:
            found = self._fill(read_offsets(stated, parsed.stamps))
            offsets = np.where(np.isnan(offsets), found, offsets)
        times, unclear = to_unix(parsed.stamps) - offsets, np.zeros(len(offsets), bool)
        plain = np.isnan(offsets)
        if plain.any():
            times[plain], unclear[plain] = self._localize(pd.Series(parsed.stamps[plain]), vehicles[plain])
        return times, unclear

    def _fill(self, offsets: Floats) -> Floats:
        """Return the offsets of rows, with unknown ones as in the row before, or in the next one at the start."""
        known = pd.Series(offsets)
        filled = np.asarray(known.ffill().fillna(self._last_offset).bfill(), "f8")
        self._last_offset = float(filled[-1]) if len(filled) else self._last_offset
        return filled

    def _localize(self, stamps: Any, vehicles: Ints) -> tuple[Floats, Bools]:
        """Return the Unix times of dates [s], and which of them are unclear."""
        if stamps.dt.tz is not None:
            return to_unix(stamps.dt.tz_convert("UTC").dt.tz_localize(None)), np.zeros(len(stamps), bool)
        self.has_local_times = True
        times = self._to_unix(stamps, "NaT")
        unclear: Bools = np.isnan(times) & stamps.notna().to_numpy()
        if unclear.any():
            both = [self._to_unix(stamps, np.full(len(stamps), summer)) for summer in (True, False)]
            unclear = self._place_repeated(times, np.column_stack(both), vehicles, unclear)
        for vehicle in np.unique(vehicles).tolist():
            known = times[(vehicles == vehicle) & np.isfinite(times)]
            if len(known):
                self._last[vehicle] = float(known[-1])
        return times, unclear

    def _to_unix(self, stamps: Any, ambiguous: Any) -> Floats:
        """Return the Unix times of local times, NaN where they are skipped, or repeated and not decided. [s]"""
        local = stamps.dt.tz_localize(self.source.zone, ambiguous=ambiguous, nonexistent="NaT")
        return to_unix(local.dt.tz_convert("UTC").dt.tz_localize(None))

    def _place_repeated(self, times: Floats, both: Floats, vehicles: Ints, unclear: Bools) -> Bools:
        """Set the times of rows in the repeated hour by the rows beside them, and return which remain unclear."""
        for direction in (1, -1):
            last = dict(self._last) if direction == 1 else {}
            for row in np.arange(len(times))[::direction].tolist():
                vehicle = int(vehicles[row])
                if unclear[row] and vehicle in last:
                    for each in both[row, ::direction].tolist():
                        if 0 <= direction * (each - last[vehicle]) <= NEIGHBOUR:
                            times[row] = each
                            break
                if np.isfinite(times[row]):
                    last[vehicle] = float(times[row])
        return unclear & np.isnan(times)

    def _add_days(self, times: Floats) -> Floats:
        """Return times of which those after midnight are on the next day."""
        known = np.flatnonzero(np.isfinite(times))
        if not len(known):
            return times
        steps = np.diff(times[known], prepend=self._last_of_file)
        days = self._days + np.cumsum(steps < -SECONDS_PER_DAY / 2)
        self._days, self._last_of_file = int(days[-1]), float(times[known[-1]])
        times = times.copy()
        times[known] += days * SECONDS_PER_DAY
        return times
