"""Learn how the outside temperature changes with the hour of the day.

A shift that begins in the cold of the morning ends in the mild afternoon. The temperature ahead is the present one and
the mean change from this hour of the day to those ahead, which earlier days taught. A fleet drives in one place, so
that the hour is that of UTC.
"""

from typing import Any, Final

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.forecast.conformal import DAY_MEMORY
from socast.core.totals.day_sums import DaySums

HOURS: Final = 24
"""Number of hours of a day."""
PRIOR_DAYS: Final = 2.0
"""Number of days whose weight the prior has, by which the temperature does not change."""
STEP: Final = 3000.0, 7200.0
"""Shortest and longest time between two temperatures whose change counts. Over a shorter time, the change is that from
street to street, or the step to the next hourly observation of a station. [s]"""
WHOLE_OBSERVATION: Final = 9000.0
"""Time for which an hour must be observed to count as a whole. [s]"""
LARGEST_RATE: Final = 6.0
"""A temperature that changes faster is that of another place, such as a garage. [K/h]"""


class DailyCycle:
    """Learn the mean rate of change of the outside temperature in each hour of the day.

    Attributes
    ----------
    today : DaySums
        By hour, since the last daily update: change of the temperature [K], and the time of it [s].
    """

    def __init__(self) -> None:
        self.today = DaySums(change=(HOURS,), seconds=(HOURS,))
        self._rates, self._days = np.zeros(HOURS), np.zeros(HOURS)  # weighted sum of the days' rates [K/h], weights
        self._compute_change()

    def add_shift(self, time: Floats, celsius: Floats) -> None:
        """Add the outside temperatures of a shift, for the next daily update."""
        later = np.searchsorted(time, time + STEP[0])
        first, later = np.flatnonzero(later < len(time)), later[later < len(time)]
        step, change = time[later] - time[first], celsius[later] - celsius[first]
        usable = (step >= STEP[0]) & (step <= STEP[1]) & (np.abs(change) * 3600.0 <= LARGEST_RATE * step)
        hour = ((time[first] + 0.5 * step) % SECONDS_PER_DAY / 3600.0).astype(np.int64)[usable]
        self.today.add("change", np.bincount(hour, change[usable], HOURS))
        self.today.add("seconds", np.bincount(hour, step[usable], HOURS))

    def apply_daily_update(self) -> None:
        """Let the shifts since the last daily update take effect."""
        change, seconds = self.today.get("change"), self.today.get("seconds")
        if seconds.any():
            weight = np.minimum(seconds / WHOLE_OBSERVATION, 1.0)
            rate = 3600.0 * np.divide(change, seconds, out=np.zeros(HOURS), where=seconds > 0.0)
            self._rates = DAY_MEMORY * self._rates + weight * rate
            self._days = DAY_MEMORY * self._days + weight
        self.today.clear()
        self._compute_change()

    def _compute_change(self) -> None:
        """Compute the change since midnight at each full hour."""
        rate = self._rates / (self._days + PRIOR_DAYS)
        smooth = 0.25 * np.roll(rate, 1) + 0.5 * rate + 0.25 * np.roll(rate, -1)
        self._since_midnight = np.append(0.0, np.cumsum(smooth))

    def get_level(self, time: Floats) -> Floats:
        """Return the usual outside temperature at times, but for a constant. [K]"""
        days = np.floor(time / SECONDS_PER_DAY)
        hour = (time - SECONDS_PER_DAY * days) / 3600.0
        within = np.interp(hour, np.arange(HOURS + 1.0), self._since_midnight)
        return np.asarray(days * self._since_midnight[-1] + within)

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self.today.dump(), [self._rates.tolist(), self._days.tolist()]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        today, rates = state
        self.today.load(today)
        self._rates, self._days = map(np.array, rates)
        self._compute_change()
