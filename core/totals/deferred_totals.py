"""Totals that wait until no row before them is missing, so that displays learn from rides in the order of their ends.

`socast.core.totals.deferred_rows` releases the rows of a ride when the ride has ended, and rows of other rides later.
What the display of a car stands for is pooled over cars with every daily update. The totals of deferred rows therefore
wait until every row before their end has been summed. They then pass in the order of their ends, and the daily updates
between them, as in the causal pipeline. Totals that end at the same place pass in the order of their lanes, so that the
order depends on nothing but the messages.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from socast.core.batch import Ints
from socast.core.totals.accumulator import Sums, Totals, join_totals
from socast.core.totals.display_record import create_unknown_yields


class DeferredTotals:
    """Keep closed totals and daily updates until everything before them is known."""

    def __init__(self) -> None:
        self._sums: list[Sums] = []
        self._updates: list[tuple[int, Ints]] = []  # place, and the kind of car of each lane

    def add(self, sums: Sums) -> None:
        """Keep the totals of some rows; `at` is their place among all messages."""
        if any(len(part.lane) for part in sums):
            self._sums.append(sums)

    def add_daily_update(self, place: int, kind_of_lane: Ints) -> None:
        """Keep a daily update."""
        self._updates.append((place, kind_of_lane.copy()))

    def take(self, before: float) -> Iterator[tuple[Sums, Ints | None]]:
        """Yield the totals that closed before a place, up to each daily update with the kinds of cars at it.

        Yields
        ------
        kind_of_lane : (lanes,) int or None
            Kinds of cars for the daily update after them; None for the last totals, which no update follows.
        """
        due = [update for update in self._updates if update[0] <= before]
        self._updates = self._updates[len(due) :]
        for place, kind_of_lane in due:
            yield self._take_sums(place), kind_of_lane
        yield self._take_sums(before), None

    def _take_sums(self, before: float) -> Sums:
        """Return the totals that closed before a place, in that order, and keep the others."""
        if not self._sums:
            return _NO_SUMS
        joined = [join_totals(parts, parts[0]) for parts in zip(*self._sums, strict=True)]
        ordered = [part.rows(np.lexsort((part.lane, part.at))) for part in joined]
        numbers = [int(np.searchsorted(part.at, before)) for part in ordered]
        rest = Sums(*(part.rows(np.arange(n, len(part.at))) for part, n in zip(ordered, numbers, strict=True)))
        self._sums = []
        self.add(rest)
        return Sums(*(part.rows(np.arange(n)) for part, n in zip(ordered, numbers, strict=True)))

    def ride_codes(self) -> list[Any]:
        """Return the codes of the rides of the totals, see `socast.core.wire.rides.RideNames`."""
        return [part.at_last("code") for sums in self._sums for part in sums]

    def dump(self) -> Any:
        """Return totals and updates as plain values."""
        sums = [[[(column.tobytes(), column.shape) for column in part[:-1]] for part in each] for each in self._sums]
        return sums, [(place, kinds.tolist()) for place, kinds in self._updates]

    def load(self, state: Any) -> None:
        """Replace totals and updates by those that `dump` returned."""
        sums, updates = state
        self._sums = [Sums(*(_load_totals(part) for part in each)) for each in sums]
        self._updates = [(place, np.array(kinds, np.int64)) for place, kinds in updates]


def _load_totals(columns: Any) -> Totals:
    """Return totals from the bytes and shapes of their columns."""
    whole = [np.frombuffer(content, np.int64).reshape(shape).copy() for content, shape in columns[:4]]
    amounts, first, last, quality = (np.frombuffer(content).reshape(shape).copy() for content, shape in columns[4:])
    at, lane, ride, window = whole
    return Totals(at, lane, ride, window, amounts, first, last, quality, create_unknown_yields(len(at)))


def _make_no_totals() -> Totals:
    """Return totals without rows."""
    nothing, none = np.zeros(0, np.int64), np.zeros((0, 0))
    return Totals(nothing, nothing, nothing, nothing, none, none, none, none, create_unknown_yields(0))


_NO_SUMS = Sums(*(_make_no_totals() for _ in Sums._fields))
