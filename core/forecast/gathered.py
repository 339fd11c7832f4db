"""Sums of batches and their pieces, gathered until it pays to look ahead, with what dispatch said meanwhile.

Batches may be small, and observations of the weather cut them into pieces of a few rows. What is ahead of a car does
not depend on where they are cut, so they are taken together.
"""

from core.forecast.plan_tracker import Arrival, Driving
from core.totals.accumulator import Sums, Totals, join_totals


class Gathered:
    """What has not been taken into account of what is ahead. Rows are counted from the first batch that is in it.

    Parameters
    ----------
    none : Totals
        Of no rows.

    Attributes
    ----------
    size : int
        Samples that it is of, and sayings.
    lanes : set of int
        Of which dispatch said something.
    """

    def __init__(self, none: Totals) -> None:
        self._none = none
        self._sums: list[Sums] = []
        self._said: list[Arrival | Driving] = []
        self.size, self.lanes = 0, set[int]()
        self._before = 0  # rows of batches before the one that is being taken

    def __bool__(self) -> bool:
        return bool(self._sums or self._said)

    def add(self, sums: Sums, start: int, rows: int) -> None:
        """Add the sums of so many rows, which begin at row `start` of the batch."""
        self._sums.append(Sums(*(totals._replace(at=totals.at + (self._before + start)) for totals in sums)))
        self.size += rows

    def say(self, said: Arrival | Driving) -> None:
        """Add what dispatch said, in its order."""
        self._said.append(said._replace(at=self._before + said.at))
        self.lanes.add(said.lane)
        self.size += 1

    def end(self, rows: int) -> None:
        """Note that the batch has ended, with so many rows."""
        self._before = self._before + rows if self else 0

    def take(self, end: int) -> tuple[Sums, list[Arrival], list[Driving]]:
        """Return the sums as one, and what was said up to row `end` of the batch; they are gathered no more."""
        sums, self._sums, self.size = self._sums, [], 0
        rides, rests, running = ([getattr(s, name) for s in sums] for name in ("rides", "rests", "running"))
        now = [each for each in self._said if each.at <= self._before + end]
        self._said = self._said[len(now) :]
        self.lanes = {each.lane for each in self._said}
        plans = [each for each in now if isinstance(each, Arrival)]
        drivers = [each for each in now if isinstance(each, Driving)]
        none = self._none
        return (
            Sums(join_totals(rides, none), join_totals(rests, none), none, join_totals(running, none)),
            plans,
            drivers,
        )
