"""Convert the cells of tables to rows with Unix times and numbers in the units of the contract, and count the rest."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from socast.core.batch import Floats, Ints
from socast.core.columns import SECONDS_PER_DAY
from socast.core.errors import ImportFileError
from socast.core.wire.keys import join_chunks
from socast.core.wire.messages import LONGEST_TEXT
from socast.tools.importers.table.cells import Bools, encode_words, suggest_decimal, to_bools, to_numbers
from socast.tools.importers.table.column_map import ColumnMap, FieldSource
from socast.tools.importers.table.row_order import TimeSpans
from socast.tools.importers.table.shared_stamps import StampStatistics
from socast.tools.importers.table.table_file import Block, TableFile, describe_header
from socast.tools.importers.table.text_stream import HEADER_AGAIN, RowFaults, SkippedFiles, is_header
from socast.tools.importers.table.text_times import parse_times, read_offsets, to_unix
from socast.tools.importers.table.time_words import FIRST_EPOCH, LAST_EPOCH, TimeSource, find_day, find_origin
from socast.tools.importers.table.units import POWER

NEIGHBOUR: Final = 600.0
"""Longest time from a row of the repeated hour to the row beside it that shows which of both hours it is. [s]"""
SECONDS_PER_WEEK: Final = 7 * SECONDS_PER_DAY
EXCEL_ZERO: Final = np.datetime64("1899-12-30", "us")
"""Day 0 of a spreadsheet, for all days after February 1900."""
NO_TIME: Final = "no time"
UNREADABLE_TIME: Final = "a time that cannot be read"
AMBIGUOUS_TIME: Final = "a local time that the change of the clock repeats or skips (set zone in [time] if it is UTC)"
IMPLAUSIBLE_TIME: Final = "a time before 2000 or after 2100"
NO_VEHICLE: Final = "no vehicle"
NO_VALUE: Final = "no value in any field of the map"
MOST_HEADERS: Final = 1000
"""Rows of a block without a readable time that are compared with a header."""
_OF_TIME: Final = (UNREADABLE_TIME, AMBIGUOUS_TIME, IMPLAUSIBLE_TIME, HEADER_AGAIN)
"""Causes that the text of the time shows."""
TRUE: Final = frozenset({"true", "1", "1.0", "yes", "y", "on", "t", "charging", "ja", "oui"})
FALSE: Final = frozenset({"false", "0", "0.0", "no", "n", "off", "f", "done", "stopped", "disconnected", "nein", "non"})
_WHOLE: Final = re.compile(r"^(\d+)\.0$")
"""A whole number, as programs export it from a column with empty cells."""
_MINUTES: Final = r"^[+-]?\d{1,3}[ °]+\d{1,2}(\.\d*)?['′]?$"
"""A position in degrees and minutes, such as `45 30.25`."""


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


class RowReader:
    """Read the rows of tables.

    Parameters
    ----------
    skipped : SkippedFiles, optional
        Receives files that cannot be read to their end; None refuses them.

    Attributes
    ----------
    vehicles, rides : list of str
        Names of vehicles and rides; rows hold their places in these lists.
    faults : RowFaults
        Rows that cannot be read, by cause.
    cells : Counter of (str, str)
        Cells that hold no number where one belongs, by column and first such text; their rows are kept.
    """

    def __init__(self, columns: ColumnMap, skipped: SkippedFiles | None = None) -> None:
        self.map, self.skipped = columns, skipped or SkippedFiles()
        self.vehicles: list[str] = []
        self.rides: list[str] = []
        self.rows = 0
        self.faults = RowFaults()
        self.cells: Counter[str] = Counter()
        self.examples: dict[str, str] = {}
        self.dtype = np.dtype(
            [("time", "f8"), ("vehicle", "i4"), ("ride", "i4"), *((name, "f8") for name in columns.fields)]
        )
        self.spans, self.stamps = TimeSpans(), StampStatistics()
        self._places: dict[str, dict[str, int]] = {"vehicle": {}, "ride": {}}
        self._times = TimeReader(columns.time)

    @property
    def has_local_times(self) -> bool:
        """Whether some times state no offset, so that they were read in the zone of the map."""
        return self._times.has_local_times

    def read(self, tables: Sequence[TableFile]) -> Iterator[np.ndarray]:
        """Yield rows as structured arrays, one per block of a file, in the order of the files."""
        for table in tables:
            before, of_width = self.rows, self.faults.wide
            with self.skipped.skip(table.path):
                for block in table.iterate_blocks(self.map.list_columns(), self.faults):
                    rows = self.convert(table, block)
                    self.spans.add(str(table.path), rows)
                    self.stamps.add(rows)
                    yield rows
            self.rows += self.faults.wide - of_width
            if table.path in self.skipped.rows:
                self.skipped.rows[table.path] = self.rows - before

    def explain_causes(self, decimal: str) -> str:
        """Return why rows cannot be read, and the remedy where the decimal mark is wrong."""
        found = self.faults.explain() or "no rows"
        wrong = next(
            ((text, each) for text in self.examples.values() if (each := suggest_decimal(text, decimal))), None
        )
        if wrong:
            return f"{found}, such as {wrong[0]!r}{wrong[1]}"
        first = self.faults.explain_first()
        return f"{found}; {first}" if first else found

    def convert(self, table: TableFile, block: Block) -> np.ndarray:
        """Return the readable rows of a block."""
        count = len(next(iter(block.values())))
        self.rows += count
        rows = np.zeros(count, self.dtype)
        keep = np.ones(count, bool)
        rows["vehicle"] = vehicles = self._read_vehicles(block, table, count)
        rows["time"] = self._read_time(table, block, vehicles, keep)
        self._drop(table, block, keep, vehicles < 0, NO_VEHICLE)
        rows["ride"] = self._read_rides(table, block, count)
        has_value = np.zeros(count, bool)
        for name, source in self.map.fields.items():
            rows[name] = self._read_field(table, block, name, source, count)
            has_value |= np.isfinite(rows[name])
        self._drop(table, block, keep, ~has_value, NO_VALUE)
        self._invert(rows)
        self._stop_parked(block, rows)
        return rows[keep]

    def _invert(self, rows: np.ndarray) -> None:
        """Turn the sign of current and power of the cars that the map names."""
        places = [place for place, name in enumerate(self.vehicles) if name in self.map.vehicle.inverted]
        if places:
            turned = np.isin(rows["vehicle"], places)
            for name in {"battery_current_a", POWER} & set(rows.dtype.names or ()):
                rows[name][turned] *= -1.0

    def _stop_parked(self, block: Block, rows: np.ndarray) -> None:
        """Set an unknown speed to 0 in rows in which the car is parked."""
        source = self.map.parked
        if source is None or source.column not in block or "speed_kmh" not in (rows.dtype.names or ()):
            return
        words, places = encode_words(block[source.column])
        parked = np.array([word.strip().lower() in source.words for word in [*words, ""]])
        rows["speed_kmh"][parked[places] & np.isnan(rows["speed_kmh"])] = 0.0

    def _drop(self, table: TableFile, block: Block, keep: Bools, wrong: Bools, cause: str) -> None:
        """Mark rows as unreadable, each under its first cause."""
        newly = keep & wrong
        if number := int(newly.sum()):
            row = int(np.argmax(newly))
            cell = block[self.map.time.columns[0]][row].as_py() if cause not in self.faults.causes else None
            text = str(cell) if cell is not None and cause in _OF_TIME else ""
            self.faults.add(cause, number, table.path, self.faults.find_line(row), text)
            keep &= ~wrong

    def _read_time(self, table: TableFile, block: Block, vehicles: Ints, keep: Bools) -> Floats:
        """Return the Unix time of each row. [s]"""
        found = self._times.read(table, block, vehicles)
        self._drop(table, block, keep, found.missing, NO_TIME)
        self._drop(table, block, keep, found.unclear, AMBIGUOUS_TIME)
        unreadable = keep & ~np.isfinite(found.times)
        if unreadable.any():
            self._drop(table, block, keep, self._find_headers(table, block, unreadable), HEADER_AGAIN)
        self._drop(table, block, keep, ~np.isfinite(found.times), UNREADABLE_TIME)
        with np.errstate(invalid="ignore"):
            implausible = (found.times < FIRST_EPOCH) | (found.times >= LAST_EPOCH)
            self._drop(table, block, keep, implausible, IMPLAUSIBLE_TIME)
        return found.times

    def _find_headers(self, table: TableFile, block: Block, unreadable: Bools) -> Bools:
        """Return which rows are the header again, and refuse a file with another header between its rows."""
        again = np.zeros(len(unreadable), bool)
        named = [(name.rpartition("#")[0] if "#" in name else name, cells) for name, cells in block.items()]
        for row in np.flatnonzero(unreadable)[:MOST_HEADERS].tolist():
            cells = [str(cells[row].as_py() or "") for _, cells in named]
            if all(cell.strip() == name for cell, (name, _) in zip(cells, named, strict=True)):
                again[row] = True
            elif is_header(cells, table.names):
                raise ImportFileError(describe_header(table.path, self.faults.find_line(row), ", ".join(cells)))
        return again

    def _read_vehicles(self, block: Block, table: TableFile, count: int) -> Ints:
        """Return the place of each row's vehicle in `vehicles`, -1 where it has none."""
        source = self.map.vehicle
        if source.column is None:
            return np.full(count, self._place("vehicle", source.prefix + (source.name or table.stem)), "i4")
        return self._places_of("vehicle", block[source.column], source.prefix)

    def _read_rides(self, table: TableFile, block: Block, count: int) -> Ints:
        """Return the place of each row's ride in `rides`, -1 between rides."""
        if self.map.ride.column is not None:
            return self._places_of("ride", block[self.map.ride.column], "")
        return np.full(count, self._place("ride", table.stem) if self.map.ride.from_file_name else -1, "i4")

    def _places_of(self, what: str, cells: pa.Array, prefix: str) -> Ints:
        """Return the places of the names in cells, -1 where there is none."""
        words, coded = encode_words(cells)
        names = [_WHOLE.sub(r"\1", word.strip()) for word in words]
        places: Ints = np.array([self._place(what, prefix + name) if name else -1 for name in [*names, ""]], "i4")[
            coded
        ]
        return places

    def _place(self, what: str, name: str) -> int:
        """Return the place of a name in its list, to which it is added where it is new."""
        known = self._places[what]
        if name not in known:
            known[name] = len(known)
            if what == "vehicle":
                self.vehicles.append(join_chunks(name))
            else:
                self.rides.append(name[:LONGEST_TEXT])
        return known[name]

    def _read_field(self, table: TableFile, block: Block, name: str, source: FieldSource, count: int) -> Floats:
        """Return the values of a field, NaN where unknown."""
        of_signals = self.map.long[1] if self.map.long else ""
        column = source.column if source.column is not None else of_signals
        if column not in block:
            return np.full(count, np.nan)
        cells = block[column]
        chosen = None
        if source.signal is not None and self.map.long is not None:
            names = pc.utf8_trim_whitespace(pc.cast(block[self.map.long[0]], pa.string()))
            chosen = pc.fill_null(pc.equal(names, source.signal), False)
            cells = pc.if_else(chosen, cells, pa.scalar(None, cells.type))
        if name in {"latitude_deg", "longitude_deg"}:
            cells = _to_degrees(cells, table.decimal)
        read = (
            _to_flags(cells, source.true)
            if name == "charging"
            else to_numbers(cells, table.decimal, has_thousands=column in table.grouped)
        )
        values, wrong = read
        if len(wrong):
            label = source.signal or column
            self.cells[label] += len(wrong)
            self.examples.setdefault(label, str(wrong[0].as_py())[:40])
        return source.conversion.apply(values)


