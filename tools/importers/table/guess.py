"""Guess a first map of a table from presets, names, units, ranges and physics, and say why."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from socast.core.errors import ImportFileError
from socast.tools.importers.table.cells import to_numbers
from socast.tools.importers.table.clock_checks import judge_unit
from socast.tools.importers.table.column_map import (
    NOMINAL_VOLTAGE,
    ColumnMap,
    FileFormat,
    ParkedSource,
    RideSource,
    VehicleSource,
)
from socast.tools.importers.table.guess_sources import Source, Sources, choose_sources
from socast.tools.importers.table.guess_time import Blocks, GuessedTime
from socast.tools.importers.table.guess_values import GuessedRows, guess_rows, guess_values
from socast.tools.importers.table.presets import Preset, find_preset
from socast.tools.importers.table.row_faults import RowFaults, SkippedFiles
from socast.tools.importers.table.row_messages import join_signals
from socast.tools.importers.table.row_reader import RowReader
from socast.tools.importers.table.sampling import Sampling, find_holds, sample_rows
from socast.tools.importers.table.shared_stamps import spread_rows
from socast.tools.importers.table.table_file import Block, TableFile
from socast.tools.importers.table.time_words import find_time_unit
from socast.tools.importers.table.units import OF_WEATHER

MOST_FILES: Final = 8
"""Files from whose first blocks a map is guessed."""
APART: Final = 30 * 86400.0
"""Time between the starts of files with clocks that start at 0, for the guess. [s]"""
COUNTS_FROM: Final = 1.7e9
MOST_COUNTED: Final = 1e9
"""Time of the number 0 of clocks that count from 0, and their span, before their unit is known. [s]"""


class GuessedMap(NamedTuple):
    """Hold a guessed map.

    Parameters
    ----------
    vehicle, ride : str, optional
        Columns of the car and the ride.
    long : tuple of (str, str), optional
        Columns of the name and of the value of a signal.
    left_out : sequence of (str, str)
        Columns that are not read, with the reason.
    rows : GuessedRows, optional
        How rows that carry only part of the fields become samples.
    inverted : tuple of str
        Cars whose current and power have the opposite sign.
    parked : (str, tuple of str), optional
        Column and words of rows in which the car is parked.
    vehicle_model : str, optional
        Vehicle model of all cars, as the user gives it.
    """

    time: GuessedTime
    vehicle: str | None
    ride: str | None
    is_per_file: bool
    long: tuple[str, str] | None
    fields: Sequence[Source]
    left_out: Sequence[tuple[str, str]]
    rows: GuessedRows | None
    preset: Preset | None
    inverted: tuple[str, ...] = ()
    parked: tuple[str, tuple[str, ...]] | None = None
    vehicle_model: str | None = None


def guess_map(
    tables: Sequence[TableFile], preset: Preset | None = None, skipped: SkippedFiles | None = None
) -> GuessedMap:
    """Guess the map of tables."""
    tables = tables[:MOST_FILES]
    names = list(dict.fromkeys(name for table in tables for name in table.names))
    listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    if preset is not None and not preset.fits(names):
        raise ImportFileError(
            f"{tables[0].path}: lacks {', '.join(preset.list_missing(names)) or 'the columns'} of {preset.title}; it "
            f"has {listed}; leave --preset out and use --guess"
        )
    preset = preset or find_preset(names)
    if preset is not None and preset.extra_cells:
        tables = [table._replace(extra_cells=True) for table in tables]
    blocks, places = _read_first_blocks(tables, skipped or SkippedFiles())
    faults = next((each for each in places if each.causes), RowFaults())
    if not blocks and faults.causes:
        raise ImportFileError(
            f"{tables[0].path}: none of its {faults.causes.total():,} rows can be read ({faults.explain()}; "
            f"{faults.explain_first()}); export the file again, or correct these rows"
        )
    if not blocks:
        raise ImportFileError(f"{tables[0].path}: has a header and no rows; name another file")
    sources = choose_sources(names, blocks, preset)
    if sources.time is None:
        raise ImportFileError(
            f"{tables[0].path}: no column looks like a time; it has {listed}; write a map by hand, with the column "
            "in [time]"
        )
    if all(each.field in OF_WEATHER for each in sources.fields):
        raise ImportFileError(
            f"{tables[0].path}: no column looks like speed, charge or power; it has {listed}; write a map by hand, "
            "with the columns in [fields]"
        )
    on_change = preset is not None and preset.on_change
    rows, sampling, time, vehicles = _read_rows(sources, sources.time, blocks, places, on_change)
    units = guess_values(rows, {each.field: each for each in sources.fields})
    unresolved = sampling.unresolved if sampling else {}
    fields = [
        each._replace(unit=found.unit, sign=found.sign, reasons=found.reasons)
        for each in sources.fields
        if each.field not in unresolved and (found := units[each.field])
    ]
    dropped = [each for each in sources.fields if each.field in unresolved]
    left_out = [*sources.left_out, *((each.column or each.signal or "", unresolved[each.field]) for each in dropped)]
    inverted = sorted({vehicles[place] for each in units.values() for place in each.other})
    is_per_file = sources.vehicle is None and len(tables) > 1 and sources.ride is not None
    return GuessedMap(
        time,
        sources.vehicle,
        sources.ride,
        is_per_file,
        sources.long,
        fields,
        left_out,
        sampling,
        preset,
        tuple(inverted),
        sources.parked,
    )


def _read_first_blocks(tables: Sequence[TableFile], skipped: SkippedFiles) -> tuple[Blocks, list[RowFaults]]:
    """Return the first rows of each file that has some, and for these and other files where the rows stand."""
    blocks: list[tuple[TableFile, Block]] = []
    places: list[RowFaults] = []
    others: list[RowFaults] = []
    for table in tables:
        faults = RowFaults()
        with skipped.skip(table.path):
            found = (block for block in table.iterate_blocks(table.names, faults) if len(next(iter(block.values()))))
            first = [(table, block) for block in islice(found, 1)]
            blocks += first
            (places if first else others).append(faults)
    return blocks, [*places, *others]


def _read_rows(
    sources: Sources, time: GuessedTime, blocks: Blocks, places: Sequence[RowFaults], on_change: bool
) -> tuple[np.ndarray, GuessedRows | None, GuessedTime, list[str]]:
    """Return the rows as samples in the order of time, how they become samples, the clock, and the cars."""
    car = VehicleSource(sources.vehicle, None, "", None, {}, NOMINAL_VOLTAGE)
    scale = _find_scale(time, blocks) if time.needs_origin else 1.0
    provisional = ColumnMap(
        Path("guess"),
        FileFormat(),
        time.to_source(scale, COUNTS_FROM) if time.needs_origin else time.to_source(),
        car,
        RideSource(),
        sources.long,
        {each.field: each.to_field_source() for each in sources.fields},
        parked=ParkedSource(sources.parked[0], frozenset(word.lower() for word in sources.parked[1]))
        if sources.parked
        else None,
    )
    reader = RowReader(provisional)
    needed = set(provisional.list_required_columns())
    parts = []
    for (table, block), place in zip(blocks, places, strict=False):
        reader.faults.take_lines(place)
        parts += [reader.convert(table, block)] if needed <= block.keys() else []
    if time.needs_origin:
        time = _place_counts(parts, scale, time, sources.fields)
    rows = np.concatenate(parts)
    if not len(rows):
        table, found = blocks[0][0], reader.explain_causes(blocks[0][0].decimal)
        raise ImportFileError(
            f"{table.path}: none of its first {reader.rows:,} rows can be read ({found}); write a map by hand"
        )
    for part in parts:
        reader.stamps.add(part)
    rows = rows[np.lexsort((rows["vehicle"], rows["time"]))]
    spread = list(spread_rows([rows], reader.stamps.find_rules(), {}, {}))
    if not spread:
        raise ImportFileError(
            f"{blocks[0][0].path}: nothing shows when its rows were taken, because many share {rows['time'][0]:.0f} s "
            "or another stamp; write a time for each row"
        )
    rows = join_signals(np.concatenate(spread))
    sampling = guess_rows(rows, on_change)
    if sampling is not None:
        holds = find_holds(sampling.hold) | dict(sampling.holds)
        parts = list(sample_rows([rows], Sampling(sampling.period, holds, sampling.silence)))
        rows = np.concatenate(parts)
    return rows, sampling, time, reader.vehicles


def _find_scale(time: GuessedTime, blocks: Blocks) -> float:
    """Return the unit with which a clock that counts from 0 stays within `MOST_COUNTED`. [s]"""
    largest = 1.0
    for table, block in blocks:
        if time.columns[0] in block:
            numbers = to_numbers(block[time.columns[0]], table.decimal)[0]
            largest = max(largest, float(np.nanmax(np.abs(numbers), initial=0.0)))
    return float(min(1.0, 10.0 ** np.floor(np.log10(MOST_COUNTED / largest))))


def _place_counts(parts: list[np.ndarray], scale: float, time: GuessedTime, fields: Sequence[Source]) -> GuessedTime:
    """Scale the times of a clock that counts from 0, let its files follow each other, and return its unit."""
    for part in parts:
        part["time"] = (part["time"] - COUNTS_FROM) / scale
    unit, reason = judge_unit(parts, time.unit, {each.field: each.unit for each in fields})
    for number, part in enumerate(parts):  # so that no files overlap
        part["time"] = COUNTS_FROM + part["time"] * (find_time_unit(unit) or 1.0) + number * APART
    return time._replace(unit=unit, reason=f"{time.reason}; {reason}")
