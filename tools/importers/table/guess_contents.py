"""Guess from its cells what a column holds, where its name says too little, and which words mean a parked car."""

import re
from collections.abc import Collection, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from socast.core.batch import Floats
from socast.tools.importers.table.cells import to_numbers
from socast.tools.importers.table.column_map import FieldSource
from socast.tools.importers.table.guess_names import TIME, NamedColumn
from socast.tools.importers.table.guess_time import TRIED, Blocks
from socast.tools.importers.table.text_times import parse_times
from socast.tools.importers.table.time_forms import list_forms
from socast.tools.importers.table.units import FIELD_UNITS, Conversion, convertible, find_conversion

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


class Source(NamedTuple):
    """Hold the column or signal that a field is read from, and what is known of it: unit, sign, and the reasons."""

    field: str
    column: str | None
    signal: str | None
    unit: str | None
    sign: int | None = None
    true: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()

    def to_field_source(self) -> FieldSource:
        """Return a source whose values keep the unit of the contract where the unit is not known."""
        unit = self.unit if self.unit is not None else FIELD_UNITS[self.field]
        factor, offset = find_conversion(unit, self.field) if unit else Conversion(1.0)
        sign = self.sign or 1
        return FieldSource(self.column, self.signal, Conversion(sign * factor, sign * offset), frozenset(self.true))


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
