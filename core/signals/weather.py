"""Keep the observations of weather stations, and return the weather at the place and time of a car.

The weather of a car is the latest observation of the nearest station that is not later than the sample of the car.

Each observation also holds the rain and the snow that earlier precipitation left on the road. Both depths h follow
h' = p - h / τ, with precipitation p and time constant τ.
"""

from typing import Any, Final, NamedTuple

import numpy as np

from core.batch import Floats
from core.columns import KMH, ZERO_CELSIUS
from core.wire.messages import Weather

KEPT: Final = 48
"""Number of observations that are kept of each station."""
LATEST: Final = 4.2e9
"""Latest plausible Unix time of an observation. [s]"""
DRYING: Final = 3600.0
"""Time constant with which rain leaves the road: all but 1/e of it runs off, is splashed away or dries. [s]

Estimated.
"""
CLEARING: Final = 12 * 3600.0
"""Time constant with which snow leaves the road in frost, by ploughs, salt and traffic. [s] Estimated."""
THAWING: Final = 3 * 3600.0
"""Time constant with which snow leaves the road in a thaw. [s] Estimated."""
FREEZING: Final = ZERO_CELSIUS + 1.0
"""Air temperature at which rain and snow are equally frequent, as a mean over the northern hemisphere. [K]

Jennings et al. 2018, Nature Communications 9:1148, DOI 10.1038/s41467-018-03629-7.
"""
_HOUR: Final = 3600.0


class Sky(NamedTuple):
    """Hold the weather at each row, NaN where it is unknown.

    Parameters
    ----------
    ambient : (n,) float
        Air temperature. [K]
    wind_speed : (n,) float
        Wind speed. [m/s]
    wind_north, wind_east : (n,) float
        Components of the wind, positive for wind from the north and from the east. [m/s]
    precipitation : (n,) float
        Precipitation as water. [m/s]
    pressure : (n,) float
        Air pressure at sea level. [Pa]
    humidity : (n,) float
        Relative humidity. [1]
    solar : (n,) float
        Global horizontal irradiance. [W/m^2]
    observed : (n,) float
        Unix time of the observation. [s]
    water, snow : (n,) float
        Depths on the road at the time of the observation, snow as melted water. [m]
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


class _Observation(NamedTuple):
    """Hold one observation, with the fields of `Sky`."""

    ambient: float
    wind_speed: float
    wind_north: float
    wind_east: float
    precipitation: float
    pressure: float
    humidity: float
    solar: float
    observed: float
    water: float = 0.0
    snow: float = 0.0


class _Station(NamedTuple):
    times: list[float]
    rows: list[_Observation]
    latitude: float = np.nan
    longitude: float = np.nan


_PLAUSIBLE: Final = {
    "temperature_c": (-75.0, 65.0),
    "wind_speed_kmh": (0.0, 400.0),
    "wind_from_deg": (0.0, 360.0),
    "precipitation_mm": (0.0, 1000.0),
    "pressure_hpa": (800.0, 1100.0),
    "humidity_pct": (0.0, 100.0),
    "solar_w_m2": (0.0, 1500.0),
}
"""Plausible range of each field of an observation, in its unit. A value outside its range counts as unknown."""


class Stations:
    """Keep every known weather station with its latest observations."""

    def __init__(self) -> None:
        self._stations: dict[str, _Station] = {}

    def observe(self, message: Weather) -> bool:
        """Take an observation, and return whether it is plausible.

        An observation replaces an earlier one of the same station and time. The newest message defines the position of
        a station that moves.

        Parameters
        ----------
        message : Weather
            Observation.

        Returns
        -------
        bool
            False if the position is not on Earth or the time is out of range; the observation is then ignored.
        """
        place = np.radians(message.latitude_deg), np.radians(message.longitude_deg)
        if not (abs(place[0]) <= np.pi / 2 and abs(place[1]) <= np.pi and 0.0 <= message.time_s <= LATEST):
            return False
        times, rows, *_ = self._stations.get(message.station_id, _Station([], []))
        self._stations[message.station_id] = _Station(times, rows, *map(float, place))
        at = int(np.searchsorted(times, message.time_s))
        if at == 0 and len(times) == KEPT:  # it is older than all observations that are kept
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
        """Return the weather at positions and times.

        Parameters
        ----------
        time : (n,) float
            Unix time. [s]
        latitude, longitude : (n,) float
            Position. Where it is unknown (NaN), the first station provides the weather. [rad]

        Returns
        -------
        Sky of n rows
            Weather at each row.
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
        """Return the state as plain lists, for a snapshot."""
        return [[name, *station] for name, station in self._stations.items()]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self._stations = {
            name: _Station(times, [_Observation(*row) for row in rows], *place) for name, times, rows, *place in state
        }


