"""Derived columns: what an effect may ask for by name. Stateless; each is made only when it is asked for.

What an unknown value means is decided here: an unknown wind, heading, rain or snow is none, an unknown air pressure is
that of the standard atmosphere, an unknown outside temperature is 15 °C (and counted, see `Quality.AMBIENT_ASSUMED`),
nobody knowing who is aboard is the driver alone. What stays NaN is what nobody may guess: the car's own parameters, its
state of charge, its battery's temperature.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Final

import numpy as np

from core.batch import Floats, Ints
from core.clean import Clean
from core.columns import GRAVITY, SIGNALS, ZERO_CELSIUS
from core.quality import Quality
from core.vehicles import OCCUPANT_MASS
from core.weather import Sky

STANDARD_AMBIENT: Final = ZERO_CELSIUS + 15.0
"""Temperature of the standard atmosphere at sea level. [K] ISO 2533:1975."""
STANDARD_PRESSURE: Final = 101_325.0
"""Pressure of the standard atmosphere at sea level. [Pa] ISO 2533:1975."""
DRY_AIR: Final = 287.05287
"""Specific gas constant of dry air. [J/(kg K)] ISO 2533:1975."""
STEEPEST: Final = 0.35
"""Steepest sine of a road's angle that is believed: Baldwin Street, Dunedin, has 0.33."""


class Signals(Mapping[str, Floats]):
    """Columns by name, each computed when first asked for; see `core.columns.SIGNALS`.

    Parameters
    ----------
    clean : Clean
        n rows.
    sky : Sky
        Weather at the rows.
    mass_kg, accessory_scale : (n,) float
        The cars' own parameters, NaN where unknown.
    """

    def __init__(self, clean: Clean, sky: Sky, mass_kg: Floats, accessory_scale: Floats) -> None:
        self.clean = clean
        self.sky = sky
        self.mass_kg = mass_kg
        self._made: dict[str, Floats] = {"accessory_scale": accessory_scale}

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


def air_density(signals: Signals) -> Floats:
    """Return the density of moist air at the car. [kg/m^3]

    Notes
    -----
    rho = (p - 0.378 e) / (R T), with pressure p reduced from sea level by exp(-g z / (R T)) and vapour pressure e by
    the Magnus formula of WMO-No. 8 (2018), annex 4.B.
    """
    temperature = signals["ambient"]
    elevation = np.nan_to_num(signals.clean.elevation)
    sea_level = np.nan_to_num(signals.sky.pressure, nan=STANDARD_PRESSURE)
    pressure = sea_level * np.exp(-GRAVITY / DRY_AIR * elevation / temperature)
    celsius = temperature - ZERO_CELSIUS
    vapour = 611.2 * np.exp(17.62 * celsius / (243.12 + celsius)) * np.nan_to_num(signals.sky.humidity)
    return (pressure - 0.378 * vapour) / (DRY_AIR * temperature)


def headwind(signals: Signals) -> Floats:
    """Return the wind against the direction of travel. [m/s]"""
    heading, sky = signals.clean.heading, signals.sky
    return np.nan_to_num(sky.wind_north * np.cos(heading) + sky.wind_east * np.sin(heading))


def crosswind(signals: Signals) -> Floats:
    """Return the wind from the right. [m/s]"""
    heading, sky = signals.clean.heading, signals.sky
    return np.nan_to_num(sky.wind_east * np.cos(heading) - sky.wind_north * np.sin(heading))


def mass(signals: Signals) -> Floats:
    """Return kerb mass and people aboard. [kg]"""
    return signals.mass_kg + OCCUPANT_MASS * signals["occupants"]


def occupants(signals: Signals) -> Floats:
    """Return the people aboard, the driver alone where nobody says."""
    return np.nan_to_num(signals.clean.occupants, nan=1.0)


def stop_rate(signals: Signals) -> Floats:
    """Return stops that began in the step, over its time. [1/s]"""
    clean = signals.clean
    return np.divide(clean.stop, clean.dt, out=np.zeros(len(clean.dt)), where=clean.dt > 0.0)


_DERIVED: Final[dict[str, Callable[[Signals], Floats]]] = {
    "grade": grade,
    "ambient": ambient,
    "air_density": air_density,
    "headwind": headwind,
    "crosswind": crosswind,
    "mass": mass,
    "occupants": occupants,
    "stop_rate": stop_rate,
    "precipitation": lambda signals: np.nan_to_num(signals.sky.precipitation),
    "humidity": lambda signals: signals.sky.humidity,
    "solar": lambda signals: signals.sky.solar,
}
"""Columns that are not simply those of `Clean`."""
