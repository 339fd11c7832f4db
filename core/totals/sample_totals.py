"""The steps from samples to totals: cleaning, weather, effects, sums, and what the display of each car stands for."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Batch, Floats, Ints
from socast.core.cleaning.elevation_map import ElevationMap
from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.segmentation import NO_RIDE_EVENTS, RIDE_EVENT
from socast.core.columns import JOULES_PER_KWH
from socast.core.settings import Limits
from socast.core.signals.signals import Signals, flag_ambient
from socast.core.signals.weather import Stations
from socast.core.totals.accumulator import Accumulator, Sums, Totals
from socast.core.totals.clean_rows import CleanRows, PowerOfEffect, compute_amounts
from socast.core.totals.closed_rides import ClosedTotals
from socast.core.totals.context import RunContext
from socast.core.totals.deferred_rows import DeferredRows
from socast.core.totals.display_yield import DisplayYields
from socast.core.totals.run_counters import RunCounters
from socast.core.totals.tables import tabulate_rides, tabulate_windows
from socast.core.wire.message_order import MessageOrder, Piece
from socast.core.wire.messages import Ride, Weather
from socast.core.wire.rides import RideDrivers, RideNames

BLOCK: Final = 4000
"""Number of rows that pass through the steps at a time, so that their columns stay in the cache; no power of two, at
which columns would evict each other from the cache and the kernel would take twice the time."""


class SampleTotals:
    """Clean samples, and sum them up into rides, windows and the totals at which forecasts are due.

    Parameters
    ----------
    powers : sequence of PowerOfEffect
        Effects that are summed.
    names : RideNames
        Names of the rides in the samples.
    two_sided : bool
        True sums a ride only after its end, with its elevation smoothed from both sides.
    keep : bool
        Whether to keep closed rides and windows until they are taken.
    """

    def __init__(
        self,
        context: RunContext,
        powers: Sequence[PowerOfEffect],
        names: RideNames,
        limits: Limits,
        elevation_map: ElevationMap | None,
        *,
        two_sided: bool,
        keep: bool,
    ) -> None:
        self._context, self._powers = context, powers
        self.cleaner, self.stations = Cleaner(context.settings, elevation_map), Stations(limits.stations)
        self.accumulator = Accumulator(len(powers))
        self.deferred = DeferredRows() if two_sided else None
        self.displays, self.counters, self.drivers = DisplayYields(context.cars), RunCounters(), RideDrivers()
        self.closed = ClosedTotals(self.accumulator.none(), context.lanes, names, self.drivers, keep=keep)

    def add(self, batch: Batch, piece: Piece, order: MessageOrder) -> Iterator[tuple[range, Sums]]:
        """Clean and sum up the rows of a piece, a block at a time.

        Yields
        ------
        tuple of (range, Sums)
            Rows of each block, and their totals.
        """
        start, stop, ride_events = piece.start, piece.stop, np.array(piece.ride_events, RIDE_EVENT)
        for at in range(start, stop + 1 if stop == start and len(ride_events) else stop, BLOCK):
            end = min(at + BLOCK, stop)
            kind = piece.kind[at - start : end - start]
            now = ride_events[: np.searchsorted(ride_events["row"], end, side="right")]
            ride_events = ride_events[len(now) :]
            now["row"] -= at
            seen = [(row - at, value) for row, value in piece.observations if at <= row < end]
            rows = self.clean_up(batch.rows(at, end), kind, order.of_rows[at:end], now, seen)
            known = self._release(self.deferred.add(rows)) if self.deferred else [self._close(self.sum_up(rows))]
            yield from ((range(at, end), sums) for sums in known)
        for value in (value for row, value in piece.observations if row == stop):
            self.stations.observe(value)

    def clean_up(
        self,
        batch: Batch,
        kind: Ints,
        place: Ints | None = None,
        ride_events: NDArray[np.void] = NO_RIDE_EVENTS,
        observations: Sequence[tuple[int, Weather]] = (),
    ) -> CleanRows:
        """Clean samples and look up their weather, with the messages that came between them."""
        place = np.arange(batch.size) if place is None else place
        cars = self._context.cars
        of_cars = cars.capacity.take(kind) * JOULES_PER_KWH, cars.period.take(kind), cars.power_span.take(kind)
        clean, ends = self.cleaner.clean_between(batch, len(self._context.lanes), place, ride_events, *of_cars)
        sky = self.stations.sky_between(clean.time, clean.latitude, clean.longitude, observations)
        clean = clean._replace(quality=flag_ambient(clean, sky))
        self.counters.count_samples(clean.quality, clean.lane)
        return CleanRows(clean, sky, kind, place, ends)

    def sum_up(self, rows: CleanRows) -> Sums:
        """Compute signals and effects of cleaned rows, and add them to the totals."""
        clean, cars = rows.clean, self._context.cars
        signals = Signals(clean, rows.sky, cars.parameters_of(rows.kind))
        with np.errstate(all="ignore"):  # a user's effect may divide by a speed that it then masks
            energies = [(per, power(signals)) for per, power in self._powers]
        amounts = compute_amounts(signals, energies)
        clean = clean._replace(ambient=signals["ambient"])
        return self.accumulator.add(clean, rows.kind, amounts, len(self._context.lanes), rows.place, rows.ends)

    def observe_driver(self, ride: Ride, lane: int, place: int) -> None:
        """Take the report of a driver at a place in the batch."""
        self.drivers.observe(ride, lane, place + (self.deferred.messages if self.deferred else 0))

    def begin_day(self, place: int, since: float) -> None:
        """Let what displays taught before a place in the batch take effect, and forget stations silent since a time."""
        if self.deferred is None:
            self.displays.apply_daily_update()
        else:
            self.deferred.add_daily_update(place, self._context.cars.of_lane)
        self.stations.forget_silent(since)

    def end_batch(self, messages: int) -> None:
        """Note the end of a batch with a number of messages."""
        if self.deferred is None:
            self.drivers.settle()
        else:
            self.deferred.end_batch(messages)

    def finish(self) -> Iterator[Sums]:
        """Close all rides and windows at the end of the stream, and yield their totals."""
        if self.deferred is not None:
            yield from self._release(self.deferred.close())
        self.drivers.settle()
        yield self._close(self.accumulator.close())

    def take_rides(self) -> pd.DataFrame:
        """Return and drop the table of the rides that have ended."""
        return tabulate_rides(*self.closed.take_rides(), self._context)

    def take_windows(self) -> pd.DataFrame:
        """Return and drop the table of the windows that have ended."""
        return tabulate_windows(self.closed.take_windows(), self._context)

    def describe_running(self, lanes: Ints | None = None) -> Totals:
        """Return the running totals of some lanes, or of all with samples, with what their displays stand for."""
        lanes = self.cleaner.lanes_heard() if lanes is None else lanes
        return self.displays.describe(self.accumulator.running(lanes), len(self._context.lanes))

    def get_ride_codes(self) -> list[Floats]:
        """Return the codes of the rides of all that is kept, of rides that wait and of those in progress."""
        waiting = [self.deferred.ride_codes(), self.accumulator.ride_codes()] if self.deferred else []
        return [self.cleaner.ride_codes(), *waiting]

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        for part in (self.cleaner, self.accumulator, self.displays, self.closed):
            part.keep(lanes)

    def _release(self, ready: Sequence[CleanRows]) -> Iterator[Sums]:
        """Sum up rows that waited; yield the totals that are complete, with the daily updates between them applied."""
        assert self.deferred is not None
        for summed, kind_of_lane in self.deferred.sum_up(ready, self.sum_up, BLOCK):
            sums = self._close(summed)
            if kind_of_lane is not None:
                self.displays.apply_daily_update(kind_of_lane)
            yield sums

    def _close(self, summed: Sums) -> Sums:
        """Return totals with the yields of their displays; count and keep the rides and windows that have ended."""
        sums = self.displays.attach(summed, len(self._context.lanes))
        self.counters.count_rides(sums.rides, self._context)
        self.closed.add(sums)
        return sums
