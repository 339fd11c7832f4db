"""Columns that a model may read of a ride, with units. Every column has a meaning during a ride, too.

Columns of the ride table have the same names as there. Columns that hold the answer (`energy_*`, `soc_end_pct`,
`hvac_kwh`) are not features. Derived columns tell how cold it is outside, whether the sun shines, how full the battery
is. Each is a function of a few other columns, computed on access, so that no table needs to hold it. So are scopes,
which are 1 for one vehicle (`vehicle=taxi-003`) or from a date on (`since=2018-06-01`), and 0 otherwise. A term with a
scope in its product applies only there.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, date, datetime
from functools import partial
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core import effects
from socast.core.batch import Floats, Table
from socast.core.columns import SECONDS_PER_DAY, ZERO_CELSIUS
from socast.core.errors import ModelError
from socast.core.vehicles import AccessoryCurve

HEATING_BELOW: Final = 18.0
"""Outside temperature below which a cabin with people and sun in it is heated. [°C]"""
DEEP_COLD_BELOW: Final = -5.0
"""Outside temperature below which heat pumps stop and heaters reach their limit. [°C] Estimated."""
COOLING_ABOVE: Final = 21.0
"""Outside temperature above which a cabin is cooled. [°C]"""
OPTIMAL_OUTSIDE: Final = 20.0
"""Outside temperature at which electric cars go farthest. [°C] Geotab, 68 °F for a sedan and a van alike, February 2023
(globalfleetmanagement.com/10191948).
"""
CABIN_WARM_UP: Final = 600.0
"""Time constant with which a cabin's air and trim approach their set temperature. [s] Estimated."""
SOAK: Final = 7200.0
"""Time constant with which a parked car approaches the outside temperature. [s] Estimated."""
BATTERY_FROST: Final = 5.0
"""Temperature below which a battery accepts little charge, and may be heated. [°C]"""
BATTERY_FULL: Final = 88.0
"""State of charge above which a battery accepts less energy from braking. [%]"""
SMALLEST_RIDE: Final = 0.1
"""Size of a ride without any driving. [kWh]"""
DRIVE_OVER_ROLLING: Final = 1.3
"""Energy of driving in town over that of rolling resistance alone, a typical mean. [1]"""
EFFECT_PREFIX: Final = "effect_"
ACCESSORIES_COLUMN: Final = "accessories_kwh"
"""Energy of climate control and all else on board by a model's own curve. Unlike other columns, it needs a curve. [kWh]
"""
VEHICLE_SCOPE: Final = "vehicle="
"""Prefix of a column that is 1 for one vehicle; the vehicle's identity follows."""
SINCE_SCOPE: Final = "since="
"""Prefix of a column that is 1 from a date on; the ISO date follows, counted from midnight UTC."""
ANSWERS: Final = ("energy_", "soc_end_pct", "hvac_kwh")
"""Prefixes of the columns that hold what a model is to predict."""

_HISTOGRAM = {f"speed_{5 * i}_{5 * i + 5}_km": "km" for i in range(21)}

FEATURES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "distance_km": "km",
        "average_speed_kmh": "(km/h)",
        "gained_m": "m",
        "lost_m": "m",
        "duration_s": "s",
        "ambient_c": "K",
        "wind_speed_kmh": "(km/h)",
        "wind_from_deg": "degree",
        "precipitation_mm_h": "(mm/h)",
        "stops": "1",
        "soc_start_pct": "percent",
        "battery_temperature_c": "K",
        "elapsed_s": "s",
        "parked_s": "s",
        "time_since_charge_s": "s",
        "odometer_km": "km",
        "occupants": "1",
        "winter": "1",
        "summer": "1",
        "start_s": "s",
        "latitude_start_deg": "degree",
        "longitude_start_deg": "degree",
        "latitude_end_deg": "degree",
        "longitude_end_deg": "degree",
        "mass_kg": "kg",
        "rolling_resistance": "1",
        "drag_area_m2": "m^2",
        "nominal_capacity_kwh": "kWh",
        "accessory_scale": "1",
        **_HISTOGRAM,
    }
)
"""Unit of each ride-table column that a term may read, besides `effect_*`; for temperatures, the unit of a difference.
"""


ACCESSORY_NEEDS: Final = ("duration_s", "ambient_c", "accessory_scale")
"""Columns from which the accessory energy is computed."""


