"""When a night falls in a fleet's stream: by the stamps of its samples, as core never looks at a clock.

Loggers' clocks may err. So a new day begins with the second of two samples in a row that are stamped in it, and a
calendar that a wrong clock has put forward is put back by two in a row that are days before it.
"""

from typing import Any, Final

import numpy as np

from core.batch import Floats
from core.codec import Wire

DAY: Final = 86400.0
"""[s]"""
BACK: Final = 2.0 * DAY
"""Stamps so much before the coming night put the calendar back. [s]"""


class Night(Wire):
    """Stands for a night among the messages that are no samples; it does not travel."""


class Calendar:
    """The coming night, UTC."""

    def __init__(self) -> None:
        self._tomorrow = -np.inf
        self._last = np.nan

    def nights(self, stamp: Floats) -> list[int]:
        """Return the rows before which a night falls.

        Parameters
        ----------
        stamp : (n,) float
            Of samples in the order of their arrival. [s]

        Examples
        --------
        >>> calendar = Calendar()
        >>> calendar.nights(np.array([100.0, 103.0, 106.0]))
        [1]
        >>> calendar.nights(np.array([9e9, 109.0, 86398.0, 86401.0, 86404.0]))
        [4]
        """
        if not len(stamp):
            return []
        before = np.r_[self._last, stamp[:-1]]
        low, high = np.minimum(before, stamp), np.maximum(before, stamp)
        self._last = float(stamp[-1])
        found: list[int] = []
        row = 0
        while True:
            ahead = (low[row:] >= self._tomorrow) | (high[row:] < self._tomorrow - BACK)
            if not ahead.any():
                return found
            row += int(np.argmax(ahead))
            today = low[row] if low[row] >= self._tomorrow else high[row]
            self._tomorrow = float((np.floor(today / DAY) + 1.0) * DAY)
            found.append(row)
            row += 1

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self._tomorrow, self._last

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        self._tomorrow, self._last = state
