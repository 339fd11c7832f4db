"""Detect when the UTC day of a fleet's stream changes, from the stamps of its samples; core never reads a clock.

The daily update runs when most active cars have passed midnight UTC, so one wrong clock cannot trigger it. Loggers'
clocks may be wrong by hours or years, and may send many samples at once. So each recently active car has one vote,
by its two newest stamps, whatever the number of its samples; a single wrong stamp changes nothing. The next day begins
when more cars are in it than in the present day. Cars whose clocks are days away from both have no vote.

The day also changes when more than half of all cars that were active in a longer window are further ahead, or days
behind: then the day itself was wrong, or the fleet was idle. It becomes the latest day that more than half of them have
reached, or the earliest that more than half are still in. Among the first `WINDOW_SAMPLES`, one day behind is enough,
because the clock that came first may be wrong.
"""

from math import isnan
from operator import itemgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Batch, Floats, Ints, grown
from socast.core.columns import SECONDS_PER_DAY
from socast.core.compiled_cache import njit
from socast.core.wire.decoder import Event
from socast.core.wire.messages import Wire

BEHIND_LIMIT: Final = 2.0 * SECONDS_PER_DAY
"""Stamps that are older than the coming midnight by more than this belong to another day. [s]"""
RECENT_SAMPLES: Final = 100
"""Number of the fleet's newest samples whose cars vote on the next day.

Fewer samples drop idle cars sooner; more samples tolerate a larger burst of a single car."""
WINDOW_SAMPLES: Final = 1000
"""Number of the fleet's newest samples whose cars vote on any other day."""
TODAY, YESTERDAY, NEXT_DAY, AHEAD, BEHIND, UNKNOWN_DAY = range(6)
"""Votes of a car."""
_VOTES: Final = 6

CAR_CLOCK: Final = np.dtype(
    [
        ("older", "f8"),  # second newest stamp [s]
        ("newer", "f8"),  # newest stamp [s]
        ("recent", "i8"),  # number of its samples among the newest `RECENT_SAMPLES`
        ("window", "i8"),  # number of its samples among the newest `WINDOW_SAMPLES`
    ]
)
"""Stamps and activity of a car."""
_UNKNOWN_CLOCK: Final = np.array((np.nan, np.nan, 0, 0), CAR_CLOCK)[()]


class DailyUpdate(Wire):
    """Mark the daily update among the messages that are no samples; it is never published."""

    midnight: float


