"""Tolerances of the fields of a table: how far a found value may be from the expected one."""

import re
from collections.abc import Collection, Mapping, Sequence
from math import inf, isfinite
from types import MappingProxyType
from typing import Final, NamedTuple, TypeAlias

from socast.core.errors import SettingsError, suggest_names

ROUNDING: Final = 1e-9
"""Difference of a number that counts as none where no tolerance is given, absolute and relative."""
ANY: Final = "any"
"""Tolerance with which a field may have any value."""
UNITS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "w_m2": "W/m²",
        "mm_h": "mm/h",
        "kwh": "kWh",
        "kmh": "km/h",
        "hpa": "hPa",
        "deg": "°",
        "pct": "%",
        "km": "km",
        "kg": "kg",
        "m2": "m²",
        "mm": "mm",
        "c": "°C",
        "s": "s",
        "m": "m",
        "v": "V",
        "a": "A",
        "w": "W",
    }
)
"""End of the name of a column -> unit; the ends of two words come first."""
_ASCII: Final = MappingProxyType({"W/m²": "W/m2", "m²": "m2", "°C": "C", "°": "deg"})
_FORM: Final = re.compile(r"([^\s=]+)=(?:(any)|([-+.\d]+(?:[eE][-+]?\d+)?)\s*([^\s=]*))")


class Tolerance(NamedTuple):
    """Allow a difference of a value.

    Parameters
    ----------
    absolute : float
        Part in the unit of the field.
    relative : float
        Part per unit of the expected value. [1]
    """

    absolute: float
    relative: float = 0.0


DEFAULT: Final = Tolerance(ROUNDING, ROUNDING)
Tolerances: TypeAlias = Mapping[str, float | str]
"""Name of a field, or how the names of several begin -> tolerance: a number in their unit, or a text with the unit."""


def find_unit(field: str) -> str:
    """Return the unit that the name of a field carries, empty without one.

    Examples
    --------
    >>> find_unit("range_km.mean"), find_unit("wind_speed_kmh"), find_unit("vehicle_id")
    ('km', 'km/h', '')
    """
    for part in reversed(field.split(".")):
        for end, unit in UNITS.items():
            if part.endswith(f"_{end}"):
                return unit
    return ""


def parse_tolerances(words: Sequence[str]) -> dict[str, float | str]:
    """Return tolerances by field, from words such as `soc_pct=0.1`, `soc=0.1%` or `range_km=2km`."""
    tolerances: dict[str, float | str] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not (name and equals):
            raise SettingsError(f"tolerance {word!r}: give FIELD=NUMBER, such as soc_pct=0.1 or range_km=2%")
        _parse(name, text)
        tolerances[name] = text
    return tolerances


def resolve_tolerances(
    tolerances: Tolerances | None, fields: Collection[str], known: Collection[str] = ()
) -> dict[str, Tolerance]:
    """Return the tolerance of each field that has one; that of the longest name that holds for it."""
    resolved: dict[str, Tolerance] = {}
    everything = dict.fromkeys([*fields, *known])
    for name in sorted(tolerances or {}, key=len):
        of_name = [field for field in everything if is_part(field, name)]
        if not of_name:
            stems = dict.fromkeys(field.partition(".")[0] for field in everything)
            raise SettingsError(f"tolerance of {name!r}: there is no such field; {suggest_names(name, stems)}")
        number, unit = _parse(name, str((tolerances or {})[name]))
        for field in of_name:
            resolved[field] = _apply_unit(name, number, unit, field)
    return {field: resolved[field] for field in fields if field in resolved}


def is_part(field: str, name: str) -> bool:
    """Return whether a tolerance of a name holds for a field: `soc` and `soc_pct` do for `soc_pct.mean`."""
    return field == name or field.startswith((f"{name}.", f"{name}_"))


def _parse(name: str, text: str) -> tuple[float, str]:
    """Return number and unit of a tolerance."""
    form = _FORM.fullmatch(f"{name}={text}")
    try:
        number = inf if form and form[2] else float(form[3]) if form else -1.0
    except ValueError:
        number = -1.0
    if form is None or number < 0.0 or (not isfinite(number) and not form[2]):
        raise SettingsError(
            f"tolerance {name}={text}: give FIELD=NUMBER, a number of 0 or more, with its unit or without, such as "
            f"soc_pct=0.1 or range_km=2%; or FIELD={ANY}"
        )
    return number, form[4] or ""


def _apply_unit(name: str, number: float, unit: str, field: str) -> Tolerance:
    """Return a tolerance of a field; % of a field that is not in % is relative."""
    own = find_unit(field)
    if unit in ("", own, _ASCII.get(own, own)):
        return Tolerance(number)
    if unit == "%":
        return Tolerance(0.0, number / 100.0)
    has = f"is in {own}" if own else "has no unit"
    raise SettingsError(f"tolerance {name}={number:g}{unit}: {field} {has}; give {name}={number:g}{own}, or % of it")
