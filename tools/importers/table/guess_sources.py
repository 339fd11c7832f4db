"""Choose the columns or signals that fields are read from: those of a preset first, then by names and contents."""

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from socast.core.batch import Floats
from socast.core.errors import ImportFileError
from socast.tools.importers.table.cells import to_numbers
from socast.tools.importers.table.clock_checks import (
    SHORTEST_PERIOD,
    describe_rate,
    is_steady,
    is_too_fast,
    sum_close_steps,
)
from socast.tools.importers.table.clock_witness import judge_clock, read_clock
from socast.tools.importers.table.guess_names import (
    OTHER_TIME,
    RIDE,
    SIGNAL,
    STATE,
    TIME,
    VALUE,
    VEHICLE,
    NamedColumn,
    guess_name,
)
from socast.tools.importers.table.guess_time import (
    LEAST_SHARE,
    TRIED,
    Blocks,
    GuessedTime,
    collect_cells,
    find_origin,
    list_clocks,
)
from socast.tools.importers.table.guess_values import GuessedRows, Source
from socast.tools.importers.table.presets import Preset, PresetTime
from socast.tools.importers.table.text_times import list_forms, parse_times
from socast.tools.importers.table.units import FIELD_UNITS, convertible

LOWEST_VOLTAGE: Final = 20.0
HIGHEST_VOLTAGE: Final = 1500.0
"""Limits of the voltage of a traction battery, within which a column `V` must lie. [V]"""
LARGEST_CURRENT: Final = 2000.0
"""Limit of a column `I`. [A]"""
_ISO: Final = r"^\s*\d{4}-\d\d-\d\d[T ]\d\d:\d\d"
_CLOCK: Final = r"\d.*\d\d?[:.hH-]\d\d"
"""Cells among which dates with a time of day may be."""
_BARE: Final = re.compile(
    r"^(V|U|I|[tT]emp(?:erature)?)[ _]*[\[(]?(V|A|(?:[dD]eg ?|°)?[cCfFK]|[cC]elsius|[fF]ahrenheit)?[\])]?$"
)

_PARKED: Final = re.compile(
    r"p|park(ed|ing)?|asleep|sleep(ing)?|offline|off|inactive|suspended|standby|stopped|standstill|idle|completed?"
    r"|plugged(in)?|chargecomplete"
)
_CHARGES: Final = re.compile(r"(ac|dc|fast|quick|super|starting)?charg(e|ing)(ac|dc)?")
_DRIVES: Final = re.compile(
    r"[drnb]|driv(e|ing)|reverse|neutral|(in)?motion|moving|trip|ride|online|on|active|awake|ready|running"
)


def find_times(names: Sequence[str], blocks: Blocks) -> list[NamedColumn]:
    """Return the columns that hold nothing but times, in text or as time stamps of Parquet, most of them different."""
    return [NamedColumn(name, TIME, None) for name in names if _holds_times(_take_cells(name, blocks))]


def choose_bare(names: Sequence[str], blocks: Blocks, taken: Collection[str]) -> list[Source]:
    """Return voltage and current called `V` and `I`, and the one temperature called `temp`, if their values fit."""
    found: dict[str, list[tuple[str, str | None]]] = {}
    for name in names:
        if match := _BARE.match(name):
            found.setdefault(match[1].upper()[:4], []).append((name, match[2]))
    voltages, currents, temperatures = (
        found.get("V", []) + found.get("U", []),
        found.get("I", []),
        found.get("TEMP", []),
    )
    chosen = []
    if voltages and currents and not {"battery_voltage_v", "battery_current_a"} & set(taken):
        (voltage, volt), (current, ampere) = voltages[0], currents[0]
        if _is_voltage(_take_numbers(voltage, blocks)) and _is_current(_take_numbers(current, blocks)):
            reason = "'{}' and '{}' have values of a battery"
            chosen = [
                Source("battery_voltage_v", voltage, None, volt, reasons=(reason.format(voltage, current),)),
                Source("battery_current_a", current, None, ampere, reasons=(reason.format(current, voltage),)),
            ]
    if len(temperatures) == 1 and not {"ambient_c", "battery_temperature_c"} & set(taken):
        ((name, unit),) = temperatures
        unit = unit if unit and convertible(unit, "ambient_c") else None
        words = "the name states no place, taken as outside: check it"
        reason = f"unit in the name: {unit}; {words}" if unit else words
        chosen.append(Source("ambient_c", name, None, unit, reasons=(reason,)))
    return chosen


def _take_cells(name: str, blocks: Blocks) -> Any:
    """Return the first cells of a column, None where it has none."""
    for _, block in blocks:
        if name in block and len(block[name]) > block[name].null_count:
            return block[name].drop_null().slice(0, TRIED)
    return None


