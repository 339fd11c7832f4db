"""Nomenclature: the name, unit and valid range of every column, each fixed once.

Inside core everything is SI and the names carry no suffix; whatever leaves core in another unit wears it
(`speed_kmh`, `energy_kwh`). Units are spelled as `pint` reads them.
"""

from dataclasses import dataclass
from math import inf, pi
from typing import Final

KMH: Final = 1 / 3.6
"""One kilometre an hour. [m/s]"""
ZERO_CELSIUS: Final = 273.15
"""The freezing point of water. [K]"""
GRAVITY: Final = 9.80665
"""Standard gravity. [m/s^2] CGPM 1901."""
EARTH_RADIUS: Final = 6_371_008.8
"""Mean radius of the Earth. [m] IUGG 1980 (Moritz 2000, J. Geodesy 74:128)."""
JOULES_PER_KWH: Final = 3.6e6
STANDARD_AIR_DENSITY: Final = 1.225
"""Dry air at 15 °C and 101,325 Pa. [kg/m^3] ISO 2533:1975, Table 1."""


@dataclass(frozen=True)
class Column:
    """One named quantity.

    Parameters
    ----------
    name : str
    unit : str
        As pint spells it; `1` for a pure number.
    meaning : str
    low, high : float
        Closed interval of values that a car on a road can have. Outside it a value is missing and counted.
    """

    name: str
    unit: str
    meaning: str
    low: float = -inf
    high: float = inf


TELEMETRY: Final = (
    Column("stamp", "s", "the logger's own clock, Unix time; not to be trusted", 0.0, 4.2e9),
    Column("seq", "1", "the logger's sample counter", 0.0, 2.0**53),
    Column("latitude", "rad", "WGS 84", -pi / 2, pi / 2),
    Column("longitude", "rad", "WGS 84", -pi, pi),
    Column("elevation", "m", "above sea level", -500.0, 6000.0),
    Column("speed", "m/s", "as reported, wheel or GPS", 0.0, 1e4),
    Column("odometer", "m", "as reported", 0.0, 5e9),
    Column("soc", "1", "state of charge as reported, quantised", 0.0, 1.0),
    Column("voltage", "V", "traction battery", 1.0, 1500.0),
    Column("current", "A", "traction battery, positive when discharging", -2000.0, 2000.0),
    Column("battery_temperature", "K", "traction battery", 203.15, 373.15),
    Column("ambient", "K", "outside air", 203.15, 333.15),
    Column("hvac", "W", "measured heating and air conditioning", 0.0, 30_000.0),
    Column("occupants", "1", "people aboard, driver included", 0.0, 100.0),
    Column("charging", "1", "1 plugged in and charging, 0 not", 0.0, 1.0),
)
"""What a sample brings, after the codec; NaN where unknown."""

SIGNALS: Final = (
    Column("dt", "s", "time that the row stands for"),
    Column("speed", "m/s", "smoothed ground speed, mean over the step", 0.0, 130 * KMH),
    Column("acceleration", "m/s^2", "of the smoothed speed"),
    Column("distance", "m", "driven in the step"),
    Column("grade", "1", "sine of the road's angle, uphill positive", -0.35, 0.35),
    Column("heading", "rad", "direction of travel, clockwise from north"),
    Column("turn_rate", "rad/s", "change of heading"),
    Column("headwind", "m/s", "wind against the direction of travel"),
    Column("crosswind", "m/s", "wind from the right, at right angles to travel"),
    Column("air_density", "kg/m^3", "of moist air at the car's elevation"),
    Column("ambient", "K", "outside air, the car's own or the nearest station's"),
    Column("precipitation", "m/s", "depth of rain or melted snow that falls in a time"),
    Column("humidity", "1", "relative humidity"),
    Column("solar", "W/m^2", "global horizontal irradiance, none where unknown"),
    Column("elapsed", "s", "since the ride began"),
    Column("parked", "s", "parked before the ride began, a night where unknown"),
    Column("stopped", "1", "1 where the car stands"),
    Column("stop_rate", "1/s", "stops that began in the step, over its time"),
    Column("soc", "1", "state of charge as last reported"),
    Column("battery_temperature", "K", "traction battery"),
    Column("current", "A", "traction battery, positive when discharging"),
    Column("hvac", "W", "measured heating and air conditioning"),
    Column("occupants", "1", "people aboard, driver included"),
    Column("odometer", "m", "as last reported, 0 where unknown"),
    Column("time", "s", "repaired clock, Unix time"),
    Column("mass", "kg", "kerb mass and the people aboard"),
    Column("accessory_scale", "1", "the car's accessory power over the reference curve's"),
    Column("rolling_resistance", "1", "the car's coefficient, warm tyres on dry asphalt"),
    Column("drag_area", "m^2", "the car's drag coefficient times its frontal area"),
    Column("tyre_load", "N", "the car's weight on its tyres, m g cos θ"),
    Column("traction", "N", "force at the wheels by the car's own road load; negative when braking, 0 when standing"),
    Column("charge", "1", "state of charge, one half where unknown", 0.0, 1.0),
    Column("pack_temperature", "K", "traction battery, the outside air's where unknown"),
    Column("vapour_pressure", "Pa", "of the water in the air, none where unknown", 0.0),
    Column("water", "m", "depth of rain on the road, by what fell and what dried", 0.0),
    Column("snow", "m", "depth of snow on the road, melted, by what fell and what was cleared", 0.0),
    Column("darkness", "1", "0 while the sun is up, 1 at the end of civil twilight and after", 0.0, 1.0),
)
"""What an effect may ask for by name; NaN where unknown."""
