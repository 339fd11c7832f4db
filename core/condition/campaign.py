"""Say what was done to which cars on which days, so that the days before and after can be compared."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Ints

LEAST_DAYS: Final = 5
"""Least number of days with measurements before and after."""
SIZES: Final = (0.01, 0.03, 0.06)
"""Changes of which it is said how long they take to be seen. [1]"""

OUT, BEFORE, AFTER = 0, 1, 2
"""States of a day: left out, before the campaign or off, and after its begin or on."""
States = NDArray[np.int8]


class CampaignSpan(NamedTuple):
    """Hold days, with first and last ordinal, on which a car had what is judged."""

    vehicle_id: str
    begin: int
    end: int


class Campaign(NamedTuple):
    """Say what was done to which cars, and when.

    Parameters
    ----------
    at : int, optional
        Ordinal of the date on which it was done, which is left out. Without one, the days of `spans` are on.
    until : int, optional
        Ordinal of the last date that counts.
    days : int, optional
        Number of days before and after that count. [d]
    sizes : tuple of float
        Changes of which it is said how long they take to be seen. [1]
    """

    vehicles: tuple[str, ...]
    at: int | None = None
    until: int | None = None
    days: int | None = None
    spans: tuple[CampaignSpan, ...] = ()
    what: str = ""
    sizes: tuple[float, ...] = SIZES

    def classify(self, vehicle_id: str, dates: Ints) -> States:
        """Return the state of each date for a car."""
        if self.at is None:
            on = np.zeros(len(dates), np.bool_)
            for span in self.spans:
                if span.vehicle_id == vehicle_id:
                    on |= (dates >= span.begin) & (dates <= span.end)
            return np.where(on, AFTER, BEFORE).astype(np.int8)
        state = np.where(dates < self.at, BEFORE, np.where(dates > self.at, AFTER, OUT)).astype(np.int8)
        if self.days is not None:
            state[np.abs(dates - self.at) > self.days] = OUT
        if self.until is not None:
            state[dates > self.until] = OUT
        return state
