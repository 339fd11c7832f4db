"""Ride and window totals: columns of rates summed per ride and per window, running totals included.

Each row is added to the open window of its lane, in order. A window that closes is added to its ride. The totals at any
sample are therefore those of the ride plus those of the open window, and any chunking gives the same sums to the bit.
Between two rides, the totals of the idle period take the place of those of the ride.
"""

from collections.abc import Sequence
from math import isnan
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import NO_RIDE, Floats, Ints, grown, take_lanes
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.fleet_clock import RIDE_END
from socast.core.cleaning.quality import CAUSES
from socast.core.columns import KMH, SPEED_BIN_KMH, SPEED_BINS
from socast.core.compiled_cache import njit
from socast.core.totals.display_record import create_unknown_yields

SPEED_BIN: Final = SPEED_BIN_KMH * KMH
"""Width of a bin of the speed histogram. [m/s]"""

AMOUNTS: Final = (
    *("duration", "standing"),  # time of all samples, and of those at which the car stood [s]
    "distance",  # [m]
    *("gained", "lost"),  # sums of climbs and of descents [m]
    *("gained_causal", "lost_causal"),  # the same from fixes up to each sample only [m]
    *("energy", "metered"),  # by voltage times current [J], and the time for which it is known [s]
    "energy_variance",  # of that energy [J^2]
    "ambient",  # integral over time [K s]
    *("wind", "wind_north", "wind_east"),  # integrals of the wind speed and its components from north and east [m]
    "wind_known",  # time for which the wind is known [s]
    "precipitation",  # [m]
    *("hvac", "hvac_known"),  # measured energy of heating and air conditioning [J], and the time it is known [s]
    "stops",
    "unresolved_braking",  # part of the braking energy that is estimated from the spread of the acceleration [J]
    "samples",
    "speed_rejected",  # time for which the speed was rejected [s]
    "speed_missing",  # time for which the speed was missing, of a car that sends it [s]
    "bridged",  # distance of steps whose distance was bridged [m]
    "unseen",  # time for which bridged distances were driven beyond the time that passed [s]
    "disputed",  # distance that was counted, and that fixes or odometer dispute [m]
    *("path", "path_run", "straight", "straight_run"),  # see `socast.core.cleaning.clean_columns` [m]
    *("ticked", "ticked_run", "slow", "slow_run"),  # the same [m]
    "mistimed",  # time by which steps turned out to be wrong later in the ride [s]
    *("soc_faults", "stale_fall"),  # samples whose charge froze, is stale or jumps; fall of stale ones [1]
)
"""What is summed of every ride and window, followed by the effects' energies [J] and the speed histogram [m]."""

EDGES: Final = (
    "time",
    "soc",
    "odometer",
    "latitude",
    "longitude",
    "battery_temperature",
    "elapsed",
    "parked",
    "since_charge",
    "soc_step",
    "occupants",
    "power",  # by voltage times current, at the sample [W]
    "ambient",  # outside temperature, of the car or else of a station [K]
    "code",
    "lost",
    "speed_scale",  # factor by which the reported speed was multiplied; 0 for 1
    "kind",
)
"""What is kept of the first and of the last sample of every ride and window; `kind` is the kind of car."""

DURATION: Final = AMOUNTS.index("duration")
DISTANCE: Final = AMOUNTS.index("distance")
SOC: Final = EDGES.index("soc")
CODE: Final = EDGES.index("code")
LOST: Final = EDGES.index("lost")
SILENCE: Final = 600.0
"""A longer step outside rides does not count as idle time, because the car may have been switched off. [s]"""

NO_ENDS: Final = np.empty(0, RIDE_END)
"""No ride that ended between two rows."""
OPEN_RIDE: Final = 0
"""Column of the open totals: ordinal of the open ride, -1 for an idle period, `NOTHING_OPEN` for neither."""
NOTHING_OPEN: Final = -2.0
"""Open ride of a lane whose ride has ended without a sample; the next sample begins a ride or an idle period."""
OPEN_WINDOW: Final = 1
"""Column of the open totals: ordinal of the open window."""
OUT_AT: Final = 0
"""Column of an output row: place in the batch."""
OUT_LANE: Final = 1
"""Column of an output row: lane."""
_OUT_HEAD: Final = 2
"""Number of columns of an output row before the open totals that it copies."""


