"""Keep the weather forecasts of stations, and expect the outside temperature of the time ahead from them.

Only the change that a station forecasts counts: the temperature ahead is the one that the car measures now and the
change from now on. So a constant difference between a station and the streets has no effect. A fleet drives in one
place, so that the mean change of all stations applies to every car. Before the first and after the last forecast
temperature, and without any, the temperature follows its usual course of the day
(`socast.core.forecast.learning.daily_cycle`).
"""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints, replace_nan
from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.learning.daily_cycle import HOURS, DailyCycle
from socast.core.signals.weather import LATEST, PLAUSIBLE
from socast.core.wire.messages import Weather

MOST_STATIONS: Final = 64
"""Number of stations of which forecasts are kept."""
MOST_TIMES: Final = 400
"""Number of times ahead that are kept of a station, more than every hour of two weeks."""
LARGEST_LEAD: Final = 6 * 3600.0
"""Longest time before the first forecast temperature for which a forecast applies. [s]"""
_QUADRATURE: Final = (np.arange(5) + 0.5) / 5.0
"""Shares of the time ahead at which the temperature is averaged."""


_OfStation = dict[float, tuple[float, float]]
"""Forecasts of a station: time -> when it was issued [s], and temperature [K]."""
_Course = Floats
"""Times and temperatures in order of time, (2, n). [s], [K]"""


class ForecastArrival(NamedTuple):
    """Hold a weather forecast and its place in the batch."""

    at: int
    forecast: Weather


class WeatherForecasts:
    """Keep the newest forecast temperature of each station and time."""

    def __init__(self) -> None:
        self._temperatures: dict[str, _OfStation] = {}
        self._names: set[str] = set()
        self._courses: list[_Course] | None = None  # temperatures of each station in order of time

    def admit(self, forecast: Weather) -> str | None:
        """Keep a place for the station of a forecast, or return why the forecast cannot be used."""
        low, high = PLAUSIBLE["temperature_c"]
        known = forecast.temperature_c is not None and low <= forecast.temperature_c <= high
        if not (known and 0.0 <= float(forecast.issued_s or 0.0) <= LATEST and 0.0 <= forecast.time_s <= LATEST):
            return "out_of_range"
        if forecast.station_id not in self._names and len(self._names) >= MOST_STATIONS:
            return "too_many_stations"
        self._names.add(forecast.station_id)
        return None

    def add(self, forecast: Weather) -> None:
        """Add a forecast that was admitted; it replaces one of the same station and time that was issued before."""
        course = self._temperatures.setdefault(forecast.station_id, {})
        issued, before = float(forecast.issued_s or 0.0), course.get(forecast.time_s)
        if before is None or before[0] <= issued:
            course[forecast.time_s] = issued, float(forecast.temperature_c or 0.0) + ZERO_CELSIUS
            if len(course) > MOST_TIMES:
                del course[min(course)]
            self._courses = None

    def forget_before(self, time: float) -> None:
        """Forget temperatures that were forecast for times before a time [s], and stations without any other."""
        left = {
            name: {at: of for at, of in course.items() if at >= time} for name, course in self._temperatures.items()
        }
        self._temperatures = {name: course for name, course in left.items() if course}
        self._names, self._courses = set(self._temperatures), None

    def expect_between(
        self,
        at: Ints,
        arrivals: Sequence[ForecastArrival],
        ambient: Floats,
        time: Floats,
        end: Floats,
        cycle: DailyCycle,
    ) -> Floats:
        """Return the mean outside temperature over the time ahead of rows, while forecasts arrive between them."""
        if not arrivals:
            return self.expect_ambient(ambient, time, end, cycle)
        before = np.searchsorted([each.at for each in arrivals], at)
        mean = np.empty(len(at))
        for number in range(len(arrivals) + 1):
            rows = np.flatnonzero(before == number)
            if len(rows):
                mean[rows] = self.expect_ambient(ambient[rows], time[rows], end[rows], cycle)
            if number < len(arrivals):
                self.add(arrivals[number].forecast)
        return mean

    def expect_ambient(self, ambient: Floats, time: Floats, end: Floats, cycle: DailyCycle) -> Floats:
        """Return the mean outside temperature over the time ahead."""
        ahead = np.clip(replace_nan(end - time), 0.0, 3600.0 * HOURS)
        if self._courses is None:
            sorted_by_time = [sorted(course.items()) for _, course in sorted(self._temperatures.items())]
            self._courses = [np.array([(at, ambient) for at, (_, ambient) in each]).T for each in sorted_by_time]
        change, stations = np.zeros(len(time)), np.zeros(len(time))
        for course in self._courses:
            first, last = course[0, [0, -1]]
            applies = (first - LARGEST_LEAD <= time) & (time <= last)
            change += np.where(applies, _compute_mean_change(course, time, ahead, cycle), 0.0)
            stations += applies
        usual = _compute_mean_change(None, time, ahead, cycle)
        forecast = np.divide(change, stations, out=usual.copy(), where=stations > 0.0)
        return np.asarray(ambient + np.where(stations > 0.0, forecast, usual))

    def dump(self) -> Any:
        """Return the state as plain values."""
        return [[name, [[at, *of] for at, of in course.items()]] for name, course in self._temperatures.items()]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self._temperatures = {name: {at: (issued, ambient) for at, issued, ambient in course} for name, course in state}
        self._names, self._courses = set(self._temperatures), None


def _compute_mean_change(course: _Course | None, time: Floats, ahead: Floats, cycle: DailyCycle) -> Floats:
    """Return the mean change of the temperature over a time ahead [s], by a course or the usual course of the day."""
    mean = np.zeros(len(time))
    for share in _QUADRATURE.tolist():
        mean += _interpolate(course, time + share * ahead, cycle) / len(_QUADRATURE)
    return np.asarray(mean - _interpolate(course, time, cycle))


def _interpolate(course: _Course | None, time: Floats, cycle: DailyCycle) -> Floats:
    """Return the temperature at times but for a constant; outside a course, it follows the usual course of the day."""
    if course is None:
        return cycle.get_level(time)
    times, ambient = course
    inside = np.clip(time, times[0], times[-1])
    return np.asarray(np.interp(inside, times, ambient) + cycle.get_level(time) - cycle.get_level(inside))
