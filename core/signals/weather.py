"""Weather as a car meets it: the nearest station's latest observation that is not from the car's future.

What lies on the road is remembered: each observation carries the rain and the snow left of all before it. Both are
stores that gain what falls and lose a share of what they hold, h' = p - h / τ.
"""

from typing import Any, Final, NamedTuple

import numpy as np

from core.batch import Floats
from core.columns import KMH, ZERO_CELSIUS
from core.wire.messages import Weather

KEPT: Final = 48
"""Observations kept of each station."""
LATEST: Final = 4.2e9
"""Latest time that is believed. [s]"""
DRYING: Final = 3600.0
"""Time in which all but 1/e of the rain leaves the road: it runs off, is splashed away, dries. [s] Estimated."""
CLEARING: Final = 12 * 3600.0
"""The same of snow in frost: it is ploughed, salted and driven away. [s] Estimated."""
THAWING: Final = 3 * 3600.0
"""The same of snow in a thaw. [s] Estimated."""
FREEZING: Final = ZERO_CELSIUS + 1.0
"""Air temperature at which as much snow falls as rain, the mean over the northern hemisphere. [K]

Jennings et al. 2018, Nature Communications 9:1148, DOI 10.1038/s41467-018-03629-7.
"""
_HOUR: Final = 3600.0


class Sky(NamedTuple):
    """Weather at each row, (n,) float64 each, NaN where unknown.

    Parameters
    ----------
    ambient : [K]
    wind_speed : [m/s]
    wind_north, wind_east : components of where the wind blows from. [m/s]
    precipitation : [m/s]
    pressure : at sea level. [Pa]
    humidity : relative. [1]
    solar : global horizontal irradiance. [W/m^2]
    observed : time of the observation. [s]
    water, snow : on the road at that time, snow as melted water. [m]
    """

    ambient: Floats
    wind_speed: Floats
    wind_north: Floats
    wind_east: Floats
    precipitation: Floats
    pressure: Floats
    humidity: Floats
    solar: Floats
    observed: Floats
    water: Floats
    snow: Floats


_AMBIENT, _PRECIPITATION, _OBSERVED = (Sky._fields.index(name) for name in ("ambient", "precipitation", "observed"))


class _Station(NamedTuple):
    times: list[float]
    rows: list[list[float]]
    latitude: float = np.nan
    longitude: float = np.nan


_LOW: Final = (-75.0, 0.0, 0.0, 0.0, 800.0, 0.0, 0.0)
_HIGH: Final = (65.0, 400.0, 360.0, 1000.0, 1100.0, 100.0, 1500.0)
"""What is believed: temperature [°C], wind [km/h] and its source [°], precipitation [mm], pressure [hPa], humidity [%],
sun [W/m^2]; anything else is unknown."""


