"""Convert tables to a recording: read, sort, make messages, and check whether the values agree."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from datetime import UTC
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from rich.console import Console
from rich.text import Text

from socast.core.errors import ImportFileError
from socast.core.formatting import format_count
from socast.core.vehicles import load_catalogue
from socast.stream.mcap_writer import MOST_CHANNELS, replace_recording
from socast.stream.recording_metadata import make_metadata
from socast.tools.importers.table.agreement import Check
from socast.tools.importers.table.agreement_sums import AgreementSums, CarSums
from socast.tools.importers.table.cells import suggest_decimal
from socast.tools.importers.table.clock_checks import ClockRate, ClockUnit, list_checks, refuse_overlap
from socast.tools.importers.table.column_map import ColumnMap, FileFormat
from socast.tools.importers.table.row_messages import RowMessages, join_signals
from socast.tools.importers.table.row_order import leave_out_covered_twice, sort_rows
from socast.tools.importers.table.row_reader import RowReader
from socast.tools.importers.table.sampling import sample_rows
from socast.tools.importers.table.shared_stamps import LEFT_OUT, StampRule, spread_rows
from socast.tools.importers.table.table_file import TableFile, open_table
from socast.tools.importers.table.text_stream import SkippedFiles
from socast.tools.importers.table.units import has_power
from socast.tools.importers.table.weather_file import StationMessages, SunWitness, WeatherFile

MOST_CARS: Final = MOST_CHANNELS // 3
"""Largest number of cars in one recording, with three keys each."""
LONGEST_STEP: Final = 900.0
"""Longest time between two rows of a parked car that is filled. [s]"""
STEP: Final = 60.0
"""Time between added rows: the longest one of a logger without a period. [s]"""
MOVED: Final = 0.1
"""Distance by the odometer from which a car did not stay where it was. [km]"""


class ImportSummary(NamedTuple):
    """Hold the summary of an import.

    Parameters
    ----------
    files, rows, samples : int
        Files and rows read, and samples written.
    hours : float
        Time between rows that lie close together. [h]
    causes : Counter of str
        Rows that could not be read, by cause.
    places : mapping of str to str
        Place of the first row of each cause.
    cells : Counter of str
        Cells that hold no number, by column.
    examples : mapping of str to str
        Text of the first such cell of each column.
    decimal : str
        Decimal mark with which numbers were read.
    """

    out: Path
    files: int
    rows: int
    samples: int
    hours: float
    causes: Counter[str]
    places: Mapping[str, str]
    cells: Counter[str]
    examples: Mapping[str, str]
    decimal: str
    notes: Sequence[str]
    cars: Sequence[CarSums]
    checks: Sequence[Check]


def describe_missing(fields: Collection[str]) -> list[str]:
    """Return a line for each of speed and energy that no field gives."""
    lines = []
    if "speed_kmh" not in fields:
        lines.append(
            "no speed was found: nothing can be predicted; name its column in [fields] of the map, such as "
            "speed_kmh = { column = 'v', unit = 'km/h' }"
        )
    if not has_power(fields):
        found = "the state of charge alone" if "soc_pct" in fields else "nothing"
        lines.append(
            f"no power was found, and no voltage with current: {found} measures the energy; if the file has a power, "
            "name its column in [fields] of the map, such as battery_power_kw = { column = 'p', unit = 'W' }"
        )
    return lines


def print_summary(summary: ImportSummary, console: Console) -> None:
    """Print a summary, one line for each statement."""
    for line, style in list_lines(summary):
        console.print(Text(line, style), soft_wrap=True)


def list_lines(summary: ImportSummary) -> list[tuple[str, str]]:
    """Return the lines of a summary with their styles."""
    cars = len(summary.cars)
    first = (
        f"{summary.out}: {format_count(summary.samples, 'sample')} of {format_count(cars, 'car')}, "
        f"{summary.hours:.1f} h, from {format_count(summary.rows, 'row')} in {format_count(summary.files, 'file')}"
    )
    lines = [(first, "")]
    for cause, count in summary.causes.most_common():
        place = f"; {summary.places[cause]}" if cause in summary.places else ""
        lines.append((f"left out: {format_count(count, 'row')} with {cause}{place}", "yellow"))
    for column, count in summary.cells.most_common():
        text = summary.examples[column]
        remedy = suggest_decimal(text, summary.decimal)
        lines.append((f"unknown: {count:,} cells of '{column}' hold no number, such as {text!r}{remedy}", "yellow"))
    lines += [(note, "yellow") for note in summary.notes]
    lines += [
        (_describe(check), "" if check.passed else "dim" if check.passed is None else "red") for check in summary.checks
    ]
    return lines


def _describe(check: Check) -> str:
    """Return a check as one line: value, limit and remedy."""
    if check.passed is None:
        return f"not checked: {check.name}: {check.found}"
    if check.passed:
        return f"agrees: {check.name}: {check.found} (limit: {check.limit})"
    return f"does not agree: {check.name}: {check.found} (limit: {check.limit}); {check.remedy}"


def open_tables(
    paths: Sequence[Path], kind: str, columns: ColumnMap, skipped: SkippedFiles | None = None
) -> list[TableFile]:
    """Return the form of each file, after a check that the columns of the map are there."""
    tables = open_readable(paths, kind, columns.file, skipped or SkippedFiles(), columns.list_required_columns())
    for name in columns.list_columns():
        if not any(name in table.names for table in tables):
            tables[0].check_columns([name])
    return tables


def open_readable(
    paths: Sequence[Path], kind: str, form: FileFormat, skipped: SkippedFiles, needed: Sequence[str] = ()
) -> list[TableFile]:
    """Return the form of each file that can be opened and has the needed columns."""
    tables: list[TableFile] = []
    for path in paths:
        with skipped.skip(path):
            table = open_table(path, kind, form)
            table.check_columns(needed)
            tables.append(table)
    if not tables:
        lines = "; ".join(skipped.list_lines(len(paths)))
        raise ImportFileError(f"{paths[0]}: none of the {len(paths)} files given can be read ({lines})")
    return tables


def convert_tables(
    tables: Sequence[TableFile],
    columns: ColumnMap,
    out: Path,
    settings: Mapping[str, Any] | None = None,
    skipped: SkippedFiles | None = None,
    weather: WeatherFile | None = None,
) -> ImportSummary:
    """Write the rows of tables as a recording in the order of time, with the observations of a file of weather."""
    skipped = skipped or SkippedFiles()
    opened = len(tables) + len(skipped.rows)
    reader, sums = RowReader(columns, skipped), AgreementSums()
    rate, unit = ClockRate(), ClockUnit(columns)
    messages = RowMessages(columns, reader, rate.find_power_step)
    sun, stations = SunWitness(), StationMessages(weather) if weather else None
    messages.weather.is_sent = stations is None  # the nearest station counts, which would be the car
    with replace_recording(out, metadata=make_metadata("import", settings=settings or {})) as sink:
        spread = _SpreadRows(reader)
        sorted_rows = sort_rows(_read_limited(reader, tables, rate), out.resolve().parent)
        once = leave_out_covered_twice(sorted_rows, reader.spans, reader.faults.causes)
        for rows in _sample(spread.iterate(once), columns):
            if not messages.samples:  # sorting has read all files
                refuse_overlap(reader, columns)
            sums.add(rows)
            unit.add(rows)
            sun.add_rows(rows)
            made = messages.make(rows)
            sink.put(stations.merge(rows, made) if stations else made)
        notes = spread.list_notes()
        if not messages.samples:
            found = reader.explain_causes(tables[0].decimal)
            raise ImportFileError(
                f"{tables[0].path}: none of {reader.rows:,} rows can be read ({found}); correct {columns.path}"
            )
    faults = [unit.check(), None if columns.long else rate.find_fault(reader.vehicles, columns.time.columns[0])]
    cars = sums.list_cars(reader.vehicles, columns.vehicle.models, columns.vehicle.model)
    return ImportSummary(
        out=out,
        files=opened - list(skipped.rows.values()).count(0),
        rows=reader.rows,
        samples=messages.samples,
        hours=sum(car.sums["duration"] for car in cars) / 3600.0,
        causes=reader.faults.causes,
        places=reader.faults.places,
        cells=reader.cells,
        examples=reader.examples,
        decimal=tables[0].decimal,
        notes=[
            *skipped.list_lines(opened),
            *reader.faults.notes,
            *notes,
            *_list_notes(tables, columns),
            *messages.notes,
            *([stations.describe()] if stations else []),
        ],
        cars=cars,
        checks=[
            *list_checks(tables, columns, reader, cars, sums.span, faults),
            *_check_weather(sun, stations, columns),
        ],
    )


def _check_weather(sun: SunWitness, stations: StationMessages | None, columns: ColumnMap) -> list[Check]:
    """Return the checks of irradiances and of a file of weather."""
    found = [sun.check(columns.time.zone)]
    found += [stations.check(), stations.file.sun.check(UTC)] if stations else []
    return [check for check in found if check is not None]


def _read_limited(reader: RowReader, tables: Sequence[TableFile], rate: ClockRate) -> Iterator[np.ndarray]:
    """Yield blocks of rows, measure their rate, and refuse more cars than a recording can hold."""
    for block in reader.read(tables):
        rate.add(block)
        if len(reader.vehicles) > MOST_CARS:
            raise ImportFileError(
                f"{tables[0].path}: names {len(reader.vehicles):,} vehicles or more; a recording holds {MOST_CARS:,}: "
                "check the column of [vehicle], or import the files in parts"
            )
        yield block


class _SpreadRows:
    """Spread rows that share a stamp, and tell of how many."""

    def __init__(self, reader: RowReader) -> None:
        self.reader = reader
        self.rules: dict[int, StampRule] = {}
        self.counts: dict[int, int] = {}
        self.left_out: dict[int, int] = {}

    def iterate(self, blocks: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
        """Yield rows in the order of time; the first block comes when all files are read."""
        for first in blocks:
            self.rules = self.reader.stamps.find_rules()
            yield from spread_rows(chain([first], blocks), self.rules, self.counts, self.left_out)

    def list_notes(self) -> list[str]:
        """Count rows that were left out, and return a line for each way of stamping."""
        cars: dict[str, list[int]] = {}
        for place, rule in self.rules.items():
            cars.setdefault(rule.describe(), []).append(place)
        if lost := sum(self.left_out.values()):
            self.reader.faults.causes[LEFT_OUT] = lost
        return [
            f"{sum(self.counts.get(place, 0) for place in places):,} rows of {_name_cars(self.reader, places)} share "
            f"stamps with others ({words}; write finer times, or a time for each row, for exact ones)"
            for words, places in cars.items()
        ]


def _name_cars(reader: RowReader, places: Sequence[int]) -> str:
    """Return the name of a car, or how many there are."""
    return reader.vehicles[places[0]] if len(places) == 1 else f"{len(places)} cars"


def _sample(blocks: Iterator[np.ndarray], columns: ColumnMap) -> Iterator[np.ndarray]:
    """Yield sorted rows as they are sent."""
    if columns.long or columns.sampling:
        blocks = (join_signals(rows, columns.long is not None) for rows in blocks)
    if columns.sampling is not None:
        return sample_rows(blocks, columns.sampling)
    return fill_parked(blocks) if columns.parked is not None and "speed_kmh" in columns.fields else blocks


def _list_notes(tables: Sequence[TableFile], columns: ColumnMap) -> list[str]:
    """Return what a person should know of the files and the map."""
    names = {each.column for each in columns.fields.values() if each.column is not None}
    notes = [
        f"{table.path}: has no column {', '.join(map(repr, missing))}; unknown in its rows"
        for table in tables
        if (missing := sorted(names - set(table.names)))
    ]
    notes += describe_missing(columns.fields)
    if columns.vehicle.model is None and not columns.vehicle.models:
        notes.append(
            "no vehicle model: the energy of the cars is measured and not predicted; give --vehicle-model, such as "
            "nissan-leaf-2013, or describe a car of your own with `socast vehicles new` and give --vehicles too"
        )
    used = {columns.vehicle.model, *columns.vehicle.models.values()} - {None}
    notes += [
        f"the vehicle model {model!r} is not in the catalogue: the energy of its cars is measured and not predicted; "
        "describe it with `socast vehicles new` and give the file with --vehicles"
        for model in sorted(map(str, used))
        if model not in load_catalogue()
    ]
    return notes


def fill_parked(blocks: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield rows in the order of time, with copies of a row of a car that stands until its next row."""
    held: np.ndarray | None = None
    last: dict[int, np.ndarray] = {}
    for block in blocks:
        rows = block if held is None else np.concatenate([held, block])
        rows = np.concatenate([rows, *_add_rows(block, last)])
        rows = rows[np.lexsort((rows["vehicle"], rows["time"]))]
        # rows that are added later come after the last row of their car
        end = int(np.searchsorted(rows["time"], rows["time"][-1] - LONGEST_STEP, "left")) if len(rows) else 0
        held = rows[end:].copy()
        if end:
            yield rows[:end]
    if held is not None and len(held):
        yield held


def _add_rows(block: np.ndarray, last: dict[int, np.ndarray]) -> list[np.ndarray]:
    """Return the rows to add before rows of a block, after the last row of each car before it."""
    added = []
    for vehicle in np.unique(block["vehicle"]).tolist():
        rows = block[block["vehicle"] == vehicle]
        rows = np.concatenate([last[vehicle], rows]) if vehicle in last else rows
        last[vehicle] = rows[-1:].copy()
        step = np.diff(rows["time"])
        stands = (rows["speed_kmh"][:-1] == 0.0) & (rows["speed_kmh"][1:] == 0.0)
        if "odometer_km" in (rows.dtype.names or ()):
            stands &= ~(np.abs(np.diff(rows["odometer_km"])) > MOVED)
        fill = np.flatnonzero(stands & (step > 1.5 * STEP) & (step <= LONGEST_STEP))
        counts = np.ceil(step[fill] / STEP - 1.5).astype("i8")
        copies = np.repeat(rows[fill], counts)
        copies["time"] += STEP * (np.arange(len(copies)) - np.repeat(np.cumsum(counts) - counts, counts) + 1.0)
        added.append(copies)
    return added
