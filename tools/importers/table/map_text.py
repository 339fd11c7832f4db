"""Write a guessed map as a TOML file with the reasons as comments, and as a table for the terminal."""

import json
from typing import Final

from rich.table import Table
from rich.text import Text

from socast.tools.importers.table.guess import GuessedMap
from socast.tools.importers.table.guess_sources import Source
from socast.tools.importers.table.guess_time import GuessedTime
from socast.tools.importers.table.table_file import TableFile
from socast.tools.importers.table.time_words import GUESSED_ORIGIN
from socast.tools.importers.table.units import FIELD_UNITS, POWER
from socast.tools.terminal.rich_table import Column, make_table

MOST_LEFT_OUT: Final = 40
"""Columns that are not read and are listed in a map."""

RIDES: Final = "stops, charging and gaps end rides"
"""How rides are found where no column names them."""
MOST_NAMED: Final = 8
"""Columns that are not read and are named on the terminal."""


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
