"""Remember when each car was last heard of, so that the daily update can forget cars that have been silent for days.

A car that is forgotten leaves its lane, and the lanes after it move up. The rest of the batch then has the lanes that
it would have if the batch began after the update, so that any division of the input gives the same state.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from socast.core.batch import Batch, Ints, Lanes, OfLanes, grown
from socast.core.forecast.day_rollover import WINDOW_SAMPLES, DayRollover
from socast.core.wire.decoder import Event
from socast.core.wire.message_order import MessageOrder


class SilentCars:
    """Remember the day on which each lane was last heard of, and its last sample among those of the fleet."""

    def __init__(self) -> None:
        self._now = -np.inf  # midnight at which the present day ends [s]
        self._samples = 0
        self._day = np.zeros(0)  # -inf before the first day, NaN for a lane that was not heard of [s]
        self._sample = np.zeros(0, np.int64)

    def hear(self, lanes: Ints | Sequence[int], *, samples: bool = True) -> None:
        """Note lanes whose cars have sent something, in the order of their arrival."""
        if len(lanes):
            most = int(np.max(lanes)) + 1
            self._day, self._sample = grown(self._day, most, np.nan), grown(self._sample, most, -WINDOW_SAMPLES)
            self._day[lanes] = self._now
            if samples:
                self._sample[lanes] = self._samples + np.arange(len(lanes))
                self._samples += len(lanes)

    def begin_day(self, midnight: float, since: float, needed: Ints) -> Ints | None:
        """Begin a day, and return the lanes that are kept; None if all are.

        Not kept are those of which nothing was heard since a time [Unix s], unless they are needed or among the newest
        samples of the fleet.
        """
        self._day[np.isinf(self._day)] = midnight
        self._now = midnight
        kept = (self._day >= since) | (self._sample >= self._samples - WINDOW_SAMPLES)
        kept[needed] = True
        return None if kept.sum() == self._count_heard() else np.flatnonzero(kept)

    def _count_heard(self) -> int:
        """Return the number of lanes of which anything was heard; they are the first ones."""
        return int(np.count_nonzero(~np.isnan(self._day)))

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self._day, self._sample = self._day[lanes], self._sample[lanes]

    def dump(self) -> Any:
        """Return the state as plain values."""
        heard = self._count_heard()
        return self._now, self._samples, self._day[:heard].tobytes(), self._sample[:heard].tobytes()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self._now, self._samples, day, sample = state
        self._day, self._sample = np.frombuffer(day).copy(), np.frombuffer(sample, np.int64).copy()


class RestOfBatch(NamedTuple):
    """Hold what follows a daily update in its batch.

    Parameters
    ----------
    events : Messages between the rows of the batch.
    first : Number of the first event of the rest.
    midnight : Midnight at which the day ends that the update begins. [Unix s]
    """

    batch: Batch
    row: int
    events: list[Event]
    first: int
    order: MessageOrder
    midnight: float

    def find_later(self, kept: Ints) -> Ints:
        """Return the lanes in the rest that are not among some kept ones, in the order in which they appear."""
        events = [
            (event.lane, self.order.of_event(self.first + i)) for i, event in enumerate(self.events[self.first :])
        ]
        of_events = np.array([each for each in events if each[0] >= 0], np.int64).reshape(-1, 2)
        lanes = np.concatenate([self.batch.lane[self.row :], of_events[:, 0]])
        lanes = lanes[np.argsort(np.concatenate([self.order.of_rows[self.row :], of_events[:, 1]]), kind="stable")]
        later, first = np.unique(lanes, return_index=True)
        is_new = ~np.isin(later, kept)
        return later[is_new][np.argsort(first[is_new])]

    def forget_lanes(self, kept: Ints, lanes: Lanes, day_rollover: DayRollover, components: Sequence[OfLanes]) -> None:
        """Forget all lanes but some, and number them anew: the kept ones, then those that the rest brings."""
        later = self.find_later(kept)
        for component in components:
            component.keep(kept)
        day_rollover.keep(kept, later)
        left = np.concatenate([kept, later])
        lanes.keep(left)
        self.renumber(left)

    def renumber(self, lanes: Ints) -> None:
        """Give the lanes of the rest, which are among the given ones, their numbers in the given order, in place."""
        number = np.full(int(lanes.max(initial=-1)) + 2, -1)  # the last one stands for no lane, -1
        number[lanes] = np.arange(len(lanes))
        self.batch.lane[self.row :] = number[self.batch.lane[self.row :]]
        left = self.events[self.first :]
        self.events[self.first :] = [event._replace(lane=int(number[event.lane])) for event in left]
