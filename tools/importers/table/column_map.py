"""The map of a table: a TOML file that assigns columns to fields of the wire contract, with units, signs and clock.

A mistake in the file is one line with the file, the line number, the value, what it must be, and the remedy.
"""

from collections.abc import Mapping
from datetime import datetime, timedelta, timezone, tzinfo
from difflib import get_close_matches
from math import inf
from pathlib import Path
from typing import Any, Final, NamedTuple
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from socast.core.columns import POWER_SPANS, PowerSpan
from socast.core.errors import ImportFileError, SettingsError, read_input
from socast.core.files import UNREADABLE_TOML, parse_toml
from socast.tools.importers.table.sampling import (
    HOLD,
    LONGEST_HOLD,
    LONGEST_PERIOD,
    SHORTEST_PERIOD,
    STAND,
    Sampling,
    find_holds,
)
from socast.tools.importers.table.time_words import (
    MOST_WEEKS,
    SERIAL,
    TIME_UNITS,
    TimeSource,
    find_offset,
    find_time_unit,
    find_unknown_directive,
)
from socast.tools.importers.table.units import FIELD_UNITS, Conversion, find_conversion
from socast.tools.terminal.settings_file import explain_toml, find_line

NOMINAL_VOLTAGE: Final = 360.0
"""Voltage of a traction battery of which only the power is known. [V]"""
LONGEST_MAP: Final = 1 << 20
"""Largest map. [B]"""

_TABLES: Final[Mapping[str, Mapping[str, type | tuple[type, ...]]]] = {
    "file": {"separator": str, "decimal": str, "encoding": str, "skip_lines": int, "extra_cells": bool},
    "vehicle": {
        "column": str,
        "name": str,
        "from_file_name": bool,
        "prefix": str,
        "model": str,
        "models": dict,
        "inverted": list,
        "nominal_voltage_v": (int, float),
    },
    "time": {
        "column": (str, list),
        "unit": str,
        "format": str,
        "zone": str,
        "origin": str,
        "day_from_file_name": bool,
        "origin_from_file_name": str,
        "origin_column": str,
        "offset_column": str,
        "add_weeks": int,
    },
    "ride": {"column": str, "from_file_name": bool, "gap_s": (int, float)},
    "parked": {"column": str, "values": list},
    "rows": {
        "period_s": (int, float),
        "hold_s": (int, float),
        "on_change": bool,
        "silence_s": (int, float),
        "power_covers": str,
    },
    "long": {"name": str, "value": str},
    "fields": {},
}
"""Table of a map -> its keys and their types."""
_LIMITS: Final[Mapping[str, tuple[float, float, str]]] = {
    "skip_lines": (0, 1000, ""),
    "gap_s": (1, 86400, " s"),
    "period_s": (SHORTEST_PERIOD, LONGEST_PERIOD, " s"),
    "hold_s": (0, LONGEST_HOLD, " s"),
    "silence_s": (0, LONGEST_HOLD, " s"),
}
"""Key of a number -> its least and largest value, and its unit."""
_CHOICES: Final[Mapping[str, tuple[tuple[object, ...], str]]] = {
    "decimal": ((".", ","), "'.' or ','"),
    "power_covers": (POWER_SPANS, f"one of {', '.join(POWER_SPANS)}"),
    "sign": ((1, -1), "1 or -1"),
}
"""Key -> the values that it may have, and how they are told."""
_FIELD_KEYS: Final = {"column": str, "signal": str, "unit": str, "sign": int, "true": list, "hold_s": (int, float)}
_TYPE_WORDS: Final = {
    str: "text in quotes",
    bool: "true or false",
    int: "a whole number",
    list: "a list",
    dict: "a table",
}


class FileFormat(NamedTuple):
    """Describe how a CSV file is written; None is found from the file itself."""

    separator: str | None = None
    decimal: str | None = None
    encoding: str | None = None
    skip_lines: int = 0
    extra_cells: bool = False


class VehicleSource(NamedTuple):
    """Describe which car a row belongs to, its model, and the cars whose current and power have the opposite sign."""

    column: str | None
    name: str | None
    prefix: str
    model: str | None
    models: Mapping[str, str]
    nominal_voltage: float
    inverted: frozenset[str] = frozenset()


class RideSource(NamedTuple):
    """Describe how rides are named: by a column, by the file, by gaps of a length [s], or not at all."""

    column: str | None = None
    from_file_name: bool = False
    gap_s: float | None = None


class ParkedSource(NamedTuple):
    """Describe in which rows a car is parked: words of a column, in small letters; an empty one is an empty cell."""

    column: str
    words: frozenset[str]