def _to_degrees(cells: pa.Array, decimal: str) -> pa.Array:
    """Return positions in degrees and minutes as texts in degrees; all other cells as they are."""
    if not pa.types.is_string(cells.type):
        return cells
    texts = pc.utf8_trim_whitespace(pc.replace_substring(cells, decimal, "."))
    in_minutes = pc.fill_null(pc.match_substring_regex(texts, _MINUTES), False)
    if not pc.any(in_minutes).as_py():
        return cells
    parts = texts.filter(in_minutes).to_pandas().str.extract(r"^([+-]?)(\d+)[ °]+([\d.]+)")
    degrees = parts[1].astype(float) + parts[2].astype(float) / 60.0
    signed = np.where(parts[0] == "-", -degrees, degrees).astype(str)
    return pc.replace_with_mask(cells, in_minutes, pa.array(np.char.replace(signed, ".", decimal), cells.type))


def _to_flags(cells: pa.Array, true: frozenset[str]) -> tuple[Floats, pa.Array]:
    """Return cells as 1 for true and 0 for false, NaN where unknown, and those cells that are neither."""
    if pa.types.is_floating(cells.type) or pa.types.is_integer(cells.type):
        values, wrong = to_numbers(cells, ".")
        return np.where(np.isnan(values), np.nan, (values > 0).astype("f8")), wrong
    words, places = encode_words(cells)
    values = np.array([*(_to_flag(word.strip().lower(), true) for word in words), np.nan])[places]
    return values, cells.filter(pa.array(np.isnan(values) & to_bools(pc.is_valid(cells))))


def _to_flag(word: str, true: frozenset[str]) -> float:
    """Return what a word means: with words of the map for true, all others are false."""
    if true:
        return float(word in true)
    number = pd.to_numeric(word, errors="coerce")
    if word in TRUE or word in FALSE:
        return float(word in TRUE)
    return float(number > 0) if np.isfinite(number) else np.nan
