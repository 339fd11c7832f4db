"""Rows that wait until their ride has ended, so that tables can use estimates from both sides of each sample.

A live forecast uses the past only. A table may use the whole ride: `DeferredRows` keeps the rows of open rides, and
releases the rows of closed rides with the elevation that `socast.core.cleaning.elevation_smoother` estimates. Rides of
cars without a speed also receive the motion that `socast.core.cleaning.position_smoother` estimates.

Rows are released at fixed numbers of rows since the start, never at the end of a batch. The released rows, their order
and the totals made of them are therefore the same for any division of the input.

Each row keeps its place among all messages, and so does each end of a ride between two rows. The totals of the rows
wait in `DeferredTotals` until no earlier row is kept.
"""

from collections.abc import Callable, Iterator, Sequence
from math import inf
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.elevation_smoother import LONGEST_PIECE, number_rows, smooth_elevation
from socast.core.cleaning.fleet_clock import RIDE_END
from socast.core.cleaning.position_smoother import smooth_motion
from socast.core.signals.weather import Sky
from socast.core.totals.accumulator import NO_ENDS, Sums, Totals, join_totals
from socast.core.totals.clean_rows import CleanRows
from socast.core.totals.display_record import create_unknown_yields

FIELDS: Final = (*Clean._fields, *Sky._fields, "kind", "place")
"""Columns of the kept rows."""
WHOLE: Final = ("lane", "ride", "window", "quality")
"""Columns of whole numbers in `Clean`."""
LEAST: Final = 20_000
"""Least number of rows between two releases: 8 MB."""

_LANE, _RIDE, _CODE, _PLACE = (FIELDS.index(name) for name in ("lane", "ride", "code", "place"))


