"""Learn how the outside temperature changes with the hour of the day.

A shift that begins in the cold of the morning ends in the mild afternoon. The temperature ahead is the present one and
the mean change from this hour of the day to those ahead, which earlier days taught. A fleet drives in one place, so
that the hour is that of UTC.
"""

from typing import Any, Final

import numpy as np

from core.batch import Floats
from core.columns import SECONDS_PER_DAY
from core.forecast.conformal import DAY_MEMORY

HOURS: Final = 24
"""Number of hours of a day."""
PRIOR_DAYS: Final = 2.0
"""Number of days whose weight the prior has, by which the temperature does not change."""
LONGEST_STEP: Final = 3600.0
"""Longest time between two temperatures of which the change counts. [s]"""
WHOLE_OBSERVATION: Final = 900.0
"""Time for which an hour must be observed to count as a whole. [s]"""
LARGEST_RATE: Final = 6.0
"""A temperature that changes faster is that of another place, such as a garage. [K/h]"""


class DailyCycle:
    """Learn the mean rate of change of the outside temperature in each hour of the day."""

    def __init__(self) -> None:
        self._change, self._seconds = np.zeros(HOURS), np.zeros(HOURS)  # of today, of all shifts [K], [s]
        self._rates, self._days = np.zeros(HOURS), np.zeros(HOURS)  # weighted sum of the days' rates [K/h], weights
        self._compute_change()

    def add_shift(self, time: Floats, celsius: Floats) -> None:
        """Add the outside temperatures of a shift, for the next daily update.

        Parameters
        ----------
        time, celsius : (n,) float
            In order of time. [s], [°C]
        """
        step, change = np.diff(time), np.diff(celsius)
        usable = (step > 0.0) & (step <= LONGEST_STEP) & (np.abs(change) * 3600.0 <= LARGEST_RATE * step)
        hour = ((time[:-1] + 0.5 * step) % SECONDS_PER_DAY / 3600.0).astype(np.int64)[usable]
        self._change += np.bincount(hour, change[usable], HOURS)
        self._seconds += np.bincount(hour, step[usable], HOURS)

    def apply_daily_update(self) -> None:
        """Let the shifts since the last daily update take effect."""
        if self._seconds.any():
            weight = np.minimum(self._seconds / WHOLE_OBSERVATION, 1.0)
            rate = 3600.0 * np.divide(self._change, self._seconds, out=np.zeros(HOURS), where=self._seconds > 0.0)
            self._rates = DAY_MEMORY * self._rates + weight * rate
            self._days = DAY_MEMORY * self._days + weight
        self._change, self._seconds = np.zeros(HOURS), np.zeros(HOURS)
        self._compute_change()

    def _compute_change(self) -> None:
        """Compute the change since midnight at each full hour."""
        rate = self._rates / (self._days + PRIOR_DAYS)
        smooth = 0.25 * np.roll(rate, 1) + 0.5 * rate + 0.25 * np.roll(rate, -1)
        self._since_midnight = np.append(0.0, np.cumsum(smooth))

    def get_level(self, time: Floats) -> Floats:
        """Return the usual outside temperature at times, but for a constant. [K]

        Parameters
        ----------
        time : (n,) float
            Unix time. [s]

        Returns
        -------
        (n,) float
        """
        days = np.floor(time / SECONDS_PER_DAY)
        hour = (time - SECONDS_PER_DAY * days) / 3600.0
        within = np.interp(hour, np.arange(HOURS + 1.0), self._since_midnight)
        return np.asarray(days * self._since_midnight[-1] + within)

    def dump(self) -> Any:
        """Return the state as plain values."""
        return [part.tolist() for part in (self._change, self._seconds, self._rates, self._days)]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self._change, self._seconds, self._rates, self._days = (np.array(part) for part in state)
        self._compute_change()