class FieldSource(NamedTuple):
    """Describe where a field comes from: a column, or a signal of the long form, and its conversion."""

    column: str | None
    signal: str | None
    conversion: Conversion
    true: frozenset[str]


class ColumnMap(NamedTuple):
    """Hold a checked map.

    Parameters
    ----------
    long : tuple of (str, str), optional
        Columns of the name and of the value of a signal, where each row holds one signal.
    sampling : Sampling, optional
        How rows that carry only part of the fields become samples; None sends each row as it is.
    power_covers : str, optional
        What the power of a row covers; None is found from the rows.
    """

    path: Path
    file: FileFormat
    time: TimeSource
    vehicle: VehicleSource
    ride: RideSource
    long: tuple[str, str] | None
    fields: Mapping[str, FieldSource]
    sampling: Sampling | None = None
    parked: ParkedSource | None = None
    power_covers: PowerSpan | None = None

    def list_required_columns(self) -> list[str]:
        """Return the columns that every file must have."""
        return [name for name in (*self.time.columns, self.vehicle.column, self.ride.column) if name is not None]

    def list_columns(self) -> list[str]:
        """Return all columns that are read, each once."""
        names = self.list_required_columns() + [each.column for each in self.fields.values() if each.column is not None]
        names += [self.parked.column] if self.parked else []
        beside = [name for name in (self.time.offset_column, self.time.origin_column) if name is not None]
        return list(dict.fromkeys([*names, *beside, *(self.long or ())]))


def read_map(path: Path) -> ColumnMap:
    """Read the map of a table."""
    try:
        content = read_input(path, LONGEST_MAP)
    except OSError as error:
        raise ImportFileError(
            f"{path} cannot be read: {error.strerror}; write a first map with --guess --map {path}"
        ) from error
    return parse_map(content, path)


def parse_map(content: bytes, path: Path) -> ColumnMap:
    """Return the checked map of a text."""
    try:
        text = content.decode("utf-8-sig")
        tables = parse_toml(text)
    except UNREADABLE_TOML as error:
        raise ImportFileError(explain_toml(path, content, error)) from error
    return _MapReader(path, text, tables).read()


