"""The clock that stamps messages with their time of receipt, and recovers when the system clock was wrong.

Times of receipt must not decrease, and they must be Unix time. The system clock alone gives neither: an operator or a
time service may set it forward and back. The clock here advances with monotonic time and corrects its offset:

- A deviation of the system clock of up to `STEP_S` is corrected gradually, at `SLEW` of the speed of time. The time of
  receipt never decreases.
- A larger deviation has no effect until it has lasted for `SETTLE_S`. The clock then takes over the system time in one
  step, which is the only case in which it may go back. A jump of the system clock forward and back within that time is
  not noticed. A recorder begins another file where the time of receipt went back.
"""

import time
from collections.abc import Callable
from typing import Final

STEP_S: Final = 10.0
"""Largest deviation that is corrected gradually. [s]"""
SLEW: Final = 0.1
"""Speed of the gradual correction. [s/s]"""
SETTLE_S: Final = 60.0
"""Time for which a larger deviation must last before it is believed. [s]"""

_SECOND: Final = 1_000_000_000


class ReceiptClock:
    """Tell the time of receipt.

    Parameters
    ----------
    system_ns, monotonic_ns : callable
        Functions that return Unix time and monotonic time. [ns]

    Attributes
    ----------
    steps : int
        Number of times that the clock took over the system time in one step.

    Examples
    --------
    >>> clock = ReceiptClock(system_ns=lambda: 5_000, monotonic_ns=lambda: 7)
    >>> clock.read_ns()
    5000
    """

    def __init__(
        self, system_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.steps = 0
        self._system_ns, self._monotonic_ns = system_ns, monotonic_ns
        self._last_ns = monotonic_ns()
        self._offset_ns = system_ns() - self._last_ns
        self._deviating_ns: int | None = None  # deviation that waits to be believed
        self._since_ns = 0  # monotonic time at which it was first seen

    def read_ns(self) -> int:
        """Return the present time of receipt, in Unix time. [ns]"""
        now = self._monotonic_ns()
        deviation = self._system_ns() - now - self._offset_ns
        if abs(deviation) <= STEP_S * _SECOND:
            most = int((now - self._last_ns) * SLEW)
            self._offset_ns += min(most, max(-most, deviation))
            self._deviating_ns = None
        else:
            self._wait_or_step(deviation, now)
        self._last_ns = now
        return now + self._offset_ns

    def _wait_or_step(self, deviation: int, now: int) -> None:
        """Take over the system time once a deviation has lasted; another deviation waits anew."""
        if self._deviating_ns is None or abs(deviation - self._deviating_ns) > STEP_S * _SECOND:
            self._deviating_ns, self._since_ns = deviation, now
        elif now - self._since_ns >= SETTLE_S * _SECOND:
            self._offset_ns += deviation
            self._deviating_ns = None
            self.steps += 1
