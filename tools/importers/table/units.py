"""Units of the columns in tables of one's own, converted to those of the wire contract by pint."""

import re
from collections.abc import Collection, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from socast.core.batch import Floats
from socast.core.errors import SettingsError

POWER: Final = "battery_power_kw"
"""Power of the traction battery, positive when discharging. It is sent as voltage times current."""

OF_WEATHER: Final[Mapping[str, str]] = MappingProxyType(
    {
        "wind_speed_kmh": "km/h",
        "wind_from_deg": "degree",
        "precipitation_mm": "mm",
        "pressure_hpa": "hPa",
        "humidity_pct": "percent",
        "solar_w_m2": "W/m^2",
    }
)
"""Field of a weather observation that the rows of a car may hold -> its unit in the wire contract."""

FIELD_UNITS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "latitude_deg": "degree",
        "longitude_deg": "degree",
        "elevation_m": "m",
        "speed_kmh": "km/h",
        "odometer_km": "km",
        "soc_pct": "percent",
        "battery_voltage_v": "V",
        "battery_current_a": "A",
        POWER: "kW",
        "battery_temperature_c": "degC",
        "ambient_c": "degC",
        "hvac_w": "W",
        "occupants": "",
        "charging": "",
        **OF_WEATHER,
    }
)
"""Field of a map -> its unit in the wire contract, empty for a pure number."""

SPELLINGS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "%": "percent",
        "pct": "percent",
        "1": "",
        "-": "",
        "fraction": "",
        "ratio": "",
        "kmh": "km/h",
        "km/hr": "km/h",
        "kmph": "km/h",
        "kph": "km/h",
        "mph": "mph",
        "mps": "m/s",
        "mi/h": "mph",
        "mp/h": "mph",
        "deg": "degree",
        "degrees": "degree",
        "miles": "mile",
        "meters": "m",
        "metres": "m",
        "feet": "ft",
        "a": "A",
        "v": "V",
        "w": "W",
        "kw": "kW",
        "kv": "kV",
        "mv": "mV",
        "ma": "mA",
        "degc": "degC",
        "degf": "degF",
        "amps": "A",
        "amp": "A",
        "volts": "V",
        "volt": "V",
        "watts": "W",
        "kilowatts": "kW",
        "°c": "degC",
        "celsius": "degC",
        "c": "degC",
        "°f": "degF",
        "fahrenheit": "degF",
        "f": "degF",
        "kelvin": "K",
        "k": "K",
        "w/m2": "W/m^2",
        "w/m²": "W/m^2",
        "hpa": "hPa",
        "mb": "mbar",
        "inhg": "inHg",
        "kn": "knot",
        "kt": "knot",
        "kts": "knot",
        "inches": "inch",
    }
)
"""Spelling of a unit in small letters -> the one that pint reads."""
_CELSIUS: Final = "degC"
_LETTERS_OF_TEMPERATURE: Final = frozenset({"c", "f", "k"})


class Conversion(NamedTuple):
    """Convert values linearly: factor times value plus offset."""

    factor: float
    offset: float = 0.0

    def apply(self, values: Floats) -> Floats:
        """Return converted values."""
        return values * self.factor + self.offset


def find_conversion(unit: str, field: str) -> Conversion:
    """Return the conversion from a unit to that of a field of the wire contract.

    Examples
    --------
    >>> import numpy as np
    >>> find_conversion("m/s", "speed_kmh").apply(np.array([10.0])).round(6).tolist()
    [36.0]
    >>> find_conversion("°F", "ambient_c").apply(np.array([50.0, 212.0])).round(6).tolist()
    [10.0, 100.0]
    """
    target = FIELD_UNITS[field]
    registry = _load_registry()
    spelled = spell_unit(unit, field)
    try:
        zero, one = (float(registry.Quantity(value, spelled).to(target).magnitude) for value in (0.0, 1.0))
    except Exception as error:  # pint raises half a dozen kinds, tokenize's among them
        wanted = target or "a pure number"
        raise SettingsError(
            f"unit '{unit}' does not convert to {wanted}; write one such as {suggest_units(field)}"
        ) from error
    return Conversion(one - zero, zero)


def spell_unit(unit: str, field: str) -> str:
    """Return a unit as pint spells it."""
    plain = re.sub(r"\s+", "", unit).replace("º", "°")
    lower = plain.lower()
    if field == "precipitation_mm":  # a rate is the amount of an hour
        plain = re.sub(r"/(h|hr|hour)$", "", plain)
        lower = plain.lower()
    is_letter = lower in _LETTERS_OF_TEMPERATURE and FIELD_UNITS[field] != _CELSIUS
    return plain if is_letter else SPELLINGS.get(lower, plain)


def suggest_units(field: str) -> str:
    """Return units that a field may have, for an error message."""
    return {
        "km/h": "km/h, mph or m/s",
        "km": "km, mi or m",
        "percent": "% or 1",
        "degC": "degC, degF or K",
        "kW": "kW or W",
        "W": "W or kW",
        "m": "m or ft",
        "mm": "mm or mm/h",
        "W/m^2": "W/m^2",
    }.get(FIELD_UNITS[field], FIELD_UNITS[field] or "1")


def convertible(unit: str, field: str) -> bool:
    """Return whether a text is a unit that a field may have."""
    try:
        find_conversion(unit, field)
    except SettingsError:
        return False
    return True


def has_power(fields: Collection[str]) -> bool:
    """Return whether the fields give the power of the battery."""
    return POWER in fields or {"battery_voltage_v", "battery_current_a"} <= set(fields)


@cache
def _load_registry() -> Any:
    """Return pint's registry, loaded on first use."""
    import pint  # noqa: PLC0415 - takes 0.3 s to import

    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