class DayRollover:
    """Detect the changes of the UTC day.

    Attributes
    ----------
    midnight : float
        Midnight at which the present day ends; -inf before the first day. [Unix s]
    """

    def __init__(self) -> None:
        self.midnight = -np.inf
        self._place = 0  # of the next sample in `_newest`
        self._newest = np.full(WINDOW_SAMPLES, -1)  # lanes of the newest samples, a ring
        self._clocks = np.zeros(0, CAR_CLOCK)
        self._recent_votes, self._window_votes = np.zeros(_VOTES, np.int64), np.zeros(_VOTES, np.int64)

    def add_updates(self, batch: Batch, events: list[Event]) -> list[Event]:
        """Return the messages between the rows of a batch, with a daily update after those before a change of day."""
        updates = [Event(row, -1, DailyUpdate(end)) for row, end in self.find_rollovers(batch.lane, batch.stamp)]
        return sorted([*events, *updates], key=itemgetter(0)) if updates else events

    def find_rollovers(self, lane: Ints, stamp: Floats) -> list[tuple[int, float]]:
        """Return the rows before which the day changes, and the midnight at which each of the new days ends.

        Examples
        --------
        >>> rollover = DayRollover()
        >>> rollover.find_rollovers(np.zeros(3, np.int64), np.array([100.0, 103.0, 106.0]))
        [(1, 86400.0)]
        >>> rollover.find_rollovers(np.zeros(5, np.int64), np.array([9e9, 109.0, 86398.0, 86401.0, 86404.0]))
        [(4, 172800.0)]
        """
        lanes = int(lane.max(initial=-1)) + 1
        self._clocks = grown(self._clocks, lanes, _UNKNOWN_CLOCK)
        days: list[tuple[int, float]] = []
        now, start = (self._newest, self._clocks, self._recent_votes, self._window_votes), 0
        while (row := int(_process_samples(lane, stamp, start, self._place, self.midnight, *now))) < len(lane):
            self._begin_day()
            days.append((row, self.midnight))
            start = row + 1
        self._place = (self._place + len(lane)) % WINDOW_SAMPLES
        return days

    def measure_silence(self, lanes: Ints) -> Floats:
        """Return how long cars have been silent, by the stamps of most active cars; 0 for an active car. [s]

        Examples
        --------
        >>> rollover = DayRollover()
        >>> rollover.find_rollovers(np.zeros(2, np.int64), np.array([100.0, 103.0]))
        [(1, 86400.0)]
        >>> rollover.find_rollovers(np.ones(2000, np.int64), np.arange(2000.0))
        []
        >>> rollover.measure_silence(np.array([0, 1]))
        array([1895.,    0.])
        """
        clocks, active = self._clocks[lanes], self._get_active_clocks()
        now = np.sort(np.minimum(active["older"], active["newer"]))
        if not len(now):
            return np.zeros(len(lanes))
        silent = now[(len(now) - 1) // 2] - np.fmax(clocks["older"], clocks["newer"])
        return np.where(clocks["window"] > 0, 0.0, silent)  # the clock of an active car may be hours behind

    def _get_active_clocks(self) -> NDArray[np.void]:
        """Return the clocks of the cars in the window that have two stamps, (cars,) CAR_CLOCK."""
        known = ~np.isnan(self._clocks["older"]) & ~np.isnan(self._clocks["newer"])
        return self._clocks[(self._clocks["window"] > 0) & known]

    def _begin_day(self) -> None:
        """Begin the day that most cars vote for."""
        if self._recent_votes[NEXT_DAY] > self._recent_votes[[TODAY, YESTERDAY]].sum():
            self.midnight += SECONDS_PER_DAY
        else:
            active = self._get_active_clocks()
            if self._window_votes[AHEAD] > self._window_votes[[YESTERDAY, BEHIND]].max():
                stamps = -np.sort(-np.minimum(active["older"], active["newer"]))
            else:
                stamps = np.sort(np.maximum(active["older"], active["newer"]))
            self.midnight = float((np.floor(stamps[len(stamps) // 2] / SECONDS_PER_DAY) + 1.0) * SECONDS_PER_DAY)
        self._count_votes()

    def _count_votes(self) -> None:
        """Count the votes of all active cars."""
        self._recent_votes[:] = self._window_votes[:] = 0
        for clock in self._clocks[self._clocks["window"] > 0]:
            vote = _vote(clock["older"], clock["newer"], self.midnight)
            self._recent_votes[vote] += clock["recent"] > 0
            self._window_votes[vote] += 1

    def keep(self, kept: Ints, later: Ints) -> None:
        """Keep the state of some lanes only, in their order; then follow those of cars that the batch brings later."""
        lanes = np.concatenate([kept, later])
        number = np.full(int(max(lanes.max(initial=-1), self._newest.max())) + 2, -1)
        number[lanes] = np.arange(len(lanes))
        self._newest = number[self._newest]  # -1, no lane, stays the last one
        self._clocks = grown(self._clocks, len(number), _UNKNOWN_CLOCK)[lanes]
        returned = self._clocks[len(kept) :]
        returned["older"][returned["newer"] - returned["older"] > BEHIND_LIMIT] = np.nan  # before it was forgotten
        self._count_votes()

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self.midnight, self._place, self._newest.tobytes(), self._clocks.tobytes()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self.midnight, self._place, newest, clocks = state
        self._newest = np.frombuffer(newest, np.int64).copy()
        self._clocks = np.frombuffer(clocks, CAR_CLOCK).copy()
        self._count_votes()


@njit(cache=True)
def _process_samples(
    lane: Ints,
    stamp: Floats,
    start: int,
    place: int,
    midnight: float,
    newest: Ints,
    clocks: Any,
    recent_votes: Ints,
    window_votes: Ints,
) -> int:
    """Process samples until the day changes."""
    for row in range(start, len(lane)):
        clock, at = clocks[lane[row]], (place + row) % WINDOW_SAMPLES
        before = _vote(clock.older, clock.newer, midnight)
        clock.older, clock.newer = clock.newer, stamp[row]
        now = _vote(clock.older, clock.newer, midnight)
        if clock.recent > 0:
            recent_votes[before] -= 1
        recent_votes[now] += 1
        clock.recent += 1
        leaving = newest[(at - RECENT_SAMPLES) % WINDOW_SAMPLES]
        if leaving >= 0:
            left = clocks[leaving]
            left.recent -= 1
            if left.recent == 0:
                recent_votes[_vote(left.older, left.newer, midnight)] -= 1
        if clock.window > 0:
            window_votes[before] -= 1
        window_votes[now] += 1
        clock.window += 1
        leaving = newest[at]
        behind = window_votes[BEHIND] + (window_votes[YESTERDAY] if leaving < 0 else 0)
        if leaving >= 0:
            left = clocks[leaving]
            left.window -= 1
            if left.window == 0:
                window_votes[_vote(left.older, left.newer, midnight)] -= 1
        newest[at] = lane[row]
        most = 2 * max(window_votes[AHEAD], behind)
        has_begun = recent_votes[NEXT_DAY] > recent_votes[TODAY] + recent_votes[YESTERDAY]
        if has_begun or most > window_votes[:UNKNOWN_DAY].sum():
            return row
    return len(lane)


@njit(cache=True)
def _vote(older: float, newer: float, midnight: float) -> int:
    """Return the vote of a car by its two newest stamps; two that disagree count as the present day."""
    if isnan(older) or isnan(newer):
        return UNKNOWN_DAY
    if older >= midnight + SECONDS_PER_DAY and newer >= midnight + SECONDS_PER_DAY:
        return AHEAD
    if older >= midnight and newer >= midnight:
        return NEXT_DAY
    since = midnight - max(older, newer)
    return BEHIND if since > BEHIND_LIMIT else YESTERDAY if since > SECONDS_PER_DAY else TODAY
