"""Totals of closed rides and windows, kept until a table is made of them."""

import numpy as np

from socast.core.batch import Ints, Lanes
from socast.core.totals.accumulator import Sums, Totals, join_totals
from socast.core.wire.rides import RideDrivers, RideNames


class ClosedTotals:
    """Keep the totals of closed rides and windows until they are taken, with the name and driver of each ride."""

    def __init__(self, none: Totals, lanes: Lanes, names: RideNames, drivers: RideDrivers, *, keep: bool) -> None:
        self._none, self._keep = none, keep
        self._lanes, self._find_names, self._find_drivers = lanes, names.names, drivers.find_all
        self._rides: list[Totals] = []
        self._ride_names: list[str | None] = []
        self._drivers: list[str | None] = []
        self._windows: list[Totals] = []

    def add(self, sums: Sums) -> None:
        """Keep what a batch closed."""
        rides = sums.rides
        if len(rides.lane):
            names = self._find_names(rides.at_last("code").tolist())
            drivers = self._find_drivers(map(self._lanes.names.__getitem__, rides.lane), names, rides.at)
            if self._keep:
                self._rides.append(_copy(rides))
                self._ride_names += names
                self._drivers += drivers
        if self._keep and len(sums.windows.lane):
            self._windows.append(_copy(sums.windows))

    def get_lanes(self) -> Ints:
        """Return the lanes of what is kept."""
        return np.concatenate([np.zeros(0, np.int64), *(each.lane for each in (*self._rides, *self._windows))])

    def keep(self, lanes: Ints) -> None:
        """Keep some lanes only, in their order, those of `get_lanes` among them."""
        for parts in (self._rides, self._windows):
            parts[:] = [each._replace(lane=np.searchsorted(lanes, each.lane)) for each in parts]

    def take_rides(self) -> tuple[Totals, list[str | None], list[str | None]]:
        """Return the rides, their names and their drivers that were kept since the last call."""
        rides, self._rides = self._rides, []
        names, self._ride_names = self._ride_names, []
        drivers, self._drivers = self._drivers, []
        return join_totals(rides, self._none), names, drivers

    def take_windows(self) -> Totals:
        """Return the windows that were kept since the last call."""
        windows, self._windows = self._windows, []
        return join_totals(windows, self._none)


def _copy(totals: Totals) -> Totals:
    """Return a copy, as a view would keep the memory of a whole block."""
    return Totals(*(np.array(part) for part in totals))