def held(depth: Any, rate: Any, age: Any, memory: Any) -> Any:
    """Return the depth on the road after a time of constant precipitation.

    Parameters
    ----------
    depth : (n,) float or float
        Depth at the start. [m]
    rate : (n,) float or float
        Precipitation. [m/s]
    age : (n,) float or float
        Time since the start. [s]
    memory : (n,) float or float
        Time constant with which the depth decays. [s]

    Returns
    -------
    (n,) float or float
        Depth after that time. [m]

    Notes
    -----
    h' = p - h / τ gives h(t) = h(0) exp(-t / τ) + p τ (1 - exp(-t / τ)), with depth h, precipitation p and time
    constant τ.

    Examples
    --------
    >>> float(held(0.0, 2.0, 1e9, 3.0)), float(held(5.0, 2.0, 0.0, 3.0))
    (6.0, 5.0)
    """
    kept = np.exp(-age / memory)
    return depth * kept + rate * memory * (1.0 - kept)


def water_left(water: Any, ambient: Any, precipitation: Any, age: Any) -> Any:
    """Return the depth of rain water on a road after a time of constant weather.

    Parameters
    ----------
    water : (n,) float or float
        Depth at the start. [m]
    ambient : (n,) float or float
        Air temperature; below `FREEZING` no rain falls. [K]
    precipitation : (n,) float or float
        Precipitation, NaN for none. [m/s]
    age : (n,) float or float
        Time since the start. [s]

    Returns
    -------
    (n,) float or float
        Depth after that time. [m]
    """
    return held(water, np.where(ambient < FREEZING, 0.0, np.nan_to_num(precipitation)), age, DRYING)


def snow_left(snow: Any, ambient: Any, precipitation: Any, age: Any) -> Any:
    """Return the depth of snow on a road, as melted water, after a time of constant weather.

    Parameters
    ----------
    snow : (n,) float or float
        Depth at the start, as melted water. [m]
    ambient : (n,) float or float
        Air temperature; at `FREEZING` and above no snow falls, and snow leaves the road faster. [K]
    precipitation : (n,) float or float
        Precipitation as water, NaN for none. [m/s]
    age : (n,) float or float
        Time since the start. [s]

    Returns
    -------
    (n,) float or float
        Depth after that time, as melted water. [m]
    """
    frost = ambient < FREEZING
    return held(snow, np.where(frost, np.nan_to_num(precipitation), 0.0), age, np.where(frost, CLEARING, THAWING))


def _lay(rows: list[_Observation], first: int) -> None:
    """Compute the depths on the road from an observation on; precipitation of an observation fell before it."""
    for at in range(first, len(rows)):
        row = rows[at]
        before = rows[at - 1] if at else None
        age = row.observed - before.observed if before else _HOUR
        water, snow = (before.water, before.snow) if before else (0.0, 0.0)
        weather = row.ambient, row.precipitation, age
        rows[at] = row._replace(water=float(water_left(water, *weather)), snow=float(snow_left(snow, *weather)))


def _observation(message: Weather, since: float) -> _Observation:
    """Return an observation in SI units, with zero depths on the road."""
    known = {name: _plausible(message, name) for name in _PLAUSIBLE}
    wind, source = known["wind_speed_kmh"] * KMH, np.radians(known["wind_from_deg"])
    return _Observation(
        ambient=known["temperature_c"] + ZERO_CELSIUS,
        wind_speed=wind,
        wind_north=float(wind * np.cos(source)),
        wind_east=float(wind * np.sin(source)),
        precipitation=known["precipitation_mm"] * 1e-3 / since,
        pressure=known["pressure_hpa"] * 100.0,
        humidity=known["humidity_pct"] * 0.01,
        solar=known["solar_w_m2"],
        observed=message.time_s,
    )


def _plausible(message: Weather, name: str) -> float:
    """Return a field of an observation, NaN where it is unknown or implausible."""
    value, (low, high) = getattr(message, name), _PLAUSIBLE[name]
    return float(value) if value is not None and low <= value <= high else float("nan")