class _MapReader:
    """Check the tables of a map one by one."""

    def __init__(self, path: Path, text: str, tables: Mapping[str, Any]) -> None:
        self.path, self.text, self.tables = path, text, tables

    def read(self) -> ColumnMap:
        """Return the checked map."""
        for name, table in self.tables.items():
            if name not in _TABLES:
                raise self.refuse((name,), f"no table is called '{name}'; {_suggest(name, list(_TABLES))}")
            if not isinstance(table, dict):
                raise self.refuse((name,), f"'{name}' is a table; write [{name}] and its keys below")
            if name != "fields":
                self.check_keys(name, table, _TABLES[name])
        signal = self.tables.get("long", {})
        long = (self.need("long", "name"), self.need("long", "value")) if signal else None
        fields = {name: self.read_field(name, each) for name, each in self.tables.get("fields", {}).items()}
        if not fields:
            raise ImportFileError(
                f"{self.path}: [fields] names no field; write one such as speed_kmh = {{ column = ... }}"
            )
        if any(each.signal for each in fields.values()) and long is None:
            raise ImportFileError(f"{self.path}: a field has a signal, but [long] is missing; name its columns there")
        return ColumnMap(
            self.path,
            self.read_file(),
            self.read_time(),
            self.read_vehicle(),
            self.read_ride(),
            long,
            fields,
            self.read_rows(),
            self.read_parked(),
            self.tables.get("rows", {}).get("power_covers"),
        )

    def refuse(self, keys: tuple[str, ...], words: str) -> ImportFileError:
        """Return an error that names the line of a key."""
        return ImportFileError(f"{self.path}, line {find_line(self.text, *keys)}: {words}")

    def check_keys(self, table: str, values: Mapping[str, Any], known: Mapping[str, Any], *above: str) -> None:
        """Refuse unknown keys and values of a wrong type."""
        for key, value in values.items():
            where = (*above, table, key)
            if key not in known:
                raise self.refuse(where, f"'{table}' has no key '{key}'; {_suggest(key, list(known))}")
            wanted = known[key]
            kinds = wanted if isinstance(wanted, tuple) else (wanted,)
            if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
                words = "a number" if float in kinds else " or ".join(_TYPE_WORDS[kind] for kind in kinds)
                raise self.refuse(where, f"{key} is {value!r}, must be {words}")
            low, high, unit = _LIMITS.get(key, (-inf, inf, ""))
            if key in _LIMITS and not low <= value <= high:
                raise self.refuse(where, f"{key} is {value:g}, must be from {low:g} to {high:g}{unit}")
            choices, words = _CHOICES.get(key, ((value,), ""))
            if value not in choices:
                raise self.refuse(where, f"{key} is {value!r}, must be {words}")

    def need(self, table: str, key: str) -> Any:
        """Return a value that must be there."""
        value = self.tables.get(table, {}).get(key)
        if table not in self.tables:
            raise ImportFileError(f"{self.path}: has no table [{table}]; add [{table}] with {key} = ...")
        if not value:
            raise self.refuse((table,), f"[{table}] has no {key}; add {key} = ...")
        return value

    def read_file(self) -> FileFormat:
        """Return how the files are written."""
        found = FileFormat(**self.tables.get("file", {}))
        if found.separator is not None and len(found.separator) != 1:
            words = f"separator is {found.separator!r}, must be one character such as ';'"
            raise self.refuse(("file", "separator"), words)
        return found

    def read_time(self) -> TimeSource:
        """Return the clock."""
        table = self.tables.get("time", {})
        columns = self.need("time", "column")
        names = (columns,) if isinstance(columns, str) else tuple(columns)
        if not all(isinstance(name, str) for name in names) or len(names) > 2:
            raise self.refuse(("time", "column"), f"column is {columns!r}, must be one name, or those of date and time")
        unit = table.get("unit")
        if unit is not None and find_time_unit(unit) is None:
            raise self.refuse(
                ("time", "unit"), f"unit is '{unit}', must be one of {', '.join(TIME_UNITS)}; text has none"
            )
        weeks = table.get("add_weeks", 0)
        if abs(weeks) > MOST_WEEKS:
            raise self.refuse(
                ("time", "add_weeks"), f"add_weeks is {weeks}, must be at most {MOST_WEEKS}, such as 1024"
            )
        if "origin_column" in table:
            self.check_origin_column(table)
        elif unit is not None and "format" in table:
            raise self.refuse(("time", "format"), "a time has a unit or a format; leave one of them out")
        zone = self.find_zone(table.get("zone", "UTC"))
        of_name, form = table.get("day_from_file_name", False), self.read_origin_form(table)
        if (of_name or form) and "origin" in table:
            raise self.refuse(
                ("time", "origin"), "a day comes from origin or from the file name; leave one of them out"
            )
        seconds, zero = find_time_unit(unit) if unit else None, self.find_origin(zone)
        offsets = table.get("offset_column")
        return TimeSource(
            names,
            seconds,
            table.get("format"),
            zone,
            zero,
            of_name,
            form,
            offsets,
            weeks,
            unit == SERIAL,
            origin_column=table.get("origin_column"),
        )

    def check_origin_column(self, table: Mapping[str, Any]) -> None:
        """Refuse a column of the first time of each file beside a clock that does not count, or another origin."""
        others = [key for key in ("origin", "origin_from_file_name", "day_from_file_name") if table.get(key)]
        if others or table.get("unit") in {None, SERIAL} or isinstance(table["column"], list):
            words = f"leave out {others[0]}" if others else "add unit = 's' of a column that counts, or leave it out"
            raise self.refuse(
                ("time", "origin_column"), f"origin_column gives numbers the first time of each file; {words}"
            )

    def read_origin_form(self, table: Mapping[str, Any]) -> str | None:
        """Return the form of the time of the number 0 in the names of files."""
        form: str | None = table.get("origin_from_file_name")
        if form is None:
            return None
        where = ("time", "origin_from_file_name")
        if "unit" not in table:
            raise self.refuse(
                where, "origin_from_file_name is the time of the number 0; add unit = 's', or leave it out"
            )
        if table.get("day_from_file_name"):
            raise self.refuse(where, "the file name gives the day or the origin; leave one of them out")
        if unknown := find_unknown_directive(form):
            raise self.refuse(where, f"'{form}' holds '{unknown}'; write a form such as ride_%Y-%m-%d_%H%M%S")
        if not any(day in form for day in ("%d", "%j")):
            raise self.refuse(where, f"'{form}' holds no day; write a form such as ride_%Y-%m-%d_%H%M%S")
        return form

    def find_zone(self, name: str) -> tzinfo:
        """Return the time zone of a name, or of an offset such as `+02:00`."""
        offset = None if name in {"UTC", "GMT"} else find_offset(name)
        if offset is not None and "/" not in name:
            return timezone(timedelta(seconds=offset))
        try:
            return ZoneInfo(name)
        except (ZoneInfoNotFoundError, ValueError, OSError) as error:
            raise self.refuse(
                ("time", "zone"),
                f"zone is '{name}', which is no time zone; write one such as Europe/Berlin, +02:00 or UTC",
            ) from error

    def find_origin(self, zone: tzinfo) -> float:
        """Return the Unix time of the number 0. [s]"""
        text = self.tables.get("time", {}).get("origin")
        if text is None:
            return 0.0
        try:
            origin = datetime.fromisoformat(text)
        except ValueError as error:
            raise self.refuse(
                ("time", "origin"), f"origin is '{text}', must be a date and time such as 2024-05-01T08:00:00"
            ) from error
        return (origin if origin.tzinfo else origin.replace(tzinfo=zone)).timestamp()

    def read_vehicle(self) -> VehicleSource:
        """Return which car a row belongs to."""
        table = self.tables.get("vehicle", {})
        given = [key for key in ("column", "name", "from_file_name") if table.get(key)]
        if len(given) != 1:
            if "vehicle" not in self.tables:
                raise ImportFileError(
                    f"{self.path}: names no car; add [vehicle] with name = ..., column = ... or from_file_name = true"
                )
            found = " and ".join(given) or "none"
            raise self.refuse(
                ("vehicle",), f"[vehicle] needs one of column, name and from_file_name, and has {found}; correct it"
            )
        models = table.get("models", {})
        if not all(isinstance(model, str) for model in models.values()):
            raise self.refuse(("vehicle", "models"), "models holds a value that is not text; write CAR = 'MODEL'")
        return VehicleSource(
            table.get("column"),
            table.get("name"),
            table.get("prefix", ""),
            table.get("model"),
            models,
            float(table.get("nominal_voltage_v", NOMINAL_VOLTAGE)),
            frozenset(map(str, table.get("inverted", ()))),
        )

    def read_ride(self) -> RideSource:
        """Return how rides are named."""
        table = self.tables.get("ride", {})
        given = [key for key in ("column", "from_file_name", "gap_s") if table.get(key)]
        if len(given) > 1:
            raise self.refuse(("ride",), f"[ride] has {' and '.join(given)}; leave all but one out")
        return RideSource(**table)

    def read_parked(self) -> ParkedSource | None:
        """Return in which rows the car is parked."""
        if "parked" not in self.tables:
            return None
        words = frozenset(str(word).strip().lower() for word in self.need("parked", "values"))
        return ParkedSource(self.need("parked", "column"), words)

    def read_rows(self) -> Sampling | None:
        """Return how rows become samples, None where each row is one as it is."""
        table = {key: value for key, value in self.tables.get("rows", {}).items() if key != "power_covers"}
        fields = self.tables.get("fields", {})
        own = {name: float(each["hold_s"]) for name, each in fields.items() if "hold_s" in each}
        if not table and not own:
            return None
        is_on_change = table.get("on_change", False)
        usual = float(table.get("hold_s", STAND if is_on_change else HOLD))
        silence = float(table.get("silence_s", HOLD)) if is_on_change else None
        return Sampling(table.get("period_s"), find_holds(usual) | own, silence)

    def read_field(self, name: str, table: Any) -> FieldSource:
        """Return the source of a field."""
        where = ("fields", name)
        if name not in FIELD_UNITS:
            raise self.refuse(where, f"no field is called '{name}'; {_suggest(name, list(FIELD_UNITS))}")
        if not isinstance(table, dict):
            raise self.refuse(where, f"{name} is {table!r}, must be a table such as {{ column = 'a name' }}")
        self.check_keys(name, table, _FIELD_KEYS, "fields")
        if ("column" in table) == ("signal" in table):
            raise self.refuse(where, f"{name} needs a column, or a signal of the long form; write one of them")
        sign = table.get("sign", 1)
        try:
            conversion = find_conversion(table.get("unit", FIELD_UNITS[name]), name)
        except SettingsError as error:
            raise self.refuse(where, f"{name}: {error}") from error
        true = frozenset(str(word).strip().lower() for word in table.get("true", ()))
        turned = Conversion(sign * conversion.factor, sign * conversion.offset)
        return FieldSource(table.get("column"), table.get("signal"), turned, true)


def _suggest(name: str, known: list[str]) -> str:
    """Return the remedy for an unknown key."""
    near = get_close_matches(name, known, 1)
    return f"did you mean '{near[0]}'?" if near else f"write one of {', '.join(known)}"
