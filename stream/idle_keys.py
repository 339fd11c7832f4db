"""Keys in the order of their last use, so that what belongs to a forgotten car can be given up."""

import time
from collections.abc import Callable, Iterable
from typing import Final

from socast.core.columns import SECONDS_PER_DAY
from socast.core.settings import Limits

IDLE_S: Final = Limits().silent_days * SECONDS_PER_DAY
"""Default time after which an unused key is given up: that after which a silent car is forgotten. [s]"""


class IdleKeys:
    """Remember when keys were last used, and return those that were not used for long.

    Parameters
    ----------
    idle_s : float
        Time after which an unused key is given up. [s]
    clock : callable
        Function that returns monotonic time. [s]
    """

    def __init__(self, idle_s: float = IDLE_S, clock: Callable[[], float] = time.monotonic) -> None:
        self._idle_s, self._clock = idle_s, clock
        self._used_s: dict[str, float] = {}  # the key that was used last is the last one

    def use(self, keys: Iterable[str]) -> list[str]:
        """Note that keys are used now; forget and return the keys that were not used for longer than the limit."""
        now, used_s = self._clock(), self._used_s
        for key in keys:
            used_s.pop(key, None)
            used_s[key] = now
        idle: list[str] = []
        for key, moment in used_s.items():
            if now - moment <= self._idle_s:
                break
            idle.append(key)
        for key in idle:
            del used_s[key]
        return idle
