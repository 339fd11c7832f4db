"""Define the parts of forms outside the library: carriers of energy, and variables that may modulate them.

A carrier is a power whose energy per unit of a coefficient is in the window table: constant, rolling, drag,
accelerating, braking, climbing, descending, and an energy at each stop. A variable is a property of a window that an
effect may read; unknown values are replaced as for effects (`socast.core.signals.signals`). Both have a unit and source
code.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Table
from socast.core.columns import GRAVITY, KMH, STANDARD_AIR_DENSITY, ZERO_CELSIUS
from socast.core.effects.declaration import Parameter
from socast.core.signals.signals import CIVIL_DUSK, HALF_CHARGED, NIGHT, STANDARD_AMBIENT
from socast.core.signals.sun import sine_of_elevation

_GRAVITY: Final = MappingProxyType({"gravity": Parameter(GRAVITY, "m/s^2")})
_AIR: Final = MappingProxyType({"air_density_standard": Parameter(STANDARD_AIR_DENSITY, "kg/m^3")})


class Carrier(NamedTuple):
    """Describe a power that acts in every window.

    Parameters
    ----------
    symbol, meaning : str
        Symbol in formulas, empty for a power of 1 W, and meaning in text.
    unit : str
        Unit of the factor that makes it a power in watt, as pint spells it.
    code : str
        Expression of these columns; empty for a power of 1 W.
    energy : callable
        Energy per unit of the factor, of the window table. [kWh per unit]
    alike : str
        Effect of the library with the same shape without modulators.
    without : tuple of str
        Variables on which such a load cannot depend.
    """

    name: str
    symbol: str
    unit: str
    arguments: tuple[str, ...]
    code: str
    energy: Callable[[Table], Floats]
    parameters: Mapping[str, Parameter] = MappingProxyType({})
    alike: str = ""
    per: str = "distance"
    meaning: str = ""
    without: tuple[str, ...] = ()


class Variable(NamedTuple):
    """Describe a property of a window that an effect may read.

    Parameters
    ----------
    name, symbol, meaning : str
        Name in code, symbol in formulas, and meaning in text.
    unit : str
        Unit as pint spells it; `1` for a pure number.
    value : callable
        Value in each row of the window table, (n,) float, never NaN: unknown values are replaced as for effects
        (`socast.core.signals.signals`).
    shapes : tuple of str
        Functions of it that are tried, see `socast.core.diagnose.forms.terms`.
    """

    name: str
    symbol: str
    meaning: str
    unit: str
    arguments: tuple[str, ...]
    code: str
    value: Callable[[Table], Floats]
    shapes: tuple[str, ...]


def _numbers(table: Table, name: str, unknown: float | Floats = 0.0) -> Floats:
    """Return a column of the window table with unknown values replaced, also where there is no such column."""
    column = np.asarray(
        table[name] if name in table else np.full(len(np.asarray(table["start_s"])), np.nan), np.float64
    )
    return np.where(np.isnan(column), unknown, column)


def _ambient(table: Table) -> Floats:
    return _numbers(table, "ambient_c", STANDARD_AMBIENT - ZERO_CELSIUS) + ZERO_CELSIUS


def _pack(table: Table) -> Floats:
    return _numbers(table, "battery_temperature_c", _ambient(table) - ZERO_CELSIUS) + ZERO_CELSIUS


def _darkness(table: Table) -> Floats:
    """Return `socast.core.signals.signals.darkness` at the middle of each window."""
    time = _numbers(table, "start_s") + 0.5 * _numbers(table, "duration_s")
    latitude, longitude = (np.radians(np.asarray(table[f"{name}_start_deg"])) for name in ("latitude", "longitude"))
    depth = np.nan_to_num(-sine_of_elevation(time, latitude, longitude))
    return np.clip(depth / np.sin(np.radians(CIVIL_DUSK)), 0.0, 1.0)


def _headwind(table: Table) -> Floats:
    """Return the wind against the way from the first to the last position of each window, 0 where it is unknown."""
    if "latitude_end_deg" not in table:
        return np.zeros(len(np.asarray(table["start_s"])))
    latitude, longitude = (
        np.radians([np.asarray(table[f"{name}_{end}_deg"], dtype=np.float64) for end in ("start", "end")])
        for name in ("latitude", "longitude")
    )
    north, east = latitude[1] - latitude[0], (longitude[1] - longitude[0]) * np.cos(latitude[0])
    wind, origin = _numbers(table, "wind_speed_kmh") * KMH, np.radians(_numbers(table, "wind_from_deg"))
    along = north * np.cos(origin) + east * np.sin(origin)
    way = np.hypot(north, east)
    return np.nan_to_num(wind * np.divide(along, way, out=np.zeros(len(way)), where=way > 0.0))


def _grade(table: Table) -> Floats:
    """Return the sine of the mean slope, 0 for a car at a standstill."""
    distance = _numbers(table, "distance_km") * 1000.0
    climb = _numbers(table, "gained_m") - _numbers(table, "lost_m")
    return np.clip(np.divide(climb, distance, out=np.zeros(len(climb)), where=distance > 1.0), -0.35, 0.35)


CARRIERS: Final = (
    Carrier(
        "auxiliary",
        "",
        "W",
        (),
        "",
        lambda table: _numbers(table, "effect_auxiliary"),
        alike="auxiliary",
        per="time",
        without=("grade",),
    ),
    Carrier(
        "rolling",
        "m g cos θ v",
        "1",
        ("tyre_load", "speed"),
        "tyre_load * speed",
        lambda table: _numbers(table, "effect_rolling"),
        alike="rolling",
        meaning="weight times speed",
    ),
    Carrier(
        "drag",
        "½ ρ0 v³",
        "m^2",
        ("speed",),
        "0.5 * air_density_standard * speed * speed * speed",
        lambda table: _numbers(table, "effect_aero_drag"),
        _AIR,
        "aero_drag",
        meaning="power of the air for each square metre, in still air",
    ),
    Carrier(
        "traction",
        "m max(a, 0) v",
        "1",
        ("mass", "acceleration", "speed"),
        "mass * np.maximum(acceleration, 0.0) * speed",
        lambda table: _numbers(table, "effect_inertia_positive"),
        alike="inertia_positive",
        meaning="power of acceleration",
    ),
    Carrier(
        "braking",
        "m max(−a, 0) v",
        "1",
        ("mass", "acceleration", "speed"),
        "mass * np.maximum(-acceleration, 0.0) * speed",
        lambda table: -_numbers(table, "effect_inertia_negative"),
        alike="inertia_negative",
        meaning="power of deceleration",
    ),
    Carrier(
        "climbing",
        "m g max(sin θ, 0) v",
        "1",
        ("mass", "grade", "speed"),
        "mass * gravity * np.maximum(grade, 0.0) * speed",
        lambda table: _numbers(table, "effect_climbing_up"),
        _GRAVITY,
        "climbing_up",
        meaning="power of a climb",
    ),
    Carrier(
        "descending",
        "m g max(−sin θ, 0) v",
        "1",
        ("mass", "grade", "speed"),
        "mass * gravity * np.maximum(-grade, 0.0) * speed",
        lambda table: -_numbers(table, "effect_climbing_down"),
        _GRAVITY,
        "climbing_down",
        meaning="power of a descent",
    ),
    Carrier(
        "stopping",
        "n",
        "J",
        ("stop_rate",),
        "stop_rate",
        lambda table: _numbers(table, "stops") / 3.6e6,
        alike="door_heat_loss",
        per="time",
        meaning="stops per second",
    ),
)

_HINGES: Final = ("above", "below")
VARIABLES: Final = (
    Variable("ambient", "T", "outside temperature", "K", ("ambient",), "ambient", _ambient, _HINGES),
    Variable(
        "pack_temperature",
        "Tb",
        "battery temperature",
        "K",
        ("pack_temperature",),
        "pack_temperature",
        _pack,
        _HINGES,
    ),
    Variable(
        "speed",
        "v",
        "speed",
        "m/s",
        ("speed",),
        "speed",
        lambda t: _numbers(t, "average_speed_kmh") * KMH,
        ("linear", "square", *_HINGES),
    ),
    Variable(
        "charge",
        "s",
        "state of charge",
        "1",
        ("charge",),
        "charge",
        lambda t: _numbers(t, "soc_start_pct", 100.0 * HALF_CHARGED) / 100.0,
        ("linear", "square", *_HINGES),
    ),
    Variable(
        "elapsed",
        "t",
        "time since the ride began",
        "s",
        ("elapsed",),
        "elapsed",
        lambda t: _numbers(t, "elapsed_s") + 0.5 * _numbers(t, "duration_s"),
        ("decay", *_HINGES),
    ),
    Variable(
        "parked",
        "tp",
        "time parked before",
        "s",
        ("parked",),
        "parked",
        lambda t: _numbers(t, "parked_s", NIGHT),
        ("decay",),
    ),
    Variable(
        "precipitation",
        "r",
        "rain or melted snow that falls in a time",
        "m/s",
        ("precipitation",),
        "precipitation",
        lambda t: _numbers(t, "precipitation_mm_h") / 3.6e6,
        ("linear", "square", "decay"),
    ),
    Variable(
        "wind",
        "w",
        "wind speed",
        "m/s",
        ("headwind", "crosswind"),
        "np.sqrt(headwind * headwind + crosswind * crosswind)",
        lambda t: _numbers(t, "wind_speed_kmh") * KMH,
        ("linear", "square", "above"),
    ),
    Variable("headwind", "wh", "headwind", "m/s", ("headwind",), "headwind", _headwind, ("linear", "square")),
    Variable(
        "occupants",
        "N",
        "people aboard",
        "1",
        ("occupants",),
        "occupants",
        lambda t: _numbers(t, "occupants", 1.0),
        ("linear", "square"),
    ),
    Variable("darkness", "d", "darkness", "1", ("darkness",), "darkness", _darkness, ("linear", "square")),
    Variable(
        "odometer",
        "o",
        "odometer",
        "m",
        ("odometer",),
        "odometer",
        lambda t: _numbers(t, "odometer_km") * 1000.0,
        ("linear",),
    ),
    Variable("grade", "sin θ", "slope", "1", ("grade",), "grade", _grade, ("linear", "square")),
)