def _take_numbers(name: str, blocks: Blocks) -> Floats:
    """Return the first numbers of a column."""
    for table, block in blocks:
        if name in block:
            numbers, _ = to_numbers(block[name].slice(0, TRIED), table.decimal)
            known: Floats = numbers[np.isfinite(numbers)]
            if len(known):
                return known
    return np.zeros(0)


def _holds_times(cells: Any) -> bool:
    """Return whether cells are times of rows: in one form, and at least half of them different."""
    if cells is None or 2 * pc.count_distinct(cells).as_py() < len(cells):
        return False
    if pa.types.is_timestamp(cells.type):
        return True
    if not (pa.types.is_string(cells.type) or pa.types.is_large_string(cells.type)):
        return False
    if pc.all(pc.match_substring_regex(cells, _ISO)).as_py():
        return True
    texts = pc.utf8_trim_whitespace(pc.cast(cells, pa.string()))
    if not pc.all(pc.match_substring_regex(texts, _CLOCK)).as_py():
        return False
    return any(bool(np.all(~np.isnat(parse_times(texts, form).stamps))) for form in list_forms(texts.to_pylist()))


def _is_voltage(values: Floats) -> bool:
    """Return whether values are those of a traction battery. [V]"""
    if not len(values):
        return False
    low, high = np.percentile(values, [5, 95]).tolist()
    return bool(low > LOWEST_VOLTAGE and high < HIGHEST_VOLTAGE and high < 2.0 * low)


def _is_current(values: Floats) -> bool:
    """Return whether values may be currents of a battery: they change. [A]"""
    return len(values) > 0 and bool(np.ptp(values) > 0 and np.abs(values).max() < LARGEST_CURRENT)


