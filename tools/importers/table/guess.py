"""Guess a first map of a table from presets, names, units, ranges and physics, say why, and write it as a TOML file."""

import json
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
from rich.table import Table
from rich.text import Text

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
from socast.tools.importers.table.guess_sources import GuessedMap, choose_sources, list_names
from socast.tools.importers.table.guess_time import Blocks, GuessedTime
from socast.tools.importers.table.guess_values import Source, guess_rows, guess_values
from socast.tools.importers.table.presets import Preset, find_preset
from socast.tools.importers.table.row_messages import join_signals
from socast.tools.importers.table.row_reader import RowReader
from socast.tools.importers.table.sampling import Sampling, find_holds, sample_rows
from socast.tools.importers.table.shared_stamps import spread_rows
from socast.tools.importers.table.table_file import Block, TableFile
from socast.tools.importers.table.text_stream import RowFaults, SkippedFiles
from socast.tools.importers.table.time_words import GUESSED_ORIGIN, find_time_unit
from socast.tools.importers.table.units import FIELD_UNITS, OF_WEATHER, POWER
from socast.tools.terminal.rich_table import Column, make_table

MOST_FILES: Final = 8
"""Files from whose first blocks a map is guessed."""
APART: Final = 30 * 86400.0
"""Time between the starts of files with clocks that start at 0, for the guess. [s]"""
COUNTS_FROM: Final = 1.7e9
MOST_COUNTED: Final = 1e9
"""Time of the number 0 of clocks that count from 0, and their span, before their unit is known. [s]"""
MOST_LEFT_OUT: Final = 40
"""Columns that are not read and are listed in a map."""
RIDES: Final = "stops, charging and gaps end rides"
"""How rides are found where no column names them."""
MOST_NAMED: Final = 8
"""Columns that are not read and are named on the terminal."""


