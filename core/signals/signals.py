"""Compute the signals that an effect can request by name.

Signals are stateless. Each one is computed only when an effect requests it.

This module also decides what replaces an unknown value:

- wind, heading, rain, snow, sun and humidity: zero;
- air pressure: that of the standard atmosphere;
- outside temperature: 15 °C, which is counted, see `Quality.AMBIENT_ASSUMED`;
- occupants: the driver alone;
- idle time of a car without an earlier sample: one night;
- odometer: 0;
- position: daylight.

Values that must not be guessed stay NaN: the parameters of the car, its state of charge and its battery temperature.
An effect for which a guess is good enough requests `charge` and `pack_temperature` instead.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Final

import numpy as np
from scipy.special import ndtr

from socast.core.batch import Floats, Ints
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.quality import Quality
from socast.core.columns import GRAVITY, SIGNALS, STANDARD_AIR_DENSITY, ZERO_CELSIUS
from socast.core.signals.sun import sine_of_elevation
from socast.core.signals.weather import Sky, snow_left, water_left
from socast.core.vehicles import OCCUPANT_MASS
from socast.core.vehicles.fleet import CarParameters

STANDARD_AMBIENT: Final = ZERO_CELSIUS + 15.0
"""Temperature of the standard atmosphere at sea level. [K] ISO 2533:1975."""
STANDARD_PRESSURE: Final = 101_325.0
"""Pressure of the standard atmosphere at sea level. [Pa] ISO 2533:1975."""
DRY_AIR: Final = 287.05287
"""Specific gas constant of dry air. [J/(kg K)] ISO 2533:1975."""
STEEPEST: Final = 0.35
"""Largest plausible sine of the angle of a road: Baldwin Street, Dunedin, has 0.33. [1]"""
MOST_ACCELERATION: Final = GRAVITY
"""Largest acceleration of which the force at the wheels is computed: tyres on dry asphalt transmit about the weight of
the car. [m/s^2]"""
NIGHT: Final = 8 * 3600.0
"""Assumed idle time of a car whose idle time is unknown. [s]"""
HALF_CHARGED: Final = 0.5
"""Assumed state of charge of a car that does not report it. [1]"""
SQRT_TWO_PI: Final = (2.0 * np.pi) ** 0.5
NO_SUN: Final = 1.0
"""Sine of the elevation of the sun where it is unknown: no effect of darkness. [1]"""
CIVIL_DUSK: Final = 6.0
"""Depth of the sun below the horizon at the end of civil twilight. [deg]"""


class Signals(Mapping[str, Floats]):
    """Provide signals by name, each computed at its first use; see `socast.core.columns.SIGNALS`.

    Parameters
    ----------
    car : CarParameters
        Parameters of the car at each row.
    """

    def __init__(self, clean: Clean, sky: Sky, car: CarParameters) -> None:
        self.clean = clean
        self.sky = sky
        self.car = car
        self._made: dict[str, Floats] = {
            "accessory_scale": car.accessory_scale,
            "rolling_resistance": car.rolling_resistance,
            "drag_area": car.drag_area_m2,
        }

    def __getitem__(self, name: str) -> Floats:
        made = self._made.get(name)
        if made is None:
            make = _DERIVED.get(name)
            made = self._made[name] = getattr(self.clean, name) if make is None else make(self)
        return made

    def __iter__(self) -> Iterator[str]:
        return (column.name for column in SIGNALS)

    def __len__(self) -> int:
        return len(SIGNALS)


def flag_ambient(clean: Clean, sky: Sky) -> Ints:
    """Return the quality of each row, with the bits for the source of the outside temperature."""
    unknown = np.isnan(clean.ambient)
    if not unknown.any():
        return clean.quality
    source = np.where(np.isnan(sky.ambient), int(Quality.AMBIENT_ASSUMED), int(Quality.AMBIENT_FILLED))
    return clean.quality | np.where(unknown, source, 0)


def grade(signals: Signals) -> Floats:
    """Return the sine of the angle of the road. [1]

    Notes
    -----
    sin θ = climb / (v t), with speed v and travel time t. The integral of v sin θ over the travel time is therefore
    exactly the climb, except where `STEEPEST` limits the sine.
    """
    clean = signals.clean
    run = clean.speed * clean.travel
    sine = np.divide(clean.climb, run, out=np.zeros(len(run)), where=run > 0.0)
    return np.clip(sine, -STEEPEST, STEEPEST)


def ambient(signals: Signals) -> Floats:
    """Return the outside temperature: of the car, else of the nearest station, else of the standard atmosphere. [K]"""
    measured = signals.clean.ambient
    unknown = np.isnan(measured)
    if not unknown.any():
        return measured
    station = signals.sky.ambient
    return np.where(unknown, np.where(np.isnan(station), STANDARD_AMBIENT, station), measured)


def compute_air_density(signals: Signals) -> Floats:
    """Return the density of moist air at the car. [kg/m^3]

    Notes
    -----
    ρ = (p - 0.378 e) / (R T), with temperature T, gas constant R of dry air, vapour pressure e, and the pressure p
    reduced from sea level to the elevation z by exp(-g z / (R T)).
    """
    temperature = signals["ambient"]
    elevation = np.nan_to_num(signals.clean.elevation)
    sea_level = np.nan_to_num(signals.sky.pressure, nan=STANDARD_PRESSURE)
    pressure = sea_level * np.exp(-GRAVITY / DRY_AIR * elevation / temperature)
    return (pressure - 0.378 * signals["vapour_pressure"]) / (DRY_AIR * temperature)


def vapour_pressure(signals: Signals) -> Floats:
    """Return the pressure of the water vapour in the air. [Pa]

    References
    ----------
    Magnus formula in WMO-No. 8, Guide to Instruments and Methods of Observation (2018), annex 4.B.
    """
    celsius = signals["ambient"] - ZERO_CELSIUS
    return 611.2 * np.exp(17.62 * celsius / (243.12 + celsius)) * np.nan_to_num(signals.sky.humidity)


def compute_headwind(signals: Signals) -> Floats:
    """Return the wind component against the direction of travel. [m/s]"""
    heading, sky = signals.clean.heading, signals.sky
    return np.nan_to_num(sky.wind_north * np.cos(heading) + sky.wind_east * np.sin(heading))


def crosswind(signals: Signals) -> Floats:
    """Return the wind component from the right. [m/s]"""
    heading, sky = signals.clean.heading, signals.sky
    return np.nan_to_num(sky.wind_east * np.cos(heading) - sky.wind_north * np.sin(heading))


def mass(signals: Signals) -> Floats:
    """Return the mass of the car with its occupants. [kg]"""
    return signals.car.mass_kg + OCCUPANT_MASS * signals["occupants"]


def occupants(signals: Signals) -> Floats:
    """Return the number of occupants, 1 (the driver) where it is unknown. [1]"""
    return np.nan_to_num(signals.clean.occupants, nan=1.0)


def stop_rate(signals: Signals) -> Floats:
    """Return the number of stops that began in a step, divided by the duration of the step. [1/s]"""
    clean = signals.clean
    return np.divide(clean.stop, clean.dt, out=np.zeros(len(clean.dt)), where=clean.dt > 0.0)


def tyre_load(signals: Signals) -> Floats:
    """Return the force of gravity perpendicular to the road. [N]"""
    slope = signals["grade"]
    return signals["mass"] * GRAVITY * np.sqrt(1.0 - slope * slope)


def traction(signals: Signals) -> Floats:
    """Return the force at the wheels by the parameters of the car, in still standard air. [N]

    Notes
    -----
    F = m a + m g (c cos θ + sin θ) + 1/2 ρ0 A_d v^2, with mass m, acceleration a, rolling resistance c, angle θ of the
    road, standard air density ρ0, drag area A_d and speed v. The force is zero at standstill. |a| counts up to
    `MOST_ACCELERATION`: a wrong time stamp makes any change of the speed an acceleration without limit.

    References
    ----------
    Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4.
    """
    return _compute_force(signals, signals["speed"], signals["acceleration"])


def compute_wheel_power(signals: Signals) -> Floats:
    """Return the power at the wheels, mean over a step and the one before, by the force balance of `traction`. [W]

    Notes
    -----
    Effects that grow with the square of the power take this power. The mean square over single steps depends on when
    the samples fall within an acceleration, and so does the error of voltage times current between the samples. Where
    no effect is missing, samples every 3 s make the square of a step's own power explain 2.7 % of the energy, with a
    standard deviation of 0.8 %, and that of this mean 0.2 % (simulated fleets, seeds 400 to 409). In 31 drives of a
    BMW i3, the share that the square explains hardly depends on the period of the samples: 3.0 % at 1 s and 2.6 % at
    5 s. With a step's own power, the share falls from 3.4 to 1.2 %.

    References
    ----------
    Drives of the BMW i3: Steinstraeter et al., DOI 10.21227/6jr9-5235.
    """
    speed = signals.clean.wide_speed
    return _compute_force(signals, speed, signals.clean.wide_acceleration) * speed


def _compute_force(signals: Signals, speed: Floats, acceleration: Floats) -> Floats:
    """Return the force at the wheels at a speed and acceleration, zero at standstill. [N]"""
    weight = signals["mass"]
    rolling = signals["rolling_resistance"] * signals["tyre_load"]
    drag = 0.5 * STANDARD_AIR_DENSITY * signals["drag_area"] * speed * speed
    possible = np.clip(acceleration, -MOST_ACCELERATION, MOST_ACCELERATION)
    force = weight * (possible + GRAVITY * signals["grade"]) + rolling + drag
    return np.where(speed > 0.0, force, 0.0 * weight)


def compute_braking_force(signals: Signals) -> Floats:
    """Return the mean of max(-F, 0) over a step, with the force F at the wheels. [N]

    Notes
    -----
    A car that brakes for less than a step may be driven on average. The force is therefore taken as normally
    distributed within the step, with the mean F of `traction` and the standard deviation s = m σ, where σ is the spread
    of the acceleration, up to `MOST_ACCELERATION`. The mean of max(-F, 0) is then s φ(F/s) - F Φ(-F/s), and max(-F, 0)
    where σ is zero.
    """
    force = signals["traction"]
    spread = signals["mass"] * np.minimum(signals["acceleration_spread"], MOST_ACCELERATION)
    braking = np.maximum(-force, 0.0)
    at = np.flatnonzero((spread > 0.0) & (signals["speed"] > 0.0))
    ratio = force[at] / spread[at]
    density = np.exp(-0.5 * ratio * ratio) / SQRT_TWO_PI
    braking[at] = np.maximum(spread[at] * density - force[at] * ndtr(-ratio), 0.0)
    return braking


def pack_temperature(signals: Signals) -> Floats:
    """Return the battery temperature, replaced by the outside temperature where it is unknown. [K]"""
    measured = signals.clean.battery_temperature
    return np.where(np.isnan(measured), signals["ambient"], measured)


def darkness(signals: Signals) -> Floats:
    """Return the darkness: 0 while the sun is up, 1 after the end of civil twilight. [1]

    During twilight, it is proportional to the sine of the depth of the sun.
    """
    return np.clip(-signals["sun_sine"] / np.sin(np.radians(CIVIL_DUSK)), 0.0, 1.0)


def sun_sine(signals: Signals) -> Floats:
    """Return the sine of the elevation of the sun, `NO_SUN` where the position is unknown. [1]"""
    clean = signals.clean
    return np.nan_to_num(sine_of_elevation(clean.time, clean.latitude, clean.longitude), nan=NO_SUN)


def water(signals: Signals) -> Floats:
    """Return the depth of rain water on the road, see `socast.core.signals.weather`. [m]"""
    sky = signals.sky
    return np.nan_to_num(water_left(sky.water, sky.ambient, sky.precipitation, signals.clean.time - sky.observed))


def compute_snow(signals: Signals) -> Floats:
    """Return the depth of snow on the road as melted water, see `socast.core.signals.weather`. [m]"""
    sky = signals.sky
    return np.nan_to_num(snow_left(sky.snow, sky.ambient, sky.precipitation, signals.clean.time - sky.observed))


_DERIVED: Final[dict[str, Callable[[Signals], Floats]]] = {
    "grade": grade,
    "ambient": ambient,
    "air_density": compute_air_density,
    "headwind": compute_headwind,
    "crosswind": crosswind,
    "mass": mass,
    "occupants": occupants,
    "stop_rate": stop_rate,
    "precipitation": lambda signals: np.nan_to_num(signals.sky.precipitation),
    "humidity": lambda signals: signals.sky.humidity,
    "solar": lambda signals: np.nan_to_num(signals.sky.solar),
    "parked": lambda signals: np.nan_to_num(signals.clean.parked, nan=NIGHT),
    "odometer": lambda signals: np.nan_to_num(signals.clean.odometer),
    "charge": lambda signals: np.nan_to_num(signals.clean.soc, nan=HALF_CHARGED),
    "tyre_load": tyre_load,
    "traction": traction,
    "wheel_power": compute_wheel_power,
    "braking_force": compute_braking_force,
    "pack_temperature": pack_temperature,
    "vapour_pressure": vapour_pressure,
    "water": water,
    "snow": compute_snow,
    "darkness": darkness,
    "sun_sine": sun_sine,
}
"""Function of every signal that is not a column of `Clean`."""
