"""Nomenclature: the name, unit, meaning, source and valid range of every column, each defined once.

Quantities inside core are in SI units and their names carry no suffix. Quantities that leave core in another unit carry
that unit in their name (`speed_kmh`, `energy_kwh`). Units are spelled as `pint` reads them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf, pi
from typing import Final, Literal, get_args

SECONDS_PER_DAY: Final = 86_400.0
"""Duration of a day of Unix time, which has no leap seconds. [s]"""
KMH: Final = 1 / 3.6
"""One kilometre per hour. [m/s]"""
ZERO_CELSIUS: Final = 273.15
"""Freezing point of water. [K]"""
GRAVITY: Final = 9.80665
"""Standard gravity. [m/s^2] CGPM 1901."""
EARTH_RADIUS: Final = 6_371_008.8
"""Mean radius of the Earth. [m] IUGG 1980 (Moritz 2000, J. Geodesy 74:128)."""
JOULES_PER_KWH: Final = 3.6e6
"""One kilowatt-hour. [J]"""
STANDARD_AIR_DENSITY: Final = 1.225
"""Density of dry air at 15 °C and 101,325 Pa. [kg/m^3] ISO 2533:1975, Table 1."""
PowerSpan = Literal["moment", "before", "around", "after"]
"""What the power of a sample covers: its moment, or as a mean the period before, around or after it."""
POWER_SPANS: Final[tuple[str, ...]] = get_args(PowerSpan)
"""The same as a list; arrays hold places in it, 0 for the moment."""
SPEED_BIN_KMH: Final = 5
"""Width of a bin of the speed histogram, Table 1 of the paper. [km/h]"""
SPEED_BINS: Final = 21
"""Number of bins of the speed histogram; the last one holds all faster driving."""


@dataclass(frozen=True)
class Column:
    """Describe one named quantity.

    Parameters
    ----------
    unit : str
        Unit as pint spells it; `1` for a pure number, empty for text and truth values.
    source : str
        Wire field, step or message that the values come from.
    low, high : float
        Closed interval of the values that a car on a road can have. A value outside it is counted and taken as missing.
    """

    name: str
    unit: str
    meaning: str
    source: str
    low: float = -inf
    high: float = inf


TELEMETRY: Final = (
    Column("stamp", "s", "time on the logger's own clock, Unix time, before repair", "time_s", 0.0, 4.2e9),
    Column("seq", "1", "the logger's sample counter", "seq", 0.0, 2.0**53),
    Column("latitude", "rad", "latitude, WGS 84", "latitude_deg", -pi / 2, pi / 2),
    Column("longitude", "rad", "longitude, WGS 84", "longitude_deg", -pi, pi),
    Column("elevation", "m", "elevation above sea level", "elevation_m", -500.0, 6000.0),
    Column("speed", "m/s", "speed as reported, by wheel or GPS", "speed_kmh", 0.0, 1e4),
    Column("odometer", "m", "odometer as reported", "odometer_km", 0.0, 5e9),
    Column("soc", "1", "state of charge as reported, quantised", "soc_pct", 0.0, 1.0),
    Column("voltage", "V", "voltage of the traction battery", "battery_voltage_v", 1.0, 1500.0),
    Column(
        "current",
        "A",
        "current of the traction battery, positive when discharging",
        "battery_current_a",
        -2000.0,
        2000.0,
    ),
    Column("battery_temperature", "K", "temperature of the traction battery", "battery_temperature_c", 203.15, 373.15),
    Column("ambient", "K", "temperature of the outside air", "ambient_c", 203.15, 333.15),
    Column("hvac", "W", "measured power of heating and air conditioning", "hvac_w", 0.0, 30_000.0),
    Column("occupants", "1", "people aboard, including the driver", "occupants", 0.0, 100.0),
    Column("charging", "1", "1 while plugged in and charging, else 0", "charging", 0.0, 1.0),
)
"""Columns of a decoded sample, before cleaning; NaN where unknown. The source is the wire field."""

SIGNALS: Final = (
    Column("dt", "s", "time that the row stands for", "cleaning"),
    Column("speed", "m/s", "ground speed, mean over the step", "cleaning", 0.0, 130 * KMH),
    Column("acceleration", "m/s^2", "change of the speed over time", "cleaning"),
    Column(
        "acceleration_spread",
        "m/s^2",
        "estimated standard deviation of the acceleration within the step, 0 where unknown",
        "cleaning",
    ),
    Column("distance", "m", "distance driven in the step", "cleaning"),
    Column("grade", "1", "sine of the road's angle, uphill positive", "signals, from climb and distance", -0.35, 0.35),
    Column("heading", "rad", "direction of travel, clockwise from north", "cleaning"),
    Column("turn_rate", "rad/s", "change of heading over time", "cleaning"),
    Column("headwind", "m/s", "wind against the direction of travel", "weather message"),
    Column("crosswind", "m/s", "wind from the right, at right angles to travel", "weather message"),
    Column("air_density", "kg/m^3", "density of moist air at the car's elevation", "signals, from weather message"),
    Column("ambient", "K", "outside temperature of the car, else of the nearest station", "telemetry, weather message"),
    Column("precipitation", "m/s", "depth of rain or melted snow per time", "weather message"),
    Column("humidity", "1", "relative humidity", "weather message"),
    Column("solar", "W/m^2", "global horizontal irradiance, 0 where unknown", "weather message"),
    Column("elapsed", "s", "time since the ride began", "cleaning"),
    Column("parked", "s", "time parked before the ride began, a night where unknown", "cleaning"),
    Column("stopped", "1", "1 while the car stands, else 0", "cleaning"),
    Column("stop_rate", "1/s", "stops that began in the step, over its time", "signals, from cleaning"),
    Column("soc", "1", "state of charge as last reported", "cleaning"),
    Column("battery_temperature", "K", "temperature of the traction battery", "cleaning"),
    Column("current", "A", "current of the traction battery, positive when discharging", "telemetry"),
    Column("hvac", "W", "measured power of heating and air conditioning", "telemetry"),
    Column("occupants", "1", "people aboard, including the driver; 1 where unknown", "cleaning"),
    Column("odometer", "m", "odometer as last reported, 0 where unknown", "cleaning"),
    Column("time", "s", "time on the repaired clock, Unix time", "cleaning"),
    Column("mass", "kg", "kerb mass and the people aboard", "vehicle message, telemetry"),
    Column("accessory_scale", "1", "the car's accessory power over that of the reference curve", "vehicle message"),
    Column("rolling_resistance", "1", "the car's coefficient, warm tyres on dry asphalt", "vehicle message"),
    Column("drag_area", "m^2", "the car's drag coefficient times its frontal area", "vehicle message"),
    Column("tyre_load", "N", "weight of the car on its tyres, m g cos θ", "signals, from mass and grade"),
    Column(
        "traction",
        "N",
        "force at the wheels by the car's own road load; negative when braking, 0 when standing",
        "signals, from motion and vehicle message",
    ),
    Column(
        "wheel_power",
        "W",
        "power at the wheels by the car's own road load, mean over the step and the one before",
        "signals, from motion and vehicle message",
    ),
    Column("braking_force", "N", "braking at the wheels, mean over the step", "signals, from traction", 0.0),
    Column("charge", "1", "state of charge, one half where unknown", "cleaning", 0.0, 1.0),
    Column("pack_temperature", "K", "battery temperature, else the outside temperature", "cleaning, signals"),
    Column("vapour_pressure", "Pa", "pressure of the water in the air, 0 where unknown", "weather message", 0.0),
    Column("water", "m", "depth of rain on the road, from rainfall and drying", "weather message", 0.0),
    Column("snow", "m", "depth of melted snow on the road, from snowfall and clearing", "weather message", 0.0),
    Column("darkness", "1", "0 while the sun is up, 1 after civil twilight", "signals, from time and place", 0.0, 1.0),
    Column("sun_sine", "1", "sine of the elevation of the sun, 1 where unknown", "signals, from time and place", -1.0),
)
"""Columns that an effect may take as arguments; NaN where unknown."""

EFFECT_COLUMN: Final = Column(
    "effect_{name}", "kWh", "energy of the effect per unit of its coefficient", "effect {name}"
)
"""Rule for the columns of the effects whose energies are summed, see `expand_effect_columns`."""

_KEYS: Final = (
    Column("vehicle_id", "", "identity of the vehicle", "key of the telemetry"),
    Column("vehicle_model", "", "key of the vehicle model, missing before a vehicle message", "vehicle message"),
    Column("energy_source", "", "what measured `energy_kwh`: `vi` or `soc`, missing where nothing did", "totals"),
)
_SUMMARY: Final = (
    Column("start_s", "s", "Unix time of the first sample", "cleaning"),
    Column("end_s", "s", "Unix time of the last sample", "cleaning"),
    Column("duration_s", "s", "time that its samples stand for", "totals"),
    Column("standing_s", "s", "part of `duration_s` in which the car stood", "totals"),
    Column("distance_km", "km", "distance driven", "totals"),
    Column("average_speed_kmh", "km/h", "distance over duration", "totals"),
    Column("gained_m", "m", "sum of all climbs; in `tables` from elevation smoothed over the whole ride", "totals"),
    Column("lost_m", "m", "sum of all descents; in `tables` from elevation smoothed over the whole ride", "totals"),
    Column("gained_causal_m", "m", "sum of all climbs as a forecast knows them, from earlier fixes only", "totals"),
    Column("lost_causal_m", "m", "sum of all descents as a forecast knows them, from earlier fixes only", "totals"),
    Column("ambient_c", "degC", "mean outside temperature", "totals, from telemetry and weather messages"),
    Column("wind_speed_kmh", "km/h", "mean wind speed at the nearest station", "totals, from weather messages"),
    Column("wind_from_deg", "degree", "direction the mean wind blows from, north 0, east 90", "weather messages"),
    Column("precipitation_mm_h", "mm/h", "mean rate of rain or melted snow", "totals, from weather messages"),
    Column("hvac_kwh", "kWh", "measured energy of heating and air conditioning", "totals, from telemetry"),
    Column("stops", "1", "number of stops", "totals, from cleaning"),
    Column("unresolved_braking_kwh", "kWh", "braking energy at the wheels that is estimated between samples", "totals"),
    Column("samples", "1", "number of samples", "totals"),
    Column("rejected_speed_share", "1", "share of the duration for which the speed was rejected", "totals"),
    Column("missing_speed_share", "1", "share of the duration for which the speed was missing", "totals"),
    Column("bridged_distance_share", "1", "share of the distance that comes from fix or odometer", "totals"),
    Column("soc_start_pct", "percent", "state of charge as first reported", "cleaning"),
    Column("soc_end_pct", "percent", "state of charge as last reported", "cleaning"),
    Column("battery_temperature_c", "degC", "battery temperature at the first sample", "cleaning"),
    Column("elapsed_s", "s", "time since the ride began at the first sample", "cleaning"),
    Column("parked_s", "s", "time parked before the ride", "cleaning"),
    Column("time_since_charge_s", "s", "time since the car last charged, at the last sample", "cleaning"),
    Column("odometer_km", "km", "odometer at the last sample", "cleaning"),
    Column("occupants", "1", "people aboard at the last sample, including the driver", "cleaning"),
    Column("latitude_start_deg", "degree", "latitude of the first sample, WGS 84", "cleaning"),
    Column("longitude_start_deg", "degree", "longitude of the first sample, WGS 84", "cleaning"),
    Column("latitude_end_deg", "degree", "latitude of the last sample, WGS 84", "cleaning"),
    Column("longitude_end_deg", "degree", "longitude of the last sample, WGS 84", "cleaning"),
    Column("energy_vi_kwh", "kWh", "energy drawn from the battery, by voltage and current", "totals"),
    Column("energy_vi_sd_kwh", "kWh", "standard uncertainty of `energy_vi_kwh`", "totals"),
    Column("energy_soc_kwh", "kWh", "energy drawn from the battery, by the fall of the state of charge", "totals"),
    Column("energy_soc_sd_kwh", "kWh", "standard uncertainty of `energy_soc_kwh`", "totals"),
    Column("energy_soc_noise_kwh", "kWh", "part of `energy_soc_sd_kwh` that differs from ride to ride", "totals"),
    Column("energy_kwh", "kWh", "measured energy: by voltage and current where known, else by charge", "totals"),
    Column("energy_sd_kwh", "kWh", "standard uncertainty of `energy_kwh`", "totals"),
    Column("usable_capacity_kwh", "kWh", "energy per 100 % of the display, learned so far", "totals, vehicle message"),
    Column("usable_capacity_sd_kwh", "kWh", "standard uncertainty of `usable_capacity_kwh`", "totals"),
    *(
        Column(
            f"speed_{SPEED_BIN_KMH * i}_{SPEED_BIN_KMH * (i + 1)}_km",
            "km",
            f"distance driven at {SPEED_BIN_KMH * i} to {SPEED_BIN_KMH * (i + 1)} km/h"
            + (", and faster" if i == SPEED_BINS - 1 else ""),
            "totals",
        )
        for i in range(SPEED_BINS)
    ),
    EFFECT_COLUMN,
    Column("mass_kg", "kg", "kerb mass of the car", "vehicle message"),
    Column("rolling_resistance", "1", "coefficient of the car, warm tyres on dry asphalt", "vehicle message"),
    Column("drag_area_m2", "m^2", "drag coefficient of the car times its frontal area", "vehicle message"),
    Column("nominal_capacity_kwh", "kWh", "rated energy of the car's new battery", "vehicle message"),
    Column("accessory_scale", "1", "accessory power of the car over that of the reference curve", "vehicle message"),
)

RIDE_COLUMNS: Final = (
    Column("ride_id", "", "the logger's name of the ride, else `ride_key`", "telemetry"),
    Column("ride_key", "", "unique key of the ride: vehicle and ordinal", "totals"),
    *_KEYS,
    Column("driver_id", "", "driver, missing where dispatch does not say", "ride message"),
    Column("date", "", "UTC date of the first sample, ISO 8601", "totals"),
    Column("winter", "1", "1 from 15 December to 15 March, else 0", "totals"),
    Column("summer", "1", "1 outside `winter`, else 0", "totals"),
    Column("fit_for_training", "", "true where the ride passes all filters", "totals"),
    Column("unfit_reason", "", "a filter that the ride fails, missing where it passes all", "totals"),
    *_SUMMARY,
    Column("quality_duplicate", "1", "samples sent again", "cleaning"),
    Column("quality_late", "1", "samples that arrived after their place in time had passed", "cleaning"),
    Column("quality_repaired_time", "1", "samples whose time stamp was repaired", "cleaning"),
    Column("quality_clock_step", "1", "samples at which the logger's clock had been set", "cleaning"),
    Column("quality_gap", "1", "samples with whole periods missing before them", "cleaning"),
    Column("quality_sequence", "1", "samples at which the counter restarted, stood still or leapt", "cleaning"),
    Column("quality_speed_rejected", "1", "samples with a speed above the limit", "cleaning"),
    Column("quality_speed_missing", "1", "samples without a speed, of a car that sends it", "cleaning"),
    Column("quality_position_missing", "1", "samples without a fix, of a car that sends it", "cleaning"),
    Column("quality_position_jump", "1", "samples with a fix farther away than the car can have driven", "cleaning"),
    Column("quality_position_frozen", "1", "samples with an unchanged fix while the car drives", "cleaning"),
    Column("quality_bridged", "1", "samples at which a distance was taken from fix or odometer", "cleaning"),
    Column("quality_out_of_range", "1", "samples with a value outside its valid range", "cleaning"),
    Column("quality_soc_missing", "1", "samples without a state of charge, of a car that sends it", "cleaning"),
    Column("quality_power_missing", "1", "samples without voltage or current, of a car that sends both", "cleaning"),
    Column("quality_ambient_filled", "1", "samples with the outside temperature of a weather station", "signals"),
    Column("quality_ambient_assumed", "1", "samples with the temperature of the standard atmosphere", "signals"),
    Column("quality_soc_jump", "1", "samples with a change of the charge that the car cannot have caused", "cleaning"),
    Column("quality_soc_frozen", "1", "samples with an unchanged charge while V·I drew several quanta", "cleaning"),
    Column("quality_power_frozen", "1", "samples with an unchanged current while the speed varied", "cleaning"),
    Column("quality_stamp_shared", "1", "samples placed by counter and order, as several share a stamp", "cleaning"),
    Column("quality_pause", "1", "samples after a pause over which the counter continued", "cleaning"),
    Column("quality_speed_contradicted", "1", "samples with a speed that odometer and fixes contradict", "cleaning"),
    Column("quality_speed_spike", "1", "samples with a speed that leaps and returns at once", "cleaning"),
    Column("quality_speed_noisy", "1", "samples with an average of a noisy speed", "cleaning"),
    Column("quality_position_drift", "1", "samples with a fix that wanders while the car stands", "cleaning"),
    Column("quality_slope_rejected", "1", "samples with an elevation steeper than any road", "cleaning"),
    Column("quality_charging_inferred", "1", "samples of charging that the car does not report", "cleaning"),
    Column("quality_current_inverted", "1", "samples with a current of the wrong sign", "cleaning"),
    Column("quality_soc_stale", "1", "samples with a change of the charge from before a pause", "cleaning"),
    Column("quality_clock_rollover", "1", "samples whose stamp was 1024 weeks early", "cleaning"),
)
"""Columns of the ride table, in their order; `EFFECT_COLUMN` stands for one column per summed effect."""

WINDOW_COLUMNS: Final = (
    Column("ride_key", "", "key of the ride that the window is part of", "totals"),
    Column("window", "1", "ordinal of the window among those of its vehicle", "cleaning"),
    *_KEYS,
    Column("power_start_w", "W", "power drawn from the battery at the first sample", "cleaning"),
    Column("power_end_w", "W", "power drawn from the battery at the last sample", "cleaning"),
    *_SUMMARY,
)
"""Columns of the window table, in their order; `EFFECT_COLUMN` stands for one column per summed effect."""


def expand_effect_columns(columns: Iterable[Column], effects: Iterable[str]) -> tuple[Column, ...]:
    """Return columns with `EFFECT_COLUMN` replaced by one column per effect.

    Examples
    --------
    >>> [column.name for column in expand_effect_columns([EFFECT_COLUMN], ["rolling", "climbing"])]
    ['effect_rolling', 'effect_climbing']
    """
    effects = list(effects)
    out: list[Column] = []
    for column in columns:
        if column is EFFECT_COLUMN:
            out += [
                Column(column.name.format(name=name), column.unit, column.meaning, column.source.format(name=name))
                for name in effects
            ]
        else:
            out.append(column)
    return tuple(out)
