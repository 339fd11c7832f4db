"""Rows that wait until their ride has ended, so that tables can use estimates from both sides of each sample.

A live forecast uses the past only. A table may use the whole ride: `DeferredRows` keeps the rows of open rides, and
releases the rows of closed rides with the elevation that `core.cleaning.elevation_smoother` estimates.

Rows are released at fixed numbers of rows since the start, never at the end of a batch. The released rows, their order
and the totals made of them are therefore the same for any division of the input.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats
from core.cleaning.elevation_smoother import smooth_elevation
from core.cleaning.kernel import Clean
from core.signals.weather import Sky
from core.totals.clean_rows import CleanRows

FIELDS: Final = (*Clean._fields, *Sky._fields, "kind")
"""Columns of the kept rows."""
WHOLE: Final = ("lane", "ride", "window", "quality")
"""Columns of whole numbers in `Clean`."""
LEAST: Final = 20_000
"""Least number of rows between two releases: 10 MB."""
LONGEST_RIDE: Final = 50_000
"""Number of rows after which the rows of a ride are released although it is still open; 42 h at a sample every 3 s."""

_LANE, _RIDE, _CODE = (Clean._fields.index(name) for name in ("lane", "ride", "code"))


class DeferredRows:
    """Keep the rows of open rides, and release those of closed rides with smoothed elevation.

    Parameters
    ----------
    least : int
        Least number of rows between two releases. [rows]
    longest : int
        Number of rows after which the rows of an open ride are released. [rows]
    """

    def __init__(self, least: int = LEAST, longest: int = LONGEST_RIDE) -> None:
        self.least, self.longest = least, longest
        self._parts: list[Floats] = []
        self._until_release = least

    def add(self, rows: CleanRows) -> list[CleanRows]:
        """Keep rows, and return those that have become complete.

        Parameters
        ----------
        rows : CleanRows
            n rows, in the order of their arrival.

        Returns
        -------
        list of CleanRows
            Rows of closed rides and of idle periods, each part in the order of arrival.
        """
        table = np.stack([*rows.clean, *rows.sky, rows.kind]).astype(np.float64, copy=False)
        released = []
        while table.shape[1] >= self._until_release:
            head, table = table[:, : self._until_release], table[:, self._until_release :]
            self._parts.append(head)
            released.append(self._release())
        if table.shape[1]:
            self._parts.append(table)
            self._until_release -= table.shape[1]
        return released

    def close(self) -> list[CleanRows]:
        """Return all kept rows at the end of the stream."""
        if not self._parts:
            return []
        table = np.concatenate(self._parts, axis=1)
        self._parts, self._until_release = [], self.least
        return [_complete(table)]

    def ride_codes(self) -> Floats:
        """Return the code of the ride of each kept row, see `core.wire.rides.RideNames`."""
        return np.concatenate([np.empty(0), *(part[_CODE] for part in self._parts)])

    def _release(self) -> CleanRows:
        """Return the rows of closed rides and idle periods, and keep the rows of open rides."""
        table = np.concatenate(self._parts, axis=1)
        is_open = self._find_open_rows(table[_LANE].astype(np.int64), table[_RIDE])
        self._parts = [table[:, is_open]]
        self._until_release = max(self.least, self._parts[0].shape[1])  # so that a row is copied twice on average
        return _complete(table[:, ~is_open])

    def _find_open_rows(self, lane: NDArray[np.int64], ride: Floats) -> NDArray[np.bool_]:
        """Return whether each row belongs to the ride in progress of its lane, and that ride is not too long."""
        newest = np.full(lane.max(initial=-1) + 1, -1.0)
        newest[lane] = ride  # the last row of a lane is assigned last
        is_open: NDArray[np.bool_] = (ride >= 0.0) & (ride == newest[lane])
        rows = np.bincount(lane[is_open], minlength=len(newest))
        return is_open & (rows[lane] <= self.longest)

    def dump(self) -> Any:
        """Return the kept rows and the number of rows until the next release."""
        table = np.concatenate([np.empty((len(FIELDS), 0)), *self._parts], axis=1)
        return [table.tobytes(), self._until_release]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        table, self._until_release = state
        self._parts = [np.frombuffer(table).reshape(len(FIELDS), -1).copy()]


def _complete(table: Floats) -> CleanRows:
    """Return kept rows, with smoothed elevation and without due forecasts."""
    size = len(Clean._fields)
    clean = Clean(*table[:size])
    clean = clean._replace(**{name: getattr(clean, name).astype(np.int64) for name in WHOLE})
    clean = smooth_elevation(clean._replace(due=np.zeros(table.shape[1], np.bool_)))
    return CleanRows(clean, Sky(*table[size:-1]), table[-1].astype(np.int64))