def find_parked(words: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a column for a parked or charging car, none where other words are not known.

    Examples
    --------
    >>> find_parked(["Driving", "Parked", "Charging (AC)"]), find_parked(["Parked", "blue"])
    (('Parked', 'Charging (AC)'), ())
    """
    if not all(_matches(word, _PARKED, _CHARGES, _DRIVES) for word in words):
        return ()
    return tuple(word for word in words if _matches(word, _PARKED, _CHARGES))


def find_charging(words: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a column for a charging car."""
    return tuple(word for word in words if _matches(word, _CHARGES))


def _matches(word: str, *patterns: re.Pattern[str]) -> bool:
    """Return whether the letters of a word match one of some patterns."""
    letters = "".join(letter for letter in word.lower() if letter.isalpha())
    return any(pattern.fullmatch(letters) for pattern in patterns)


class GuessedMap(NamedTuple):
    """Hold a guessed map.

    Parameters
    ----------
    vehicle, ride : str, optional
        Columns of the car and the ride.
    long : tuple of (str, str), optional
        Columns of the name and of the value of a signal.
    left_out : list of (str, str)
        Columns that are not read, with the reason.
    parked : (str, tuple of str), optional
        Column and words of rows in which the car is parked.
    rows : GuessedRows, optional
        How rows that carry only part of the fields become samples.
    inverted : tuple of str
        Cars whose current and power have the opposite sign.
    vehicle_model : str, optional
        Vehicle model of all cars, as the user gives it.
    """

    time: GuessedTime
    vehicle: str | None
    ride: str | None
    long: tuple[str, str] | None
    fields: list[Source]
    left_out: list[tuple[str, str]]
    parked: tuple[str, tuple[str, ...]] | None
    preset: Preset | None
    rows: GuessedRows | None = None
    is_per_file: bool = False
    inverted: tuple[str, ...] = ()
    vehicle_model: str | None = None


def list_names(names: Sequence[str]) -> str:
    """Return the first names of columns, for a message."""
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def choose_sources(names: Sequence[str], blocks: Blocks, preset: Preset | None) -> GuessedMap:
    """Return a map of the columns and signals to read, whose units and rows are not known yet."""
    by_name = preset is None or preset.rest
    units = {name: unit for table, _ in blocks for name, unit in zip(table.names, table.units, strict=False) if unit}
    named = [found for name in names if (found := guess_name(name, units.get(name))) is not None]
    roles: dict[str, list[NamedColumn]] = {}
    for each in named:
        roles.setdefault(each.role, []).append(each)
    long = _find_long(names, roles, blocks, preset)
    words = _list_signals(long[0], blocks) if long else []
    fields = _choose_of_preset(preset, names, words, blocks) if preset else []
    left_out: list[tuple[str, str]] = []
    if by_name:
        taken = {each.field for each in fields}
        chosen, left_out = _choose_by_name(roles, words, long, blocks)
        fields += [each for each in chosen if each.field not in taken]
        fields += choose_bare(names, blocks, {each.field for each in fields})
    states = [each.name for each in roles.get(STATE, ())] if by_name else []
    parked = _find_parked(preset, names, states, blocks)
    if parked is not None and "charging" not in {each.field for each in fields}:
        fields += _find_charging(parked[0], blocks)
    time = _choose_clock(names, roles, preset, blocks)
    if time is None:
        raise ImportFileError(
            f"{blocks[0][0].path}: no column looks like a time; it has {list_names(names)}; write a map by hand, with "
            "the column in [time]"
        )
    vehicle, ride = (
        _find_filled([*given, *(each.name for each in roles.get(role, ()) if by_name or role == VEHICLE)], blocks)
        for role, given in ((VEHICLE, preset.vehicle if preset else ()), (RIDE, preset.ride if preset else ()))
    )
    read = {each.column for each in fields} | {vehicle, ride, *(long or ()), *time.columns}
    read |= {parked[0]} if parked else set()
    left_out = [(name, why) for name, why in left_out if name not in read]
    unread = "its name says nothing" if by_name else "the preset does not read it"
    known = read | ({each.name for each in named if each.role != STATE} if by_name else set())
    left_out += [(name, _explain_second(name) or unread) for name in names if name not in known]
    return GuessedMap(time, vehicle, ride, long, fields, left_out, parked, preset)


def _explain_second(name: str) -> str:
    """Return that a column such as `REESSCurrent2` is a second circuit of the battery, empty for any other one."""
    found = guess_name(name[:-1]) if name[-1:] == "2" else None
    is_second = found is not None and found.role in {"battery_voltage_v", "battery_current_a"}
    return "a second circuit of the battery: its power is not added" if is_second else ""


def _choose_clock(
    names: Sequence[str], roles: Mapping[str, list[NamedColumn]], preset: Preset | None, blocks: Blocks
) -> GuessedTime | None:
    """Return the clock: that of a preset, else of columns called so, or with cells that are times."""
    given = _find_time_of_preset(preset, blocks) if preset else None
    named = [*roles.get(TIME, ()), *roles.get(OTHER_TIME, ())]
    by_cells = [each for each in find_times(names, blocks) if each.name not in {one.name for one in named}]
    candidates = [*named, *by_cells]
    try:
        clocks = list_clocks(candidates, blocks) if candidates else []
    except ImportFileError:
        if given is None:
            raise
        clocks = []
    if given is not None:
        return judge_clock(given, clocks, names, blocks, is_fixed=True) if given.is_absolute else given
    if absolute := _leave_out_standing([clock for clock in clocks if clock.is_absolute], blocks):
        if is_too_fast(read_clock(absolute[0].to_source(), blocks)):
            return _count_from(absolute[0], clocks, blocks) or absolute[0]
        return judge_clock(absolute[0], absolute[1:], names, blocks)
    if not clocks:
        return None
    found = min(clocks, key=lambda each: each.day_from_file_name)
    return find_origin(found, [table.path for table, _ in blocks]) if found.needs_origin else found


def _leave_out_standing(clocks: Sequence[GuessedTime], blocks: Blocks) -> list[GuessedTime]:
    """Return clocks without those that stand still between rows, if another one does not."""
    sound = [clock for clock in clocks if not is_too_fast(read_clock(clock.to_source(), blocks))]
    return sound or list(clocks)


def _count_from(first: GuessedTime, clocks: Sequence[GuessedTime], blocks: Blocks) -> GuessedTime | None:
    """Return a clock that counts from the first time of one that stands still, None where no column counts."""
    times = read_clock(first.to_source(), blocks)
    known = times[np.isfinite(times)]
    rate = describe_rate(len(known), sum_close_steps(known))
    fault = f"the times in column '{first.columns[0]}' are wrong: {rate} (limit: {SHORTEST_PERIOD * 1e3:g} ms)"
    for clock in clocks:
        if clock.needs_origin and is_steady(read_clock(clock.to_source(1.0, 1.0), blocks)):
            return clock._replace(
                form=first.form,
                has_zone=first.has_zone,
                origin_column=first.columns[0],
                reason=f"counts from the first time in column '{first.columns[0]}'",
                doubts=(*clock.doubts, f"{fault}; column '{clock.columns[0]}' is read instead"),
            )
    return None


def _find_parked(
    preset: Preset | None, names: Sequence[str], states: Sequence[str], blocks: Blocks
) -> tuple[str, tuple[str, ...]] | None:
    """Return the column that says in which rows the car is parked, and its words for it."""
    if preset is not None and preset.parked is not None and preset.parked[0] in names:
        return preset.parked
    return next(((name, words) for name in states if (words := find_parked(_list_signals(name, blocks)))), None)


def _find_charging(column: str, blocks: Blocks) -> list[Source]:
    """Return the source of the state of charging, if a column says so in words."""
    true = find_charging(_list_signals(column, blocks))
    return [Source("charging", column, None, None, true=true, reasons=("by its words",))] if true else []


def count_known(name: str, blocks: Blocks) -> int:
    """Return the number of cells of a column that hold something."""
    return sum(len(block[name]) - block[name].null_count for _, block in blocks if name in block)


def _find_filled(names: Sequence[str], blocks: Blocks) -> str | None:
    """Return the first of some columns that holds something."""
    return next((name for name in names if count_known(name, blocks)), None)


def _find_time_of_preset(preset: Preset, blocks: Blocks) -> GuessedTime | None:
    """Return the clock of a preset, None where it is guessed."""
    for time in preset.times:
        if not count_known(time.column, blocks):
            continue
        found = GuessedTime((time.column,), time.unit, time.form, True, False, f"preset {preset.name}")
        if (time.unit is None and time.form is None) or _reads_little(time, blocks):
            (found,) = list_clocks([NamedColumn(time.column, TIME, None)], blocks)
        return found._replace(
            has_zone=time.zone == "UTC" or (found.has_zone and time.form is None and not time.day_from_file_name),
            day_from_file_name=time.day_from_file_name,
        )
    return None


def _reads_little(time: PresetTime, blocks: Blocks) -> bool:
    """Return whether the format of a preset reads hardly any of the dates that a table holds."""
    if time.form is None or time.day_from_file_name:
        return False
    cells = collect_cells((time.column,), blocks)
    texts = pc.utf8_trim_whitespace(pc.cast(cells, pa.string()))
    return bool(np.mean(~np.isnat(parse_times(texts, time.form).stamps)) < LEAST_SHARE)


def _choose_of_preset(preset: Preset, names: Sequence[str], words: Sequence[str], blocks: Blocks) -> list[Source]:
    """Return the sources of a preset that the tables have, filled ones before empty ones."""
    chosen = []
    for field, places in preset.fields.items():
        there = [each for each in places if each.column in names or each.signal in words]
        filled = [each for each in there if each.signal is not None or count_known(each.column or "", blocks)]
        if filled:
            one = filled[0]
            chosen.append(
                Source(field, one.column, one.signal, one.unit, one.sign, one.true, (f"preset {preset.name}",))
            )
    return chosen


def _find_long(
    names: Sequence[str], roles: Mapping[str, list[NamedColumn]], blocks: Blocks, preset: Preset | None
) -> tuple[str, str] | None:
    """Return the columns of the long form, if the table has it."""
    given = preset.long if preset else ()
    if pair := next((pair for pair in given if set(pair) <= set(names)), None):
        return pair
    if preset and not preset.rest:
        return None
    for signal in roles.get(SIGNAL, ()):
        for value in roles.get(VALUE, ()):
            if any(_is_field(word) for word in _list_signals(signal.name, blocks)):
                return signal.name, value.name
    return None


def _is_field(word: str) -> bool:
    """Return whether the name of a signal is that of a field."""
    found = guess_name(word)
    return found is not None and found.role in FIELD_UNITS


def _list_signals(column: str, blocks: Blocks) -> list[str]:
    """Return the names of signals of the long form."""
    words: dict[str, None] = {}
    for _, block in blocks:
        if column in block:
            found = pc.unique(pc.utf8_trim_whitespace(pc.cast(block[column], pa.string()))).to_pylist()
            words |= dict.fromkeys(word for word in found if word)
    return list(words)


def _choose_by_name(
    roles: Mapping[str, list[NamedColumn]], words: Sequence[str], long: tuple[str, str] | None, blocks: Blocks
) -> tuple[list[Source], list[tuple[str, str]]]:
    """Return one source per field, and the columns that another one of the same field replaces."""
    chosen, left_out = [], []
    signals = [each for word in words if (each := guess_name(word)) is not None]
    for field in FIELD_UNITS:
        columns = [each for each in roles.get(field, ()) if long is None or each.name not in long]
        filled = sorted(columns, key=lambda each: -count_known(each.name, blocks))
        of_signals = [each for each in signals if each.role == field]
        if filled and count_known(filled[0].name, blocks):
            chosen.append(Source(field, filled[0].name, None, filled[0].unit))
            left_out += [(each.name, f"'{filled[0].name}' holds more of {field}") for each in filled[1:]]
        elif of_signals:
            chosen.append(Source(field, None, of_signals[0].name, of_signals[0].unit))
            left_out += [(each.name, f"'{of_signals[0].name}' comes first") for each in of_signals[1:]]
        else:
            left_out += [(each.name, "it is empty") for each in filled]
    return chosen, left_out