class Stations:
    """The stations heard of, and what they observed."""

    def __init__(self) -> None:
        self._stations: dict[str, _Station] = {}

    def observe(self, message: Weather) -> bool:
        """Take an observation; one of the same time replaces the one before. Return whether it is one of this planet.

        A station that moves is where it said last.
        """
        place = np.radians(message.latitude_deg), np.radians(message.longitude_deg)
        if not (abs(place[0]) <= np.pi / 2 and abs(place[1]) <= np.pi and 0.0 <= message.time_s <= LATEST):
            return False
        times, rows, *_ = self._stations.get(message.station_id, _Station([], []))
        self._stations[message.station_id] = _Station(times, rows, *map(float, place))
        at = int(np.searchsorted(times, message.time_s))
        if at == 0 and len(times) == KEPT:  # older than all that is kept
            return True
        earlier = times[at - 1] if at else message.time_s - _HOUR
        row = _observation(message, max(60.0, message.time_s - earlier))
        if at < len(times) and times[at] == message.time_s:
            rows[at] = row
        else:
            times.insert(at, message.time_s)
            rows.insert(at, row)
        _lay(rows, at)
        del times[:-KEPT], rows[:-KEPT]
        return True

    def sky(self, time: Floats, latitude: Floats, longitude: Floats) -> Sky:
        """Return the weather at places and times.

        Parameters
        ----------
        time : (n,) float
            Unix time. [s]
        latitude, longitude : (n,) float
            NaN where unknown: the first station then serves. [rad]
        """
        n = len(time)
        best = np.full(n, np.inf)
        values = np.full((len(Sky._fields), n), np.nan)
        for station in self._stations.values():
            north = latitude - station.latitude
            east = np.abs(longitude - station.longitude)
            east = np.minimum(east, 2.0 * np.pi - east) * np.cos(station.latitude)
            far = np.nan_to_num(north * north + east * east, nan=1e9)
            latest = np.searchsorted(station.times, time, side="right") - 1
            nearer = (far < best) & (latest >= 0)
            if nearer.all():
                best = far
                values = np.array(station.rows).T.take(latest, axis=1)
            elif nearer.any():
                best[nearer] = far[nearer]
                values[:, nearer] = np.array(station.rows)[latest[nearer]].T
        return Sky(*values)

    def dump(self) -> Any:
        """Return the state as plain lists."""
        return [[name, *station] for name, station in self._stations.items()]

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        self._stations = {name: _Station(*station) for name, *station in state}


def held(depth: Any, rate: Any, age: Any, memory: Any) -> Any:
    """Return what a store holds after a time: h' = rate - h / memory.

    Examples
    --------
    >>> float(held(0.0, 2.0, 1e9, 3.0)), float(held(5.0, 2.0, 0.0, 3.0))
    (6.0, 5.0)
    """
    kept = np.exp(-age / memory)
    return depth * kept + rate * memory * (1.0 - kept)


def water_left(water: Any, ambient: Any, precipitation: Any, age: Any) -> Any:
    """Return the rain on a road some time after there was `water`, while the same falls. [m]"""
    return held(water, np.where(ambient < FREEZING, 0.0, np.nan_to_num(precipitation)), age, DRYING)


def snow_left(snow: Any, ambient: Any, precipitation: Any, age: Any) -> Any:
    """Return the snow on a road, as melted water, some time after there was `snow`, while the same falls. [m]"""
    frost = ambient < FREEZING
    return held(snow, np.where(frost, np.nan_to_num(precipitation), 0.0), age, np.where(frost, CLEARING, THAWING))


def _lay(rows: list[list[float]], first: int) -> None:
    """Work out what lies on the road from an observation on; what each says of rain fell before it."""
    for at in range(first, len(rows)):
        row = rows[at]
        before = rows[at - 1] if at else None
        age = row[_OBSERVED] - before[_OBSERVED] if before else _HOUR
        water, snow = before[_OBSERVED + 1 :] if before else (0.0, 0.0)
        weather = row[_AMBIENT], row[_PRECIPITATION], age
        row[_OBSERVED + 1 :] = float(water_left(water, *weather)), float(snow_left(snow, *weather))


def _observation(message: Weather, since: float) -> list[float]:
    """Return an observation in SI, in the order of `Sky`, but for what lies on the road."""
    said = (
        message.temperature_c,
        message.wind_speed_kmh,
        message.wind_from_deg,
        message.precipitation_mm,
        message.pressure_hpa,
        message.humidity_pct,
        message.solar_w_m2,
    )
    temperature, wind, source, rain, pressure, humidity, solar = (
        np.nan if value is None or not low <= value <= high else value
        for value, low, high in zip(said, _LOW, _HIGH, strict=True)
    )
    wind *= KMH
    source = np.radians(source)
    return [
        temperature + ZERO_CELSIUS,
        wind,
        float(wind * np.cos(source)),
        float(wind * np.sin(source)),
        rain * 1e-3 / since,
        pressure * 100.0,
        humidity * 0.01,
        solar,
        message.time_s,
        0.0,
        0.0,
    ]