def guess_map(
    tables: Sequence[TableFile], preset: Preset | None = None, skipped: SkippedFiles | None = None
) -> GuessedMap:
    """Guess the map of tables."""
    tables = tables[:MOST_FILES]
    names = list(dict.fromkeys(name for table in tables for name in table.names))
    if preset is not None and not preset.fits(names):
        raise ImportFileError(
            f"{tables[0].path}: lacks {', '.join(preset.list_missing(names)) or 'the columns'} of {preset.title}; it "
            f"has {list_names(names)}; leave --preset out and use --guess"
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
    guessed = choose_sources(names, blocks, preset)
    if all(each.field in OF_WEATHER for each in guessed.fields):
        raise ImportFileError(
            f"{tables[0].path}: no column looks like speed, charge or power; it has {list_names(names)}; write a map "
            "by hand, with the columns in [fields]"
        )
    rows, guessed, vehicles = _read_rows(guessed, blocks, places)
    units = guess_values(rows, {each.field: each for each in guessed.fields})
    unresolved = guessed.rows.unresolved if guessed.rows else {}
    fields = [
        each._replace(unit=found.unit, sign=found.sign, reasons=found.reasons)
        for each in guessed.fields
        if each.field not in unresolved and (found := units[each.field])
    ]
    dropped = [each for each in guessed.fields if each.field in unresolved]
    return guessed._replace(
        fields=fields,
        left_out=guessed.left_out + [(each.column or each.signal or "", unresolved[each.field]) for each in dropped],
        is_per_file=guessed.vehicle is None and len(tables) > 1 and guessed.ride is not None,
        inverted=tuple(sorted({vehicles[place] for each in units.values() for place in each.other})),
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
    guessed: GuessedMap, blocks: Blocks, places: Sequence[RowFaults]
) -> tuple[np.ndarray, GuessedMap, list[str]]:
    """Return the rows as samples in the order of time, the map with its clock and its rows, and the cars."""
    time, parked = guessed.time, guessed.parked
    scale = _find_scale(time, blocks) if time.needs_origin else 1.0
    provisional = ColumnMap(
        Path("guess"),
        FileFormat(),
        time.to_source(scale, COUNTS_FROM) if time.needs_origin else time.to_source(),
        VehicleSource(guessed.vehicle, None, "", None, {}, NOMINAL_VOLTAGE),
        RideSource(),
        guessed.long,
        {each.field: each.to_field_source() for each in guessed.fields},
        parked=ParkedSource(parked[0], frozenset(word.lower() for word in parked[1])) if parked else None,
    )
    reader = RowReader(provisional)
    needed = set(provisional.list_required_columns())
    parts = []
    for (table, block), place in zip(blocks, places, strict=False):
        reader.faults.take_lines(place)
        parts += [reader.convert(table, block)] if needed <= block.keys() else []
    if time.needs_origin:
        time = _place_counts(parts, scale, time, guessed.fields)
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
    sampling = guess_rows(rows, guessed.preset is not None and guessed.preset.on_change)
    if sampling is not None:
        holds = find_holds(sampling.hold) | dict(sampling.holds)
        parts = list(sample_rows([rows], Sampling(sampling.period, holds, sampling.silence)))
        rows = np.concatenate(parts)
    return rows, guessed._replace(time=time, rows=sampling), reader.vehicles


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


def write_map_text(guessed: GuessedMap, table: TableFile) -> str:
    """Return a map as TOML."""
    lines = _write_head(guessed)
    lines += _write_file(table, guessed) + _write_vehicle(guessed, table) + _write_time(guessed)
    lines += ["[ride]", f"column = {_quote(guessed.ride)}", ""] if guessed.ride else []
    if guessed.long:
        lines += ["[long]", f"name = {_quote(guessed.long[0])}", f"value = {_quote(guessed.long[1])}", ""]
    if guessed.parked:
        words = ", ".join(map(_quote, guessed.parked[1]))
        lines += ["[parked]", f"column = {_quote(guessed.parked[0])}", f"values = [{words}]   # no speed: it is 0", ""]
    if guessed.rows:
        lines += [
            f"[rows]   # {guessed.rows.reason}",
            f"period_s = {guessed.rows.period:g}   # time between samples",
            f"hold_s = {guessed.rows.hold:g}   # age up to which a value stays known",
        ]
        if guessed.rows.silence is not None:
            lines += [
                "on_change = true   # values are known as long as the car stands, or other values of it arrive",
                f"silence_s = {guessed.rows.silence:.3g}   # a driving car that sends nothing for longer is not known",
            ]
        lines.append("")
    lines.append("[fields]")
    holds = guessed.rows.holds if guessed.rows else {}
    lines += [_write_field(each, holds.get(each.field)) for each in guessed.fields]
    if guessed.left_out:
        lines += ["", "# Not read:"]
        lines += [f"#   {_quote(name)}: {why}" for name, why in guessed.left_out[:MOST_LEFT_OUT]]
    return "\n".join(lines) + "\n"


def make_guess_table(guessed: GuessedMap) -> Table:
    """Return a table of what was decided and why."""
    table = make_table([Column("field"), Column("column"), Column("unit"), Column("why")])
    time = guessed.time
    _add(table, "time", " + ".join(time.columns), time.unit or time.form or "", time.reason + _describe_zone(guessed))
    of_file = "each file is a car" if guessed.is_per_file else "all rows are of one car"
    _add(table, "vehicle", guessed.vehicle or "", "", "by its name" if guessed.vehicle else of_file)
    _add(table, "ride", guessed.ride or "", "", "by its name" if guessed.ride else RIDES)
    if guessed.rows:
        _add(table, "rows", "", f"every {guessed.rows.period:g} s", guessed.rows.reason)
        for field, why in guessed.rows.unresolved.items():
            _add(table, field, "", "not read", why)
    if guessed.parked:
        words = ", ".join(word or "empty" for word in guessed.parked[1])
        _add(table, "parked", guessed.parked[0], words, "no speed is sent then: it is 0")
    for each in guessed.fields:
        unit = f"{each.unit or ''}{', sign inverted' if each.sign == -1 else ''}"
        _add(table, each.field, each.column or each.signal or "", unit, "; ".join(each.reasons))
    return table


def describe_unread(guessed: GuessedMap) -> str:
    """Return a line that names the columns that are not read, empty where all are."""
    names = [name for name, _ in guessed.left_out]
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"not read: {', '.join(map(_quote, names[:MOST_NAMED]))}{more}" if names else ""


def describe_preset(guessed: GuessedMap) -> str:
    """Return a line that says which preset fits, empty where none does."""
    if guessed.preset is None:
        return ""
    edit = f"; correct {edits}" if (edits := _list_edits(guessed)) else ""
    return f"preset {guessed.preset.name}: the columns are those of {guessed.preset.title}{edit}"


def _write_head(guessed: GuessedMap) -> list[str]:
    """Return the comments above the map."""
    if guessed.preset is None:
        return ["# A first map, guessed from names, units, ranges and physics. Check it, then import with it.", ""]
    about = guessed.preset
    lines = [
        f"# Map of {about.title} (preset {about.name}). Check it, then import with it.",
        f"# Form: {about.source}.",
    ]
    return [*lines, *([f"# Correct {edits}."] if (edits := _list_edits(guessed)) else []), ""]


def _list_edits(guessed: GuessedMap) -> str:
    """Return what a person must correct in the map of a preset; a zone that was found is right."""
    edit = guessed.preset.edit if guessed.preset else ""
    is_known = guessed.time.offset_column is not None or guessed.time.zone is not None
    return "" if is_known and edit.startswith("zone in [time]:") else edit


def _add(table: Table, *cells: str) -> None:
    """Add a row of plain text."""
    table.add_row(*map(Text, cells))


def _describe_zone(guessed: GuessedMap) -> str:
    """Return what is assumed of the time zone."""
    time = guessed.time
    is_counted = time.needs_origin and time.origin_form is None and time.origin_column is None
    is_known = time.has_zone or time.zone is not None or is_counted
    return "" if is_known else "; zone not stated, UTC assumed"


def _write_file(table: TableFile, guessed: GuessedMap) -> list[str]:
    """Return the table of the form of the files, where it is not the usual one."""
    usual = {"separator": ",", "decimal": ".", "encoding": "utf-8"}
    found = {"separator": table.separator, "decimal": table.decimal, "encoding": table.encoding}
    lines = [f"{key} = {_quote(value)}" for key, value in found.items() if value != usual[key]]
    lines += [f"skip_lines = {table.skip_lines}"] if table.skip_lines else []
    if guessed.preset is not None and guessed.preset.extra_cells:
        lines.append("extra_cells = true   # rows may be longer than the header")
    return ["[file]", *lines, ""] if lines else []


def _write_vehicle(guessed: GuessedMap, table: TableFile) -> list[str]:
    """Return the table of the car."""
    if guessed.vehicle is not None:
        source = f"column = {_quote(guessed.vehicle)}"
    elif guessed.is_per_file:
        source = "from_file_name = true"
    else:
        source = f"name = {_quote(table.stem)}"
    if guessed.inverted:
        names = ", ".join(map(_quote, guessed.inverted))
        source += f"\ninverted = [{names}]   # cars whose current and power have the opposite sign"
    known = f"model = {_quote(guessed.vehicle_model)}" if guessed.vehicle_model else '# model = "nissan-leaf-2013"'
    return ["[vehicle]", source, f"{known}   # key of the vehicle catalogue", ""]


def _write_time(guessed: GuessedMap) -> list[str]:
    """Return the table of the clock."""
    time = guessed.time
    names = ", ".join(map(_quote, time.columns))
    lines = ["[time]", f"column = {names if len(time.columns) == 1 else f'[{names}]'}   # {time.reason}"]
    if time.unit:
        lines.append(f"unit = {_quote(time.unit)}")
    if time.form:
        lines.append(f"format = {_quote(time.form)}")
    if time.day_from_file_name:
        lines.append("day_from_file_name = true   # the file holds times of day; its name holds the day")
    if time.origin_form:
        lines.append(f"origin_from_file_name = {_quote(time.origin_form)}   # time of the number 0")
        lines.append('zone = "UTC"   # of the time in the file name: correct it where it is local time')
    elif time.origin_column:
        lines.append(f"origin_column = {_quote(time.origin_column)}   # its first time in each file is that of the row")
        lines += (
            [] if time.has_zone else ['zone = "UTC"   # the file does not state it: correct it where it is local time']
        )
    elif time.needs_origin:
        lines += [f'origin = "{GUESSED_ORIGIN}"   # time of the number 0: correct it', 'zone = "UTC"']
    elif time.zone:
        lines.append(f"zone = {_quote(time.zone)}")
    elif not time.has_zone:
        lines.append('zone = "UTC"   # the file does not state it: correct it where it is local time')
    return [*lines, *_write_corrections(time), ""]


def _write_corrections(time: GuessedTime) -> list[str]:
    """Return the keys of a clock that other witnesses correct."""
    lines = []
    if time.add_weeks:
        lines.append(f"add_weeks = {time.add_weeks}   # the count of GPS weeks started again")
    if time.offset_column:
        lines.append(f"offset_column = {_quote(time.offset_column)}   # states the offset of the local times from UTC")
    if time.origin:
        lines.append(f"origin = {_quote(time.origin)}   # time of the number 0")
    return lines


def _write_field(each: Source, hold: float | None) -> str:
    """Return the line of a field."""
    where = f"column = {_quote(each.column)}" if each.column is not None else f"signal = {_quote(each.signal or '')}"
    parts = [where]
    if each.unit is not None and FIELD_UNITS[each.field]:
        parts.append(f"unit = {_quote(each.unit)}")
    if each.true:
        parts.append(f"true = [{', '.join(map(_quote, each.true))}]")
    if each.sign == -1 or each.field in {"battery_current_a", POWER}:
        parts.append(f"sign = {each.sign}")
    if hold is not None:
        parts.append(f"hold_s = {hold:.4g}")
    comment = f"   # {'; '.join(each.reasons)}" if each.reasons else ""
    return f"{each.field} = {{ {', '.join(parts)} }}{comment}"


def _quote(text: str) -> str:
    """Return text as a TOML string."""
    return json.dumps(text, ensure_ascii=False)