class DeferredRows:
    """Keep the rows of open rides, and release those of closed rides with smoothed elevation.

    Parameters
    ----------
    least : int
        Least number of rows between two releases. [rows]
    longest : int
        Number of rows of a piece: it is released although its ride is still open. [rows]

    Attributes
    ----------
    messages : int
        Number of messages in all batches before the present one.
    totals : DeferredTotals
        Totals of released rows, which wait for rows that are kept.
    smooth_elevation : callable
        Function that smooths the elevation of released rows; `socast verify` listens here.
    """

    def __init__(self, least: int = LEAST, longest: int = LONGEST_PIECE) -> None:
        self.least, self.longest = least, longest
        self.totals = DeferredTotals()
        self.smooth_elevation: Callable[[Clean, int], Clean] = smooth_elevation
        self._parts: list[Floats] = []
        self._ends: NDArray[np.void] = NO_ENDS  # of rides whose rows are kept; `place` is that among all messages
        self.messages = 0
        self._until_release = least

    def add(self, rows: CleanRows) -> list[CleanRows]:
        """Keep rows, and return those that have become complete.

        Returns
        -------
        list of CleanRows
            Rows of closed rides and of idle periods, each part in the order of arrival.
        """
        place = np.arange(rows.size) if rows.place is None else rows.place
        table = np.stack([*rows.clean, *rows.sky, rows.kind, place + self.messages]).astype(np.float64, copy=False)
        ends = rows.ends.copy()
        ends["place"] += self.messages
        released = []
        while table.shape[1] >= self._until_release:
            head, table = table[:, : self._until_release], table[:, self._until_release :]
            self._parts.append(head)
            known = ends["place"] <= head[_PLACE, -1]
            self._ends, ends = np.concatenate([self._ends, ends[known]]), ends[~known]
            released.append(self._release())
        if table.shape[1]:
            self._parts.append(table)
            self._until_release -= table.shape[1]
        self._ends = np.concatenate([self._ends, ends])
        return released

    def end_batch(self, messages: int) -> None:
        """Note the end of a batch of so many messages: the places of later ones are counted from it."""
        self.messages += messages

    def close(self) -> list[CleanRows]:
        """Return all kept rows at the end of the stream."""
        if not self._parts:
            return []
        table = np.concatenate(self._parts, axis=1)
        self._parts, self._until_release = [], self.least
        return [self._complete(table)]

    def sum_up(
        self, released: Sequence[CleanRows], sum_up: Callable[[CleanRows], Sums], block: int
    ) -> Iterator[tuple[Sums, Ints | None]]:
        """Sum up released rows, and yield the totals that no kept row precedes, see `DeferredTotals.take`."""
        for rows in released:
            for at in range(0, max(rows.size, 1), block):
                self.totals.add(sum_up(rows.rows(at, at + block)))
        if released:
            yield from self.totals.take(self.first_place)

    def add_daily_update(self, place: int, kind_of_lane: Ints) -> None:
        """Let a daily update wait, see `DeferredTotals`; `place` is that in the batch."""
        self.totals.add_daily_update(self.messages + place, kind_of_lane)

    @property
    def first_place(self) -> float:
        """Place of the first kept row among all messages; infinite without one."""
        return min((float(part[_PLACE, 0]) for part in self._parts if part.shape[1]), default=inf)

    def ride_codes(self) -> Floats:
        """Return the code of the ride of each kept row, see `socast.core.wire.rides.RideNames`."""
        return np.concatenate([np.empty(0), *(part[_CODE] for part in self._parts), *self.totals.ride_codes()])

    def _release(self) -> CleanRows:
        """Return the rows of closed rides and idle periods, and keep the rows of open rides."""
        table = np.concatenate(self._parts, axis=1)
        is_open = self._find_open_rows(table[_LANE].astype(np.int64), table[_RIDE], table[_PLACE])
        self._parts = [table[:, is_open]]
        self._until_release = max(self.least, self._parts[0].shape[1])  # so that a row is copied twice on average
        return self._complete(table[:, ~is_open])

    def _find_open_rows(self, lane: Ints, ride: Floats, place: Floats) -> NDArray[np.bool_]:
        """Return whether each row belongs to the ride in progress of its lane, and to no whole piece of that ride."""
        newest, last = np.full((2, lane.max(initial=-1) + 1), -1.0)
        newest[lane], last[lane] = ride, place  # the last row of a lane is assigned last
        ends = self._ends[self._ends["lane"] < len(newest)]
        ended = ends["lane"][ends["place"] >= last[ends["lane"]]]
        newest[ended] = -1.0
        is_open: NDArray[np.bool_] = (ride >= 0.0) & (ride == newest[lane])
        pieces = self.longest * (np.bincount(lane[is_open], minlength=len(newest)) // self.longest)
        if pieces.any():
            is_open[is_open] = number_rows(lane[is_open]) >= pieces[lane[is_open]]
        return is_open

    def _complete(self, table: Floats) -> CleanRows:
        """Return kept rows, with smoothed elevation and without due forecasts, and the ends between them."""
        size = len(Clean._fields)
        clean = Clean(*table[:size])
        clean = clean._replace(**{name: getattr(clean, name).astype(np.int64) for name in WHOLE})
        clean = smooth_motion(clean._replace(due=np.zeros(table.shape[1], np.bool_)), self.longest)
        clean = self.smooth_elevation(clean, self.longest)
        kind, place = table[-2:].astype(np.int64)
        ends, self._ends = self._ends, NO_ENDS
        ends["row"] = np.searchsorted(place, ends["place"], side="right")
        return CleanRows(clean, Sky(*table[size:-2]), kind, place, ends)

    def dump(self) -> Any:
        """Return what is kept as plain values."""
        table = np.concatenate([np.empty((len(FIELDS), 0)), *self._parts], axis=1)
        return [table.tobytes(), self._until_release, self.messages, self._ends.tobytes(), self.totals.dump()]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        table, self._until_release, self.messages, ends, totals = state
        self._parts = [np.frombuffer(table).reshape(len(FIELDS), -1).copy()]
        self._ends = np.frombuffer(ends, RIDE_END).copy()
        self.totals.load(totals)


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