class _Layout(NamedTuple):
    """Hold the first column of each part of the open totals of a lane, and their number of columns."""

    window_amounts: int
    ride_amounts: int
    ride_first: int
    window_first: int
    last: int
    quality: int
    size: int

    @classmethod
    def of(cls, width: int) -> "_Layout":
        """Return the layout for so many amounts."""
        sizes = {
            "open": OPEN_WINDOW + 1,
            "window_amounts": width,
            "ride_amounts": width,
            "ride_first": len(EDGES),
            "window_first": len(EDGES),
            "last": len(EDGES),
            "quality": len(CAUSES),
        }
        ends = dict(zip(sizes, np.cumsum(list(sizes.values())).tolist(), strict=True))
        begins = {name: ends[name] - size for name, size in sizes.items() if name != "open"}
        return cls(**begins, size=ends["quality"])


class Totals(NamedTuple):
    """Hold the totals of rides, idle periods or windows, closed or running: one row each.

    Parameters
    ----------
    at : (n,) int64
        Place among the messages of the batch at which it closed, or at which the running totals were taken.
    lane, ride, window : (n,) int64
        Lane, and ordinals of ride and window in the lane.
    first, last : (n, len(EDGES)) float64
        Values at the first and at the last sample.
    quality : (n, len(CAUSES)) float64
        Number of samples of the ride with each quality bit, so far.
    display : (n,) DISPLAY_YIELD
        What the state of charge stood for, as known before the row closed.
    """

    at: Ints
    lane: Ints
    ride: Ints
    window: Ints
    amounts: Floats
    first: Floats
    last: Floats
    quality: Floats
    display: NDArray[Any]

    def newest(self) -> Ints:
        """Return the place of the last row of each lane, in their order."""
        _, last = np.unique(self.lane[::-1], return_index=True)
        return np.sort(len(self.lane) - 1 - last)

    def rows(self, which: Ints) -> "Totals":
        """Return some of the rows."""
        return Totals(*(part.take(which, axis=0) for part in self))  # type: ignore[arg-type]

    def amount(self, name: str) -> Floats:
        """Return a column of `AMOUNTS`."""
        return self.amounts[:, AMOUNTS.index(name)]

    def at_first(self, name: str) -> Floats:
        """Return a column of `EDGES` at the first sample."""
        return self.first[:, EDGES.index(name)]

    def at_last(self, name: str) -> Floats:
        """Return a column of `EDGES` at the last sample."""
        return self.last[:, EDGES.index(name)]

    @property
    def kinds(self) -> Ints:
        """Kind of car of each row."""
        return self.at_last("kind").astype(np.int64)

    def flagged(self, cause: str) -> Floats:
        """Return the number of samples with a quality bit."""
        return self.quality[:, CAUSES.index(cause)]

    def share(self, name: str, whole: str = "duration", otherwise: Floats | float = 0.0) -> Floats:
        """Return an amount over that of the whole, or another number where the whole is not above zero."""
        over = self.amount(whole)
        return np.divide(self.amount(name), over, out=np.full(len(over), otherwise), where=over > 0.0)


def join_totals(parts: Sequence[Totals], none: Totals) -> Totals:
    """Return totals concatenated; `none` where there are no rows."""
    some = [part for part in parts if len(part.lane)]
    if len(some) < 2:
        return some[0] if some else none
    return Totals(*(_concatenate(columns) for columns in zip(*some, strict=True)))


