"""Weather as a car meets it: the nearest station's latest observation that is not from the car's future."""

from typing import Any, Final, NamedTuple

import numpy as np

from core.batch import Floats
from core.codec import Weather
from core.columns import KMH, ZERO_CELSIUS

KEPT: Final = 48
"""Observations kept of each station."""
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
    """

    ambient: Floats
    wind_speed: Floats
    wind_north: Floats
    wind_east: Floats
    precipitation: Floats
    pressure: Floats
    humidity: Floats
    solar: Floats


class _Station(NamedTuple):
    latitude: float
    longitude: float
    times: list[float]
    rows: list[list[float]]


class Stations:
    """The stations heard of, and what they observed."""

    def __init__(self) -> None:
        self._stations: dict[str, _Station] = {}

    def observe(self, message: Weather) -> None:
        """Take an observation; one of the same time replaces the one before."""
        station = self._stations.setdefault(
            message.station_id,
            _Station(np.radians(message.latitude_deg), np.radians(message.longitude_deg), [], []),
        )
        place = int(np.searchsorted(station.times, message.time_s))
        earlier = station.times[place - 1] if place else message.time_s - _HOUR
        row = _observation(message, max(60.0, message.time_s - earlier))
        if place < len(station.times) and station.times[place] == message.time_s:
            station.rows[place] = row
            return
        station.times.insert(place, message.time_s)
        station.rows.insert(place, row)
        del station.times[:-KEPT], station.rows[:-KEPT]

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
            east = (longitude - station.longitude) * np.cos(station.latitude)
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


def _observation(message: Weather, since: float) -> list[float]:
    """Return an observation in SI, in the order of `Sky`."""

    def known(value: float | None) -> float:
        return np.nan if value is None else value

    wind = known(message.wind_speed_kmh) * KMH
    source = np.radians(known(message.wind_from_deg))
    return [
        known(message.temperature_c) + ZERO_CELSIUS,
        wind,
        float(wind * np.cos(source)),
        float(wind * np.sin(source)),
        known(message.precipitation_mm) * 1e-3 / since,
        known(message.pressure_hpa) * 100.0,
        known(message.humidity_pct) * 0.01,
        known(message.solar_w_m2),
    ]