class DerivedColumn(NamedTuple):
    """Describe a column that is computed from others.

    Parameters
    ----------
    needs : tuple of str
        Columns of the ride table.
    unit : str
        Unit as pint spells it, in parentheses where it is a quotient.
    make : callable
        Function from arrays of the needed columns to the column, row by row; NaN where it is unknown.
    """

    needs: tuple[str, ...]
    unit: str
    make: Callable[..., Floats]


def fall_below(limit: float, values: Floats) -> Floats:
    """Return how far values are below a limit, 0 above it."""
    return np.maximum(limit - values, 0.0)


def rise_above(limit: float, values: Floats) -> Floats:
    """Return how far values are above a limit, 0 below it."""
    return np.maximum(values - limit, 0.0)


def deviate_from(optimum: float, values: Floats) -> Floats:
    """Return how far values are from an optimum, on either side."""
    return np.abs(values - optimum)


def approach(time_constant: float, time: Floats) -> Floats:
    """Return the completed share of an exponential approach, 1 - exp(-t / time constant). [1]"""
    return -np.expm1(-time / time_constant)


def compute_sun_sine(start_s: Floats, latitude_deg: Floats, longitude_deg: Floats) -> Floats:
    """Return the sine of the sun's elevation, 0 by night. [1]

    Parameters
    ----------
    start_s : (n,) float
        Unix time. [s]
    latitude_deg, longitude_deg : (n,) float
        Position, north and east positive. [°]

    Notes
    -----
    The declination follows from the day of the year, the hour angle from mean solar time: accurate to about 4°.

    References
    ----------
    Duffie and Beckman, Solar Engineering of Thermal Processes, 4th ed., Wiley 2013, eqs. (1.6.1a) and (1.6.5).

    Examples
    --------
    >>> noon = 1529596800.0  # 21 June 2018, 16:00 UTC
    >>> compute_sun_sine(np.array([noon, noon + 43200.0]), np.full(2, 45.5), np.full(2, -73.6)).round(1)
    array([0.9, 0. ])
    """
    day = start_s / SECONDS_PER_DAY
    declination = np.radians(23.45) * np.sin(2.0 * np.pi * (285.0 + day % 365.2425) / 365.0)
    hour = 2.0 * np.pi * (day % 1.0 - 0.5) + np.radians(longitude_deg)
    latitude = np.radians(latitude_deg)
    height = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour)
    return np.maximum(height, 0.0)


def compute_basic_energy(
    rolling: Floats, rolling_resistance: Floats, climbing: Floats, drag: Floats, drag_area: Floats, inertia: Floats
) -> Floats:
    """Return the energy at the wheels by the basic physical model. [kWh]"""
    return rolling * rolling_resistance + climbing + drag * drag_area + inertia


def compute_size(rolling: Floats, rolling_resistance: Floats, accessories: Floats) -> Floats:
    """Return the approximate energy of a ride, at least `SMALLEST_RIDE`; its error grows with it. [kWh]"""
    return SMALLEST_RIDE + DRIVE_OVER_ROLLING * rolling * rolling_resistance + accessories


def divide_by_distance(amount: Floats, distance_km: Floats) -> Floats:
    """Return an amount per distance, NaN where the distance is zero. [1/km]"""
    return np.divide(amount, distance_km, out=np.full(len(amount), np.nan), where=distance_km > 0.0)


_SUN = ("start_s", "latitude_start_deg", "longitude_start_deg")
_ROLLING = ("effect_rolling", "rolling_resistance")
_BASIC = (*_ROLLING, "effect_climbing", "effect_aero_drag", "drag_area_m2", "effect_inertia")