def _concatenate(columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return columns one after another; records as plain numbers, which takes a tenth of the time."""
    records = columns[0].dtype
    if records.names is None:
        return np.concatenate(columns)
    return np.concatenate([each.view(np.float64) for each in columns]).view(records)


class Sums(NamedTuple):
    """Hold the totals that a batch closed, and running totals at its due samples; `idle_periods` lie between rides."""

    rides: Totals
    idle_periods: Totals
    windows: Totals
    running: Totals


class Accumulator:
    """Accumulate the totals of the open ride, or idle period, and of the open window of every lane.

    Parameters
    ----------
    effects : int
        Number of effects whose energies are summed.
    """

    def __init__(self, effects: int) -> None:
        self.width = len(AMOUNTS) + effects + SPEED_BINS
        self._layout = _Layout.of(self.width)
        self._open: Floats = self._empty(0)
        self._closed = np.empty((3, 0, _OUT_HEAD + self._layout.size))  # reused, because allocation costs more

    def _empty(self, lanes: int) -> Floats:
        """Return the open totals of lanes that have sent nothing."""
        totals = np.zeros((lanes, self._layout.size))
        totals[:, [OPEN_RIDE, OPEN_WINDOW]] = -1.0
        return totals

    def add(
        self,
        clean: Clean,
        kind: Ints,
        rates: Floats,
        lanes: int,
        place: Ints | None = None,
        ends: NDArray[np.void] = NO_ENDS,
    ) -> Sums:
        """Add the rows of a batch.

        Parameters
        ----------
        place : (n,) int, optional
            Place of each row among the messages of the batch; its number without it.
        """
        if len(self._open) < lanes:
            self._open = grown(self._open, lanes, self._empty(1)[0])
        n, most = len(clean.lane), len(clean.lane) + len(ends)
        columns = clean._asdict() | {"kind": kind.astype(np.float64)}
        edges = np.stack([columns[name] for name in EDGES])
        speed_bin = np.minimum(clean.speed / SPEED_BIN, SPEED_BINS - 1.0).astype(np.int64)
        if len(self._closed[0]) < most:
            self._closed = np.empty((3, most, self._closed.shape[2]))
        rides, idle, windows = self._closed
        running = np.empty((int(clean.due.sum()), self._closed.shape[2]))
        n_rides, n_idle, n_windows = add_rows(
            np.arange(n) if place is None else place,
            ends,
            clean.lane,
            clean.ride,
            clean.window,
            clean.quality,
            clean.due,
            rates,
            edges,
            speed_bin,
            self._open,
            self._layout,
            rides,
            idle,
            windows,
            running,
        )
        return Sums(
            self._read(rides[:n_rides].copy()),
            self._read(idle[:n_idle].copy()),
            self._read(windows[:n_windows].copy(), window=True),
            self._read(running),
        )

    def close(self) -> Sums:
        """Close every open ride, idle period and window; return their totals. The newest values of each lane remain."""
        riding = self._open[:, OPEN_RIDE] >= 0
        lanes = np.flatnonzero(riding)
        rides, windows = self.running(lanes), self._read(self._output_rows(lanes), window=True)
        duration = self._open[:, self._layout.ride_amounts + DURATION]
        idle = self.running(np.flatnonzero(~riding & (duration > 0.0)))
        ended, newest = self._open, slice(self._layout.last, self._layout.quality)
        self._open = self._empty(len(ended))
        self._open[:, newest] = ended[:, newest]
        self._open[:, self._layout.last + CODE] = NO_RIDE
        return Sums(rides, idle, windows, self.none())

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self._open = take_lanes(self._open, lanes)

    def dump(self) -> bytes:
        """Return the open totals of every lane as bytes."""
        return self._open.tobytes()

    def load(self, state: bytes) -> None:
        """Replace the open totals by those that `dump` returned, made with as many effects."""
        self._open = np.frombuffer(state).reshape(-1, self._layout.size).copy()

    def none(self) -> Totals:
        """Return totals without rows."""
        return self._read(np.empty((0, _OUT_HEAD + self._layout.size)))

    def running(self, lanes: Ints) -> Totals:
        """Return the totals so far of the ride or idle period of some lanes."""
        rows = self._output_rows(lanes)
        window, ride = self._part("window_amounts", self.width), self._part("ride_amounts", self.width)
        rows[:, ride] += rows[:, window]
        return self._read(rows)

    def ride_codes(self) -> Floats:
        """Return the code of the last ride of each lane, see `socast.core.wire.rides.RideNames`."""
        return self._open[:, self._layout.last + CODE]

    def _output_rows(self, lanes: Ints) -> Floats:
        """Return output rows of the open totals of some lanes, without a row of the batch."""
        rows = np.empty((len(lanes), _OUT_HEAD + self._layout.size))
        rows[:, OUT_AT], rows[:, OUT_LANE] = -1.0, lanes
        rows[:, _OUT_HEAD:] = self._open[lanes]
        return rows

    def _part(self, name: str, size: int) -> slice:
        """Return the columns of a part of the open totals in output rows."""
        begin = _OUT_HEAD + getattr(self._layout, name)
        return slice(begin, begin + size)

    def _read(self, rows: Floats, *, window: bool = False) -> Totals:
        """Return the totals in output rows, of the window or of the ride."""
        amounts, first = ("window_amounts", "window_first") if window else ("ride_amounts", "ride_first")
        return Totals(
            at=rows[:, OUT_AT].astype(np.int64),
            lane=rows[:, OUT_LANE].astype(np.int64),
            ride=rows[:, _OUT_HEAD + OPEN_RIDE].astype(np.int64),
            window=rows[:, _OUT_HEAD + OPEN_WINDOW].astype(np.int64),
            amounts=rows[:, self._part(amounts, self.width)],
            first=rows[:, self._part(first, len(EDGES))],
            last=rows[:, self._part("last", len(EDGES))],
            quality=rows[:, self._part("quality", len(CAUSES))],
            display=create_unknown_yields(len(rows)),
        )


@njit(cache=True)
def add_rows(
    place: Any,
    ends: Any,
    lane: Any,
    ride: Any,
    window: Any,
    quality: Any,
    due: Any,
    rates: Any,
    edges: Any,
    speed_bin: Any,
    open_totals: Any,
    layout: Any,
    rides_out: Any,
    idle_out: Any,
    windows_out: Any,
    running_out: Any,
) -> Any:
    """Add rows to the open totals of their lanes, in order; return how many rides, idle periods and windows closed."""
    n_rides = n_idle = n_windows = n_running = end = 0
    for i in range(lane.shape[0] + 1):
        while end < ends.shape[0] and ends[end].row <= i:
            totals = open_totals[ends[end].lane]
            end_ride(totals, layout, ends[end], edges.shape[0], rides_out[n_rides], windows_out[n_windows])
            n_rides, n_windows, end = n_rides + 1, n_windows + 1, end + 1
        if i == lane.shape[0]:
            break
        totals = open_totals[lane[i]]
        silent = ride[i] < 0 and rates[DURATION, i] > SILENCE
        next_window = totals[OPEN_RIDE] >= 0.0 and window[i] != totals[OPEN_WINDOW]
        if next_window or ride[i] != totals[OPEN_RIDE] or silent:
            rows = rides_out[n_rides], idle_out[n_idle], windows_out[n_windows]
            closed_ride, closed_rest, closed_window = close_open(
                totals, layout, ride[i], place[i], lane[i], edges, i, rows
            )
            n_rides, n_idle, n_windows = n_rides + closed_ride, n_idle + closed_rest, n_windows + closed_window
            totals[OPEN_RIDE], totals[OPEN_WINDOW] = ride[i], window[i]
        riding = ride[i] >= 0
        counts = riding and (rates[DURATION, i] > 0.0 or rates[DISTANCE, i] > 0.0)
        if counts:
            add_row(totals, layout.window_amounts, rates, speed_bin, i)
        elif not riding and rates[DURATION, i] <= SILENCE:
            add_row(totals, layout.ride_amounts, rates, speed_bin, i)
        if counts or not riding:
            update_edges(totals, layout, edges, i)
        if riding:
            add_quality(totals, layout.quality, quality[i])
        if due[i]:
            write_row(running_out[n_running], place[i], lane[i], totals)
            of_ride = running_out[n_running, _OUT_HEAD + layout.ride_amounts : _OUT_HEAD + layout.ride_first]
            of_ride += totals[layout.window_amounts : layout.ride_amounts]  # with the open window
            n_running += 1
    return n_rides, n_idle, n_windows


@njit(cache=True)
def close_open(
    totals: Any, layout: Any, ride: int, place: int, lane: int, edges: Any, i: int, rows: Any
) -> tuple[int, int, int]:
    """Close the open window at row `i`, and where the ride changes, close ride or idle period and begin the next one.

    Return how many rides, idle periods and windows were closed and written to `rows`. A silence ends an idle period at
    its last sample.
    """
    ride_row, rest_row, window_row = rows
    in_ride = totals[OPEN_RIDE] >= 0.0
    if in_ride:
        write_row(window_row, place, lane, totals)
        close_window(totals, layout, edges.shape[0])
    if ride == totals[OPEN_RIDE] and ride >= 0:
        return 0, 0, int(in_ride)
    rest = not in_ride and totals[layout.ride_amounts + DURATION] > 0.0
    if in_ride:
        totals[layout.last + LOST] = edges[LOST, i]
        write_row(ride_row, place, lane, totals)
    elif rest:
        write_row(rest_row, place, lane, totals)
    totals[layout.ride_amounts : layout.ride_first] = 0.0
    totals[layout.quality :] = 0.0
    for j in range(edges.shape[0]):
        totals[layout.ride_first + j] = totals[layout.window_first + j] = totals[layout.last + j] = edges[j, i]
    return int(in_ride), int(rest), int(in_ride)


@njit(cache=True)
def end_ride(totals: Any, layout: Any, end: Any, n_edges: int, ride_row: Any, window_row: Any) -> None:
    """Close the open ride and its window between two rows, and leave nothing open."""
    write_row(window_row, end.place, end.lane, totals)
    close_window(totals, layout, n_edges)
    totals[layout.last + LOST] = 0.0
    write_row(ride_row, end.place, end.lane, totals)
    totals[OPEN_RIDE], totals[layout.last + CODE] = NOTHING_OPEN, NO_RIDE
    totals[layout.ride_amounts : layout.ride_first] = 0.0
    totals[layout.quality :] = 0.0


@njit(cache=True)
def add_row(totals: Any, begin: int, rates: Any, speed_bin: Any, i: int) -> None:
    """Add the rates of row `i` to the amounts that begin at a column, and its distance to the speed histogram."""
    for j in range(rates.shape[0]):
        totals[begin + j] += rates[j, i]
    totals[begin + rates.shape[0] + speed_bin[i]] += rates[DISTANCE, i]


@njit(cache=True)
def close_window(totals: Any, layout: Any, n_edges: int) -> None:
    """Add the open window to its ride, and begin the next one where it ended."""
    for j in range(layout.ride_amounts - layout.window_amounts):
        totals[layout.ride_amounts + j] += totals[layout.window_amounts + j]
        totals[layout.window_amounts + j] = 0.0
    for j in range(n_edges):
        totals[layout.window_first + j] = totals[layout.last + j]


@njit(cache=True)
def update_edges(totals: Any, layout: Any, edges: Any, i: int) -> None:
    """Keep the values of row `i` as the last ones, and its state of charge as the first one where none was known."""
    for j in range(edges.shape[0]):
        totals[layout.last + j] = edges[j, i]
    if isnan(totals[layout.ride_first + SOC]):
        totals[layout.ride_first + SOC] = edges[SOC, i]
    if isnan(totals[layout.window_first + SOC]):
        totals[layout.window_first + SOC] = edges[SOC, i]


@njit(cache=True)
def write_row(row: Any, place: int, lane: int, totals: Any) -> None:
    """Write a place in the batch, a lane and its open totals to an output row."""
    row[OUT_AT], row[OUT_LANE] = place, lane
    for j in range(totals.shape[0]):
        row[_OUT_HEAD + j] = totals[j]


@njit(cache=True)
def add_quality(totals: Any, begin: int, bits: int) -> None:
    """Count each quality bit that is set in the columns that begin at `begin`."""
    place = begin
    while bits:
        if bits & 1:
            totals[place] += 1.0
        bits >>= 1
        place += 1
