"""Keep the observations of weather stations, and return the weather at the place and time of a car.

The weather of a car is the latest observation of the nearest station that is not later than the sample of the car.

Each observation also holds the rain and the snow that earlier precipitation left on the road. Both depths h follow
h' = p - h / τ, with precipitation p and time constant τ.
"""

from collections.abc import Sequence
from math import inf, isnan
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints, grown
from socast.core.columns import KMH, ZERO_CELSIUS
from socast.core.signals.nearest_station import find_nearest_stations, take_observations
from socast.core.wire.messages import Weather

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


_WATER, _SNOW = _Observation._fields.index("water"), _Observation._fields.index("snow")
PLAUSIBLE: Final = {
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
    """Keep every known weather station with its latest observations.

    An array has a row for each station, in the order in which the stations became known.
    """

    def __init__(self, most: float = inf) -> None:
        self._most = most
        self._of: dict[str, int] = {}
        self._accepted: set[str] = set()  # these, and those whose first observation comes soon
        self._times = np.zeros((0, KEPT + 1))
        self._counts = np.zeros(0, np.int64)
        self._values = np.zeros((0, KEPT + 1, len(Sky._fields)))
        self._places = np.zeros((0, 3))  # latitude, longitude, and cosine of the latitude
        self._by_latitude: tuple[Ints, Floats] | None = None

    def __len__(self) -> int:
        return len(self._of)

    def admit(self, message: Weather) -> str | None:
        """Keep a place for the station of an observation, or return why the observation cannot be used.

        Returns
        -------
        str or None
            `out_of_range` if the position is not on Earth or the time is out of range, or `too_many_stations`.
        """
        place = np.radians(message.latitude_deg), np.radians(message.longitude_deg)
        if not (abs(place[0]) <= np.pi / 2 and abs(place[1]) <= np.pi and 0.0 <= message.time_s <= LATEST):
            return "out_of_range"
        if message.station_id not in self._accepted and len(self._accepted) >= self._most:
            return "too_many_stations"
        self._accepted.add(message.station_id)
        return None

    def observe(self, message: Weather) -> None:
        """Take an observation that was admitted.

        An observation replaces an earlier one of the same station and time. The newest message defines the position of
        a station that moves.
        """
        station = self._find_row(message.station_id)
        self._move(station, float(np.radians(message.latitude_deg)), float(np.radians(message.longitude_deg)))
        count, times, rows = int(self._counts[station]), self._times[station], self._values[station]
        at = int(np.searchsorted(times[:count], message.time_s))
        if at == 0 and count == KEPT:  # it is older than all observations that are kept
            return
        earlier = float(times[at - 1]) if at else message.time_s - _HOUR
        if at == count or times[at] != message.time_s:
            times[at + 1 : count + 1], rows[at + 1 : count + 1] = times[at:count].copy(), rows[at:count].copy()
            count += 1
        times[at], rows[at] = message.time_s, _observation(message, max(60.0, message.time_s - earlier))
        _lay(rows[:count], at)
        if count > KEPT:
            times[:KEPT], rows[:KEPT] = times[1:].copy(), rows[1:].copy()
        self._counts[station] = min(count, KEPT)

    def sky(self, time: Floats, latitude: Floats, longitude: Floats) -> Sky:
        """Return the weather at positions and times.

        Parameters
        ----------
        latitude, longitude : (n,) float
            Position. Where it is unknown (NaN), the first station provides the weather. [rad]
        """
        count = len(self._of)
        if not count:
            return Sky(*np.broadcast_to(np.nan, (len(Sky._fields), len(time))))
        values = np.full((len(Sky._fields), len(time)), np.nan)
        if self._by_latitude is None:
            order = np.argsort(self._places[:count, 0], kind="stable")
            self._by_latitude = order, self._places[order, 0]
        nearest = np.empty(len(time), np.int64)
        first = self._times[:count, 0]
        find_nearest_stations(time, latitude, longitude, *self._by_latitude, self._places, first, nearest)
        take_observations(time, nearest, self._times, self._counts, self._values, values)
        return Sky(*values)

    def sky_between(
        self, time: Floats, latitude: Floats, longitude: Floats, observations: Sequence[tuple[int, Weather]]
    ) -> Sky:
        """Return the weather at rows, while observations arrive between them.

        Parameters
        ----------
        observations : sequence of (row, Weather)
            Observations in the order of their arrival, each with the row before which it came.
        """
        if not observations:
            return self.sky(time, latitude, longitude)
        parts, start = [], 0
        for row, message in observations:
            if row > start:
                parts.append(self.sky(time[start:row], latitude[start:row], longitude[start:row]))
                start = row
            self.observe(message)
        parts.append(self.sky(time[start:], latitude[start:], longitude[start:]))
        return Sky(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def forget_silent(self, time: float) -> None:
        """Forget the stations whose newest observation is older than a time. [Unix s]"""
        count = len(self._of)
        newest = self._times[np.arange(count), self._counts[:count] - 1]
        left = np.flatnonzero(newest >= time)
        if len(left) < count:
            names = list(self._of)
            self._of = {names[old]: new for new, old in enumerate(left.tolist())}
            self._times, self._counts, self._values = self._times[left], self._counts[left], self._values[left]
            self._places, self._by_latitude = self._places[left], None
            self._accepted = set(self._of)

    def _find_row(self, name: str) -> int:
        """Return the row of a station, a new one for a station not known so far."""
        station = self._of.setdefault(name, len(self._of))
        self._accepted.add(name)
        if len(self._counts) < len(self._of):
            self._times, self._counts = grown(self._times, station + 1), grown(self._counts, station + 1)
            self._values, self._places = grown(self._values, station + 1), grown(self._places, station + 1)
        return station

    def _move(self, station: int, latitude: float, longitude: float) -> None:
        """Set the position of a station."""
        place = latitude, longitude, float(np.cos(latitude))
        if self._counts[station] == 0 or place != tuple(self._places[station].tolist()):
            self._places[station], self._by_latitude = place, None

    def dump(self) -> Any:
        """Return the state as plain lists, for a snapshot."""
        rows = ((name, station, int(self._counts[station])) for name, station in self._of.items())
        return [
            [
                name,
                self._times[station, :count].tolist(),
                self._values[station, :count].tolist(),
                *self._places[station, :2].tolist(),
            ]
            for name, station, count in rows
        ]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self.__init__(self._most)  # type: ignore[misc]
        for name, times, rows, latitude, longitude in state:
            station = self._find_row(name)
            self._move(station, latitude, longitude)
            self._times[station, : len(times)], self._counts[station] = times, len(times)
            self._values[station, : len(times)] = rows


def held(depth: Any, rate: Any, age: Any, memory: Any) -> Any:
    """Return the depth on the road after a time of constant precipitation.

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
    """Return the depth of rain water on a road after a time of constant weather."""
    return held(water, np.where(ambient < FREEZING, 0.0, np.nan_to_num(precipitation)), age, DRYING)


def snow_left(snow: Any, ambient: Any, precipitation: Any, age: Any) -> Any:
    """Return the depth of snow on a road, as melted water, after a time of constant weather.

    Parameters
    ----------
    ambient : (n,) float or float
        Air temperature; at `FREEZING` and above no snow falls, and snow leaves the road faster. [K]
    precipitation : (n,) float or float
        Precipitation as water, NaN for none. [m/s]
    """
    frost = ambient < FREEZING
    return held(snow, np.where(frost, np.nan_to_num(precipitation), 0.0), age, np.where(frost, CLEARING, THAWING))


def _lay(rows: Floats, first: int) -> None:
    """Compute the depths on the road from an observation on; precipitation of an observation fell before it.

    The depths are those of `water_left` and `snow_left`, which are slow for single values.
    """
    for at in range(first, len(rows)):
        row = _Observation(*rows[at].tolist())
        before = _Observation(*rows[at - 1].tolist()) if at else None
        age = row.observed - before.observed if before else _HOUR
        water, snow = (before.water, before.snow) if before else (0.0, 0.0)
        is_cold, fallen = row.ambient < FREEZING, 0.0 if isnan(row.precipitation) else row.precipitation
        rows[at, _WATER] = held(water, 0.0 if is_cold else fallen, age, DRYING)
        rows[at, _SNOW] = held(snow, fallen if is_cold else 0.0, age, CLEARING if is_cold else THAWING)


def _observation(message: Weather, since: float) -> _Observation:
    """Return an observation in SI units, with zero depths on the road."""
    known = {name: _plausible(message, name) for name in PLAUSIBLE}
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
    value, (low, high) = getattr(message, name), PLAUSIBLE[name]
    return float(value) if value is not None and low <= value <= high else float("nan")