DERIVED_COLUMNS: Final[Mapping[str, DerivedColumn]] = MappingProxyType(
    {
        # cosine and sine, because 359 and 1 degree are neighbours
        "wind_from_north": DerivedColumn(("wind_from_deg",), "1", lambda degrees: np.cos(degrees * (np.pi / 180.0))),
        "wind_from_east": DerivedColumn(("wind_from_deg",), "1", lambda degrees: np.sin(degrees * (np.pi / 180.0))),
        "heating_need_k": DerivedColumn(("ambient_c",), "K", partial(fall_below, HEATING_BELOW)),
        "deep_cold_k": DerivedColumn(("ambient_c",), "K", partial(fall_below, DEEP_COLD_BELOW)),
        "cooling_need_k": DerivedColumn(("ambient_c",), "K", partial(rise_above, COOLING_ABOVE)),
        "comfort_gap_k": DerivedColumn(("ambient_c",), "K", partial(deviate_from, OPTIMAL_OUTSIDE)),
        "warmed": DerivedColumn(("duration_s",), "1", partial(approach, CABIN_WARM_UP)),
        "soaked": DerivedColumn(("parked_s",), "1", partial(approach, SOAK)),
        "battery_frost_k": DerivedColumn(("battery_temperature_c",), "K", partial(fall_below, BATTERY_FROST)),
        "battery_fullness_pct": DerivedColumn(("soc_start_pct",), "percent", partial(rise_above, BATTERY_FULL)),
        "sun": DerivedColumn(_SUN, "1", compute_sun_sine),
        "basic_kwh": DerivedColumn(_BASIC, "kWh", compute_basic_energy),
        "size_kwh": DerivedColumn((*_ROLLING, "effect_accessories"), "kWh", compute_size),
        "stops_per_km": DerivedColumn(("stops", "distance_km"), "(1/km)", divide_by_distance),
        "uphill_per_km": DerivedColumn(("effect_climbing_up", "distance_km"), "(kWh/km)", divide_by_distance),
        "downhill_per_km": DerivedColumn(("effect_climbing_down", "distance_km"), "(kWh/km)", divide_by_distance),
        "speeding_up_per_km": DerivedColumn(("effect_inertia_positive", "distance_km"), "(kWh/km)", divide_by_distance),
        "slowing_per_km": DerivedColumn(("effect_inertia_negative", "distance_km"), "(kWh/km)", divide_by_distance),
        "drag_per_km": DerivedColumn(("effect_aero_drag", "distance_km"), "(kWh/m^2/km)", divide_by_distance),
        "wind_drag_per_km": DerivedColumn(("effect_aero_drag_wind", "distance_km"), "(kWh/m^2/km)", divide_by_distance),
    }
)
"""Every derived column, by name."""


def is_scope(column: str) -> bool:
    """Return whether a column is a scope: 1 where a term applies, and 0 elsewhere."""
    return column.startswith((VEHICLE_SCOPE, SINCE_SCOPE))


def list_scope(columns: Iterable[str]) -> list[str]:
    """Return the scope of a term: those of its columns that limit it, such as `vehicle=taxi-003`."""
    return [column for column in columns if is_scope(column)]


def parse_since(column: str) -> float:
    """Return the time from which a scope `since=DATE` is 1, as Unix time. [s]

    Raises
    ------
    ModelError
        Where the scope does not name a date.

    Examples
    --------
    >>> parse_since("since=2018-06-01")
    1527811200.0
    """
    text = column.removeprefix(SINCE_SCOPE)
    try:
        day = date.fromisoformat(text)
    except ValueError as error:
        raise ModelError(f"scope {column!r}: {text!r} is not a date ({error}): write since=YYYY-MM-DD") from error
    if day.isoformat() != text:
        raise ModelError(f"scope {column!r}: write the date as since={day.isoformat()}")
    return datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()


def list_raw_columns(column: str) -> tuple[str, ...]:
    """Return the columns of the ride table from which a column is computed: itself, unless it is derived.

    Examples
    --------
    >>> list_raw_columns("wind_from_east")
    ('wind_from_deg',)
    """
    if column == ACCESSORIES_COLUMN:
        return ACCESSORY_NEEDS
    if is_scope(column):
        return ("vehicle_id",) if column.startswith(VEHICLE_SCOPE) else ("start_s",)
    return DERIVED_COLUMNS[column].needs if column in DERIVED_COLUMNS else (column,)


