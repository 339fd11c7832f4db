"""Guess a first map of a table from names, units, ranges and physics, and say why."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from core.errors import ImportFileError
from tools.importers.table.column_map import (
    NOMINAL_VOLTAGE,
    TIME_UNITS,
    ColumnMap,
    FieldSource,
    FileFormat,
    RideSource,
    TimeSource,
    VehicleSource,
)
from tools.importers.table.guess_names import RIDE, SIGNAL, TIME, VALUE, VEHICLE, NamedColumn, guess_name
from tools.importers.table.guess_time import GuessedTime, guess_time
from tools.importers.table.guess_values import guess_values
from tools.importers.table.row_messages import join_signals
from tools.importers.table.row_reader import RowReader
from tools.importers.table.table_file import Block, TableFile
from tools.importers.table.units import FIELD_UNITS, Conversion, find_conversion

MOST_FILES: Final = 8
"""Files from whose first blocks a map is guessed."""
GAP: Final = 600.0
"""Gap between rides, as of the cleaning. [s]"""


class GuessedField(NamedTuple):
    """Hold the guessed source of a field and the reasons for unit and sign."""

    field: str
    column: str | None
    signal: str | None
    unit: str | None
    sign: int
    reasons: tuple[str, ...]


class GuessedMap(NamedTuple):
    """Hold a guessed map.

    Parameters
    ----------
    time : GuessedTime
    vehicle, ride : str, optional
        Columns of the car and the ride.
    is_per_file : bool
        Whether each file holds another car.
    long : tuple of (str, str), optional
        Columns of the name and of the value of a signal.
    fields : sequence of GuessedField
    left_out : sequence of (str, str)
        Columns that are not read, with the reason.
    """

    time: GuessedTime
    vehicle: str | None
    ride: str | None
    is_per_file: bool
    long: tuple[str, str] | None
    fields: Sequence[GuessedField]
    left_out: Sequence[tuple[str, str]]


def guess_map(tables: Sequence[TableFile]) -> GuessedMap:
    """Guess the map of tables.

    Parameters
    ----------
    tables : sequence of TableFile
        Files of one form.

    Raises
    ------
    ImportFileError
        If no column is a time, or none is a field of the wire contract.
    """
    tables = tables[:MOST_FILES]
    names = list(dict.fromkeys(name for table in tables for name in table.names))
    blocks = [(table, block) for table in tables if (block := _read_first_block(table)) is not None]
    if not blocks:
        raise ImportFileError(f"{tables[0].path}: has a header and no rows; name another file")
    named = [found for name in names if (found := guess_name(name)) is not None]
    roles: dict[str, list[NamedColumn]] = {}
    for each in named:
        roles.setdefault(each.role, []).append(each)
    long = _find_long(roles, blocks)
    signals = _name_signals(long, blocks) if long else []
    chosen, left_out = _choose(roles, signals, long, blocks)
    left_out += [(name, "its name says nothing") for name in names if not any(name == each.name for each in named)]
    if TIME not in roles:
        raise ImportFileError(
            f"{tables[0].path}: no column looks like a time; it has {', '.join(names[:12])}; write a map by hand"
        )
    if not chosen:
        raise ImportFileError(f"{tables[0].path}: no column looks like speed, charge or power; write a map by hand")
    time = guess_time(roles[TIME], [(table, block) for table, block in blocks])
    vehicle, ride = (roles[role][0].name if role in roles else None for role in (VEHICLE, RIDE))
    fields = _guess_units(chosen, time, vehicle, long, blocks)
    return GuessedMap(
        time, vehicle, ride, vehicle is None and len(tables) > 1 and ride is not None, long, fields, left_out
    )


class _Chosen(NamedTuple):
    """Hold the column or signal that a field is read from, and the unit that its name gives."""

    field: str
    column: str | None
    signal: str | None
    unit: str | None


def _read_first_block(table: TableFile) -> Block | None:
    """Return the first rows of a file, None where it has none."""
    return next(
        (block for block in table.iterate_blocks(table.names, Counter()) if len(next(iter(block.values())))), None
    )


def _find_long(
    roles: Mapping[str, list[NamedColumn]], blocks: Sequence[tuple[TableFile, Block]]
) -> tuple[str, str] | None:
    """Return the columns of the long form, if the table has it."""
    for signal in roles.get(SIGNAL, ()):
        for value in roles.get(VALUE, ()):
            if _name_signals((signal.name, value.name), blocks):
                return signal.name, value.name
    return None


def _name_signals(long: tuple[str, str], blocks: Sequence[tuple[TableFile, Block]]) -> list[NamedColumn]:
    """Return the signals of the long form whose names are fields."""
    words: dict[str, None] = {}
    for _, block in blocks:
        if long[0] in block:
            found = pc.unique(pc.utf8_trim_whitespace(pc.cast(block[long[0]], pa.string()))).to_pylist()
            words |= dict.fromkeys(word for word in found if word)
    return [each for word in words if (each := guess_name(word)) is not None and each.role in FIELD_UNITS]


def _choose(
    roles: Mapping[str, list[NamedColumn]],
    signals: Sequence[NamedColumn],
    long: tuple[str, str] | None,
    blocks: Sequence[tuple[TableFile, Block]],
) -> tuple[list[_Chosen], list[tuple[str, str]]]:
    """Return one source per field, and the columns that another one of the same field replaces."""
    chosen, left_out = [], []
    for field in FIELD_UNITS:
        columns = [each for each in roles.get(field, ()) if long is None or each.name not in long]
        filled = sorted(columns, key=lambda each: -_count_known(each.name, blocks))
        of_signals = [each for each in signals if each.role == field]
        if filled and _count_known(filled[0].name, blocks):
            chosen.append(_Chosen(field, filled[0].name, None, filled[0].unit))
            left_out += [(each.name, f"'{filled[0].name}' holds more of {field}") for each in filled[1:]]
        elif of_signals:
            chosen.append(_Chosen(field, None, of_signals[0].name, of_signals[0].unit))
            left_out += [(each.name, f"'{of_signals[0].name}' comes first") for each in of_signals[1:]]
        else:
            left_out += [(each.name, "it is empty") for each in filled]
    return chosen, left_out


def _count_known(name: str, blocks: Sequence[tuple[TableFile, Block]]) -> int:
    """Return the number of cells of a column that hold something."""
    return sum(len(block[name]) - block[name].null_count for _, block in blocks if name in block)


def _guess_units(
    chosen: Sequence[_Chosen],
    time: GuessedTime,
    vehicle: str | None,
    long: tuple[str, str] | None,
    blocks: Sequence[tuple[TableFile, Block]],
) -> list[GuessedField]:
    """Return the fields with the units and signs that names, ranges and physics suggest."""
    sources = {each.field: _to_source(each) for each in chosen}
    car = VehicleSource(vehicle, None, "", None, {}, NOMINAL_VOLTAGE)
    provisional = ColumnMap(Path("guess"), FileFormat(), _to_time_source(time), car, RideSource(), long, sources)
    reader = RowReader(provisional)
    parts = [
        reader.convert(table, block)
        for table, block in blocks
        if set(provisional.list_required_columns()) <= block.keys()
    ]
    rows = np.concatenate(parts)
    rows = rows[np.lexsort((rows["vehicle"], rows["time"]))]
    units = guess_values(join_signals(rows) if long else rows, {each.field: each.unit for each in chosen})
    return [
        GuessedField(
            each.field,
            each.column,
            each.signal,
            units[each.field].unit,
            units[each.field].sign,
            units[each.field].reasons,
        )
        for each in chosen
    ]


def _to_source(each: _Chosen) -> FieldSource:
    """Return a source whose values keep the unit of the contract where the name gives none."""
    unit = each.unit if each.unit is not None else FIELD_UNITS[each.field]
    conversion = find_conversion(unit, each.field) if unit else Conversion(1.0)
    return FieldSource(each.column, each.signal, conversion, frozenset())


def _to_time_source(time: GuessedTime) -> TimeSource:
    """Return the clock for the provisional reading."""
    unit = TIME_UNITS[time.unit] if time.unit else None
    return TimeSource(time.columns, unit, time.form, ZoneInfo("UTC"), 1.7e9 if time.needs_origin else 0.0)
