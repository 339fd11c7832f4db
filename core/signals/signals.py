"""Derived columns: what an effect may ask for by name. Stateless; each is made only when it is asked for.

What an unknown value means is decided here: an unknown wind, heading, rain, snow, sun or humidity is none, an unknown
air pressure is that of the standard atmosphere, an unknown outside temperature is 15 °C (and counted, see
`Quality.AMBIENT_ASSUMED`), nobody knowing who is aboard is the driver alone, a car first heard of has stood for a
night, an odometer never heard of stands at 0, an unknown place has daylight. What stays NaN is what nobody may guess:
the car's own parameters, its state of charge, its battery's temperature; effects for which a guess will do ask for
`charge` and `pack_temperature` instead.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Final

import numpy as np

from core.batch import Floats, Ints
from core.cleaning.kernel import Clean
from core.cleaning.quality import Quality
from core.columns import GRAVITY, SIGNALS, STANDARD_AIR_DENSITY, ZERO_CELSIUS
from core.signals.sun import sine_of_elevation
from core.signals.weather import Sky, snow_left, water_left
from core.vehicles import OCCUPANT_MASS
from core.vehicles.fleet import CarParameters

STANDARD_AMBIENT: Final = ZERO_CELSIUS + 15.0
"""Temperature of the standard atmosphere at sea level. [K] ISO 2533:1975."""
STANDARD_PRESSURE: Final = 101_325.0
"""Pressure of the standard atmosphere at sea level. [Pa] ISO 2533:1975."""
DRY_AIR: Final = 287.05287
"""Specific gas constant of dry air. [J/(kg K)] ISO 2533:1975."""
STEEPEST: Final = 0.35
"""Steepest sine of a road's angle that is believed: Baldwin Street, Dunedin, has 0.33."""
NIGHT: Final = 8 * 3600.0
"""How long a car has stood of whose rest nobody knows. [s]"""
HALF_CHARGED: Final = 0.5
"""State of charge of a car that does not say."""
CIVIL_DUSK: Final = 6.0
"""How far the sun is below the horizon when civil twilight ends. [deg]"""


class Signals(Mapping[str, Floats]):
    """Columns by name, each computed when first asked for; see `core.columns.SIGNALS`.

    Parameters
    ----------
    clean : Clean
        n rows.
    sky : Sky
        Weather at the rows.
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


def ambient_quality(clean: Clean, sky: Sky) -> Ints:
    """Return the quality of the rows, (n,) int, with the bits that say where the outside temperature came from."""
    unknown = np.isnan(clean.ambient)
    if not unknown.any():
        return clean.quality
    source = np.where(np.isnan(sky.ambient), int(Quality.AMBIENT_ASSUMED), int(Quality.AMBIENT_FILLED))
    return clean.quality | np.where(unknown, source, 0)


def grade(signals: Signals) -> Floats:
    """Return the sine of the road's angle, so that sin θ v over the travel time is the climb to the last millimetre."""
    clean = signals.clean
    run = clean.speed * clean.travel
    sine = np.divide(clean.climb, run, out=np.zeros(len(run)), where=run > 0.0)
    return np.clip(sine, -STEEPEST, STEEPEST)


def ambient(signals: Signals) -> Floats:
    """Return the outside temperature: the car's, else the nearest station's, else the standard one. [K]"""
    own = signals.clean.ambient
    unknown = np.isnan(own)
    if not unknown.any():
        return own
    station = signals.sky.ambient
    return np.where(unknown, np.where(np.isnan(station), STANDARD_AMBIENT, station), own)


def compute_air_density(signals: Signals) -> Floats:
    """Return the density of moist air at the car. [kg/m^3]

    Notes
    -----
    rho = (p - 0.378 e) / (R T), with pressure p reduced from sea level by exp(-g z / (R T)) and vapour pressure e.
    """
    temperature = signals["ambient"]
    elevation = np.nan_to_num(signals.clean.elevation)
    sea_level = np.nan_to_num(signals.sky.pressure, nan=STANDARD_PRESSURE)
    pressure = sea_level * np.exp(-GRAVITY / DRY_AIR * elevation / temperature)
    return (pressure - 0.378 * signals["vapour_pressure"]) / (DRY_AIR * temperature)


