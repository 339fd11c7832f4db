"""Columns derived from the ride table's: how cold it is outside, whether the sun shines, how full the battery is.

Each is a function of a few columns that have a meaning at any moment of a ride, and is computed on access. A term of a
model, or a feature of its trees, names a derived column like one of the table.
"""

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY

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
