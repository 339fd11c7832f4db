"""Turn weather columns of a car's rows into the observations of a station that moves with the car."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from socast.core.wire.messages import Message, Weather
from socast.tools.importers.drive import make_message
from socast.tools.importers.table.units import OF_WEATHER

BETWEEN: Final = 300.0
"""Time between two observations of a car, which hold the means over it; a longer gap begins anew. [s]"""
_HOUR: Final = 3600.0
_NAMES: Final = ("latitude_deg", "longitude_deg", "ambient_c", *OF_WEATHER)
DECIMALS: Final = 3
"""Decimal places of an observation."""


class RowWeather:
    """Make observations of the weather columns of rows, with the position of the car.

    Parameters
    ----------
    fields : collection of str
        Fields of the map.

    Attributes
    ----------
    is_sent : bool
        Whether the observations are sent.

    Notes
    -----
    The first observation of a car is its first row; each later one is the mean over the rows since the last, of the
    wind as a vector. Precipitation in rows is a rate, the amount of an hour, as weather services state it.
    """

    def __init__(self, fields: Mapping[str, object]) -> None:
        self.is_sent = True
        self._is_given = any(name in fields for name in OF_WEATHER)
        self._last: dict[int, float] = {}
        self._newest: dict[int, float] = {}
        self._places: dict[int, tuple[float, float]] = {}
        self._waiting: dict[int, list[dict[str, float]]] = {}

    def observe(self, rows: np.ndarray, vehicles: list[str]) -> dict[int, Message]:
        """Return the observations before rows, by the place of the row."""
        if not (self._is_given and self.is_sent):
            return {}
        names = [name for name in _NAMES if name in (rows.dtype.names or ())]
        known = np.logical_or.reduce([np.isfinite(rows[name]) for name in names if name in OF_WEATHER])
        made = {}
        for at in np.flatnonzero(known).tolist():
            row = {name: float(rows[name][at]) for name in names}
            if (message := self._take(int(rows["vehicle"][at]), float(rows["time"][at]), row, vehicles)) is not None:
                made[at] = message
        return made

    def _take(self, car: int, time: float, row: dict[str, float], vehicles: list[str]) -> Message | None:
        """Take a row, and return the observation that it completes."""
        place = row.get("latitude_deg", 0.0), row.get("longitude_deg", 0.0)
        if np.isfinite(place).all():
            self._places[car] = place
        waiting = self._waiting.setdefault(car, [])
        if time - self._newest.get(car, -np.inf) > BETWEEN:  # means over a gap would be those of another drive
            waiting.clear()
            self._last.pop(car, None)
        self._newest[car] = time
        waiting.append(row)
        since = time - self._last.get(car, -np.inf)
        if since < BETWEEN or car not in self._places:
            return None
        before, self._last[car] = self._last.get(car), time
        values = average_weather(waiting)
        waiting.clear()
        hours = 1.0 if before is None else (time - before) / _HOUR
        if (rate := values.get("precipitation_mm")) is not None:
            values["precipitation_mm"] = round(rate * hours, DECIMALS)
        station, stamp = vehicles[car], round(time, 3)
        return make_message(f"weather/{station}", Weather(station, stamp, *self._places[car], **values))


def average_weather(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the means of the known weather of rows, in the fields of an observation.

    Examples
    --------
    >>> average_weather([{"wind_speed_kmh": 10.0, "wind_from_deg": each} for each in (350.0, 10.0)])
    {'wind_speed_kmh': 9.848, 'wind_from_deg': 0.0}
    """
    columns = {name: np.array([row.get(name, np.nan) for row in rows]) for name in ("ambient_c", *OF_WEATHER)}
    means = {
        name.replace("ambient_c", "temperature_c"): float(np.mean(values[np.isfinite(values)]))
        for name, values in columns.items()
        if np.isfinite(values).any()
    }
    angle, speed = np.radians(columns["wind_from_deg"]), columns["wind_speed_kmh"]
    both = np.isfinite(angle) & np.isfinite(speed)
    if both.any():
        north, east = (float(np.mean((speed * turn(angle))[both])) for turn in (np.cos, np.sin))
        means["wind_speed_kmh"] = float(np.hypot(north, east))
        means["wind_from_deg"] = float(np.degrees(np.arctan2(east, north)) % 360.0)
    elif "wind_from_deg" in means:
        del means["wind_from_deg"]  # a direction without a speed says nothing
    rounded = {name: round(value, DECIMALS) + 0.0 for name, value in means.items()}
    return rounded | {name: rounded[name] % 360.0 for name in ("wind_from_deg",) if name in rounded}
