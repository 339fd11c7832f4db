"""When a night falls in a fleet's stream: by the stamps of its samples, as core never looks at a clock.

Loggers' clocks may err, by hours or by years, and send many samples at once. So the day is what most of the cars say
that were heard lately, each by its two newest stamps, whatever the number of its samples: a single glitch says nothing.
The next day begins when more of them are in it than are still in the present one; clocks that are days away from both
are not asked. Only where more than half of all that were heard in a longer while are further ahead, or days behind, the
calendar itself was wrong, or the fleet rested, and the day becomes the one that more than half have come to, or are
still in.
"""

from math import isnan
from typing import Any, Final

import numpy as np
from numba import njit

from core.batch import Floats, Ints, grown
from core.wire.messages import Wire

DAY: Final = 86400.0
"""[s]"""
BACK: Final = 2.0 * DAY
"""Stamps so much before the coming night are of another calendar. [s]"""
LATELY: Final = 100, 1000
"""Samples of the fleet within which a car counts as heard lately, for the next day and for any other one.

The fewer, the sooner cars that rest are not asked any more; the more, the longer may be what one sends at once.
"""
TODAY, NEXT, AHEAD, BEHIND, NOTHING = range(5)
"""What a car says of the day."""


class Night(Wire):
    """Stands for a night among the messages that are no samples; it does not travel."""


class Calendar:
    """The coming night, UTC."""

    def __init__(self) -> None:
        self._tomorrow = -np.inf
        self._place = 0  # of the next sample among the newest
        self._newest = np.full(LATELY[1], -1)  # lanes of the newest samples
        self._stamps = np.zeros((0, 2))  # the two newest of each lane [s]
        self._heard = np.zeros((0, 2), np.int64)  # samples of each lane among the newest, of `LATELY`
        self._said = np.zeros((2, 5), np.int64)  # lanes heard lately, by what they say

    def nights(self, lane: Ints, stamp: Floats) -> list[int]:
        """Return the rows before which a night falls.

        Parameters
        ----------
        lane : (n,) int
        stamp : (n,) float
            Of samples in the order of their arrival. [s]

        Examples
        --------
        >>> calendar = Calendar()
        >>> calendar.nights(np.zeros(3, np.int64), np.array([100.0, 103.0, 106.0]))
        [1]
        >>> calendar.nights(np.zeros(5, np.int64), np.array([9e9, 109.0, 86398.0, 86401.0, 86404.0]))
        [4]
        """
        lanes = int(lane.max(initial=-1)) + 1
        self._stamps, self._heard = grown(self._stamps, lanes, np.nan), grown(self._heard, lanes)
        found: list[int] = []
        row = -1
        while (row := self._listen(lane, stamp, row + 1)) < len(lane):
            self._turn()
            found.append(row)
        self._place = (self._place + len(lane)) % LATELY[1]
        return found

    def silence(self, lane: int) -> float:
        """Return for how long a car has been silent, by what most of those say that were heard lately; else 0. [s]

        Examples
        --------
        >>> calendar = Calendar()
        >>> calendar.nights(np.zeros(2, np.int64), np.array([100.0, 103.0]))
        [1]
        >>> calendar.nights(np.ones(2000, np.int64), np.arange(2000.0))
        []
        >>> calendar.silence(0), calendar.silence(1)
        (1895.0, 0.0)
        """
        if self._heard[lane, 1] > 0:  # its own clock may be hours behind
            return 0.0
        now = np.sort(self._heard_lately().min(axis=1))
        return float(now[(len(now) - 1) // 2] - np.nanmax(self._stamps[lane])) if len(now) else 0.0

    def _heard_lately(self) -> Floats:
        """Return the two newest stamps of each car that was heard lately, (cars, 2). [s]"""
        return self._stamps[(self._heard[:, 1] > 0) & ~np.isnan(self._stamps).any(axis=1)]

    def _listen(self, lane: Ints, stamp: Floats, start: int) -> int:
        """Take samples from a row on; return the row at which another day has come, or how many rows there are."""
        lists = self._newest, self._stamps, self._heard, self._said
        return int(_listen(lane, stamp, start, self._place, self._tomorrow, *lists))

    def _turn(self) -> None:
        """Begin the day that has come."""
        if self._said[0, NEXT] > self._said[0, TODAY]:
            self._tomorrow += DAY
        else:
            stamps = self._heard_lately()
            ahead = self._said[1, AHEAD] > self._said[1, BEHIND]
            most = -np.sort(-stamps.min(axis=1)) if ahead else np.sort(stamps.max(axis=1))
            self._tomorrow = float((np.floor(most[len(most) // 2] / DAY) + 1.0) * DAY)
        self._count()

    def _count(self) -> None:
        """Count what lanes say, from what is known of them."""
        self._said[:] = 0
        lanes = np.flatnonzero(self._heard[:, 1])
        for (first, second), heard in zip(self._stamps[lanes].tolist(), self._heard[lanes] > 0, strict=True):
            self._said[:, _says(first, second, self._tomorrow)] += heard

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self._tomorrow, self._place, self._newest.tobytes(), self._stamps.tobytes()

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        self._tomorrow, self._place, newest, stamps = state
        self._newest = np.frombuffer(newest, np.int64).copy()
        self._stamps = np.frombuffer(stamps).reshape(-1, 2).copy()
        self._heard = np.zeros((len(self._stamps), 2), np.int64)
        for i, samples in enumerate(LATELY):
            lanes = np.roll(self._newest, -self._place)[-samples:]
            self._heard[:, i] = np.bincount(lanes[lanes >= 0], minlength=len(self._stamps))
        self._count()


@njit(cache=True)
def _listen(
    lane: Ints,
    stamp: Floats,
    start: int,
    place: int,
    tomorrow: float,
    newest: Ints,
    stamps: Floats,
    heard: Ints,
    said: Ints,
) -> int:
    """Take samples until another day has come."""
    for row in range(start, len(lane)):
        mine, at = lane[row], (place + row) % LATELY[1]
        before = _says(stamps[mine, 0], stamps[mine, 1], tomorrow)
        stamps[mine, 0], stamps[mine, 1] = stamps[mine, 1], stamp[row]
        now = _says(stamps[mine, 0], stamps[mine, 1], tomorrow)
        for i in range(2):
            if heard[mine, i] > 0:
                said[i, before] -= 1
            said[i, now] += 1
            heard[mine, i] += 1
            gone = newest[(at - LATELY[i]) % LATELY[1]]
            if gone >= 0:
                heard[gone, i] -= 1
                if heard[gone, i] == 0:
                    said[i, _says(stamps[gone, 0], stamps[gone, 1], tomorrow)] -= 1
        newest[at] = mine
        if said[0, NEXT] > said[0, TODAY] or 2 * max(said[1, AHEAD], said[1, BEHIND]) > said[1, :NOTHING].sum():
            return row
    return len(lane)


@njit(cache=True)
def _says(first: float, second: float, tomorrow: float) -> int:
    """Return what a car's two newest stamps say of the day; those that disagree, that it is the present one."""
    if isnan(first) or isnan(second):
        return NOTHING
    if first >= tomorrow + DAY and second >= tomorrow + DAY:
        return AHEAD
    if first >= tomorrow and second >= tomorrow:
        return NEXT
    return BEHIND if first < tomorrow - BACK and second < tomorrow - BACK else TODAY