def get_unit(column: str) -> str:
    """Return the unit of a column, as pint spells it.

    Raises
    ------
    ModelError
        Where no model may read the column: it is unknown, or holds the answer.
    EffectError
        Where it belongs to an unknown effect.
    """
    if column == ACCESSORIES_COLUMN:
        return "kWh"
    if column.startswith(EFFECT_PREFIX):
        declared = effects.get(column.removeprefix(EFFECT_PREFIX)).unit
        return "kWh" if declared == "1" else f"(kWh/({declared}))"
    if column.startswith(SINCE_SCOPE):
        parse_since(column)
        return "1"
    if column.startswith(VEHICLE_SCOPE):
        if not column.removeprefix(VEHICLE_SCOPE).strip():
            raise ModelError(f"scope {column!r} names no vehicle: write vehicle=ID, with an ID of the ride table")
        return "1"
    if column in DERIVED_COLUMNS:
        return DERIVED_COLUMNS[column].unit
    if column in FEATURES:
        return FEATURES[column]
    if column.startswith(ANSWERS):
        raise ModelError(f"column {column!r} holds what is to be predicted: remove it from the model")
    raise ModelError(f"column {column!r} is not one that a model can read: name an effect_* or a ride-table column")


def derive_coefficient_unit(columns: tuple[str, ...]) -> str:
    """Return the unit, as pint spells it, of the coefficient that makes a product of columns an energy in kWh.

    Examples
    --------
    >>> derive_coefficient_unit(("effect_aero_drag", "drag_area_m2"))
    '1'
    >>> derive_coefficient_unit(("effect_rolling", "odometer_km"))
    '1/km'
    >>> derive_coefficient_unit(()), derive_coefficient_unit(("average_speed_kmh", "lost_m"))
    ('kWh', 'kWh/(km/h)/m')
    """
    above, below = ["kWh"], []
    for column in columns:
        if column.startswith(EFFECT_PREFIX):
            above.append(effects.get(column.removeprefix(EFFECT_PREFIX)).unit)
            below.append("kWh")
        else:
            below.append(get_unit(column))
    for name in list(above):
        if name == "1" or name in below:
            above.remove(name)
            if name != "1":
                below.remove(name)
    return "/".join(["*".join(above) or "1", *(name for name in below if name != "1")])


class Columns(Mapping[str, Floats]):
    """Provide columns of some rides to a fit: unknown values filled, derived columns computed on access.

    Parameters
    ----------
    table : mapping of str to (n,) array
        Columns of the ride table, or a `DataFrame`.
    fills : mapping of str to float
        Value that replaces unknown (NaN) values of a column, derived ones included; a column without an entry keeps
        NaN.
    curve : AccessoryCurve, optional
        Accessory power for `accessories_kwh`.
    rows : (m,) int, optional
        Rows to provide; all, where not given.
    """

    def __init__(
        self,
        table: Table,
        fills: Mapping[str, float] | None = None,
        curve: AccessoryCurve | None = None,
        rows: Any = None,
    ) -> None:
        self.table = table
        self.fills = fills or {}
        self.curve = curve
        self.rows = rows
        self._made: dict[str, Floats] = {}

    def __getitem__(self, name: str) -> Floats:
        """Return a column as (m,) float, NaN where it is unknown and has no fill."""
        column = self._made.get(name)
        if column is None:
            column = self._make(name)
            fill = self.fills.get(name)
            if fill is not None:
                column = np.where(np.isnan(column), fill, column)
            self._made[name] = column
        return column

    def _make(self, name: str) -> Floats:
        """Return a column of the table, or compute it from others."""
        if name == ACCESSORIES_COLUMN:
            if self.curve is None:
                raise ModelError(
                    f"{ACCESSORIES_COLUMN} needs an accessory curve, and this fit has none: fit the model again"
                )
            duration, ambient, scale = (self[needed] for needed in ACCESSORY_NEEDS)
            return duration * self.curve.power(ambient + ZERO_CELSIUS) * scale / 3.6e6
        if name.startswith(VEHICLE_SCOPE):
            return (self._raw("vehicle_id", object) == name.removeprefix(VEHICLE_SCOPE)).astype(np.float64)
        if name.startswith(SINCE_SCOPE):
            return (self["start_s"] >= parse_since(name)).astype(np.float64)
        if name in DERIVED_COLUMNS:
            return DERIVED_COLUMNS[name].make(*(self[needed] for needed in DERIVED_COLUMNS[name].needs))
        return self._raw(name, np.float64)

    def _raw(self, name: str, kind: type) -> NDArray[Any]:
        """Return a column of the table itself."""
        column: NDArray[Any] = np.ascontiguousarray(self.table[name], dtype=kind)
        return column if self.rows is None else column[self.rows]

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and all(column in self.table for column in list_raw_columns(name))

    def __iter__(self) -> Iterator[Any]:
        return iter(self.table)

    def __len__(self) -> int:
        return len(self.table)