def vapour_pressure(signals: Signals) -> Floats:
    """Return the pressure of the water in the air, by the Magnus formula of WMO-No. 8 (2018), annex 4.B. [Pa]"""
    celsius = signals["ambient"] - ZERO_CELSIUS
    return 611.2 * np.exp(17.62 * celsius / (243.12 + celsius)) * np.nan_to_num(signals.sky.humidity)


def compute_headwind(signals: Signals) -> Floats:
    """Return the wind against the direction of travel. [m/s]"""
    heading, sky = signals.clean.heading, signals.sky
    return np.nan_to_num(sky.wind_north * np.cos(heading) + sky.wind_east * np.sin(heading))


def crosswind(signals: Signals) -> Floats:
    """Return the wind from the right. [m/s]"""
    heading, sky = signals.clean.heading, signals.sky
    return np.nan_to_num(sky.wind_east * np.cos(heading) - sky.wind_north * np.sin(heading))


def mass(signals: Signals) -> Floats:
    """Return kerb mass and people aboard. [kg]"""
    return signals.car.mass_kg + OCCUPANT_MASS * signals["occupants"]


def occupants(signals: Signals) -> Floats:
    """Return the people aboard, the driver alone where nobody says."""
    return np.nan_to_num(signals.clean.occupants, nan=1.0)


def stop_rate(signals: Signals) -> Floats:
    """Return stops that began in the step, over its time. [1/s]"""
    clean = signals.clean
    return np.divide(clean.stop, clean.dt, out=np.zeros(len(clean.dt)), where=clean.dt > 0.0)


def tyre_load(signals: Signals) -> Floats:
    """Return the weight that presses the tyres to the road. [N]"""
    slope = signals["grade"]
    return signals["mass"] * GRAVITY * np.sqrt(1.0 - slope * slope)


def traction(signals: Signals) -> Floats:
    """Return the force at the wheels, by the car's own parameters, in still standard air. [N]

    Notes
    -----
    F = m a + m g (c cos θ + sin θ) + 1/2 ρ0 A_d v^2; Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4.
    """
    speed, weight = signals["speed"], signals["mass"]
    rolling = signals["rolling_resistance"] * signals["tyre_load"]
    drag = 0.5 * STANDARD_AIR_DENSITY * signals["drag_area"] * speed * speed
    force = weight * (signals["acceleration"] + GRAVITY * signals["grade"]) + rolling + drag
    return np.where(speed > 0.0, force, 0.0 * weight)


def pack_temperature(signals: Signals) -> Floats:
    """Return the battery's temperature, a battery that does not tell being as cold as the air. [K]"""
    own = signals.clean.battery_temperature
    return np.where(np.isnan(own), signals["ambient"], own)


def darkness(signals: Signals) -> Floats:
    """Return 0 while the sun is up, 1 from the end of civil twilight on, in between by the sine of its depth."""
    clean = signals.clean
    depth = -sine_of_elevation(clean.time, clean.latitude, clean.longitude)
    return np.clip(np.nan_to_num(depth) / np.sin(np.radians(CIVIL_DUSK)), 0.0, 1.0)


def water(signals: Signals) -> Floats:
    """Return the rain on the road, see `core.signals.weather`. [m]"""
    sky = signals.sky
    return np.nan_to_num(water_left(sky.water, sky.ambient, sky.precipitation, signals.clean.time - sky.observed))


def compute_snow(signals: Signals) -> Floats:
    """Return the snow on the road, as melted water, see `core.signals.weather`. [m]"""
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
    "pack_temperature": pack_temperature,
    "vapour_pressure": vapour_pressure,
    "water": water,
    "snow": compute_snow,
    "darkness": darkness,
}
"""Columns that are not simply those of `Clean`."""
