"""Ride and window totals: columns of rates turned into columns of sums, running totals included.

Rows are added one after another into the open window of their lane; a window that closes is added to its ride. So the
totals at any sample are those of the ride and of the open window together, and any chunking gives the same sums to
the bit.
"""

from collections.abc import Sequence
from math import isnan
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit

from core.batch import Floats, Ints, grown
from core.cleaning.kernel import Clean
from core.cleaning.quality import CAUSES
from core.columns import KMH, SPEED_BIN_KMH, SPEED_BINS
from core.signals.signals import Signals

SPEED_BIN: Final = SPEED_BIN_KMH * KMH
"""Width of a bin of the speed histogram. [m/s]"""

AMOUNTS: Final = (
    "duration",  # [s]
    "distance",  # [m]
    "gained",  # [m]
    "lost",  # [m]
    "energy",  # by V I [J]
    "metered",  # time for which that is known [s]
    "energy_variance",  # of that energy [J^2]
    "ambient",  # integral over time [K s]
    "wind",  # [m]
    "wind_north",  # [m]
    "wind_east",  # [m]
    "wind_known",  # [s]
    "precipitation",  # [m]
    "hvac",  # [J]
    "hvac_known",  # [s]
    "stops",
    "samples",
)
"""What is summed of every ride and window, before the effects and the speed histogram."""

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
    "power",  # by V I, at the sample [W]
    "code",
    "lost",
    "kind",
)
"""What is kept of the first and of the last sample."""

DURATION: Final = AMOUNTS.index("duration")
SOC: Final = EDGES.index("soc")
LOST: Final = EDGES.index("lost")
SILENCE: Final = 600.0
"""A longer step between rides is time in which nothing is known to have been switched on. [s]"""
_HEAD: Final = 2  # ordinal of the open ride, -1 for none; ordinal of the open window
_BEFORE: Final = 2  # columns before a book where one is written out: the row at which it was, its lane


class Totals(NamedTuple):
    """Sums of rides, of rests between them, of windows, or running ones: one row each.

    Parameters
    ----------
    at : (n,) int64. Row of the batch that closed it, or at which it was shown.
    lane, ride, window : (n,) int64. Whose; ordinals in the lane.
    amounts : (n, len(AMOUNTS) + effects + SPEED_BINS) float64
    first, last : (n, len(EDGES)) float64
    quality : (n, len(CAUSES)) float64. Samples of the ride with each quality bit, so far.
    """

    at: Ints
    lane: Ints
    ride: Ints
    window: Ints
    amounts: Floats
    first: Floats
    last: Floats
    quality: Floats

    def newest(self) -> Ints:
        """Return the last row of each lane, in their order."""
        _, last = np.unique(self.lane[::-1], return_index=True)
        return np.sort(len(self.lane) - 1 - last)

    def rows(self, which: Ints) -> "Totals":
        """Return some of the rows."""
        return Totals(*(part[which] for part in self))  # type: ignore[arg-type]

    def amount(self, name: str) -> Floats:
        """Return a column of `AMOUNTS`."""
        return self.amounts[:, AMOUNTS.index(name)]

    def at_first(self, name: str) -> Floats:
        """Return what an edge was at the first sample."""
        return self.first[:, EDGES.index(name)]

    def at_last(self, name: str) -> Floats:
        """Return what an edge was at the last sample."""
        return self.last[:, EDGES.index(name)]


def join_totals(parts: Sequence[Totals], none: Totals) -> Totals:
    """Return totals one after another; `none` where there are none."""
    some = [part for part in parts if len(part.lane)]
    if len(some) < 2:
        return some[0] if some else none
    return Totals(*(np.concatenate(columns) for columns in zip(*some, strict=True)))


class Sums(NamedTuple):
    """What a batch brought to a close, and what is due; a rest is the time between two rides."""

    rides: Totals
    rests: Totals
    windows: Totals
    running: Totals


class Ledger:
    """The open ride and window of every lane; between rides, the rest in its place.

    Parameters
    ----------
    effects : int
        How many effects' energies are summed.
    """

    def __init__(self, effects: int) -> None:
        self.width = len(AMOUNTS) + effects + SPEED_BINS
        # where each part of a book begins: amounts of window and ride, first edges of ride and window, last, quality
        self._parts = np.cumsum([_HEAD, self.width, self.width, len(EDGES), len(EDGES), len(EDGES), len(CAUSES)])
        self.books: Floats = self._new(0)

    def _new(self, lanes: int) -> Floats:
        books = np.zeros((lanes, int(self._parts[-1])))
        books[:, :_HEAD] = -1.0
        return books

    def add(self, clean: Clean, kind: Ints, rates: Floats, lanes: int) -> Sums:
        """Add the rows of a batch.

        Parameters
        ----------
        clean : Clean
        kind : (n,) int
            Kind of car.
        rates : (len(AMOUNTS) + effects, n) float
            What each row adds, see `amounts`.
        lanes : int
            How many there are so far.
        """
        if len(self.books) < lanes:
            self.books = grown(self.books, lanes, self._new(1)[0])
        n = len(clean.lane)
        edges = np.stack([*(getattr(clean, name) for name in EDGES[:-1]), kind.astype(np.float64)])
        speed_bin = np.minimum(clean.speed / SPEED_BIN, SPEED_BINS - 1.0).astype(np.int64)
        size = _BEFORE + self.books.shape[1]
        closed = np.empty((n, size)), np.empty((n, size)), np.empty((n, size))
        running = np.empty((int(clean.due.sum()), size))
        counts = enter(
            clean.lane,
            clean.ride,
            clean.window,
            clean.quality,
            clean.due,
            rates,
            edges,
            speed_bin,
            self.books,
            self._parts,
            *closed,
            running,
        )
        rides, rests, windows = (rows[:count] for rows, count in zip(closed, counts.tolist(), strict=True))
        return Sums(self.read(rides), self.read(rests), self.read(windows, window=True), self.read(running))

    def close(self) -> Sums:
        """Close every open ride, rest and window; nothing is left behind."""
        open_lanes = np.flatnonzero(self.books[:, 0] >= 0)
        rides, windows = self.running(open_lanes), self.read(self._numbered(open_lanes), window=True)
        duration = self.books[:, self._parts[1] + DURATION]
        rests = self.running(np.flatnonzero((self.books[:, 0] < 0) & (duration > 0.0)))
        self.books = self._new(len(self.books))
        return Sums(rides, rests, windows, self.none())

    def dump(self) -> bytes:
        """Return the open totals of every lane as bytes."""
        return self.books.tobytes()

    def load(self, state: bytes) -> None:
        """Replace the open totals by those that `dump` returned, made with as many effects."""
        self.books = np.frombuffer(state).reshape(-1, self.books.shape[1]).copy()

    def none(self) -> Totals:
        """Return totals without rows."""
        return self.read(np.empty((0, _BEFORE + self.books.shape[1])))

    def running(self, lanes: Ints) -> Totals:
        """Return the totals so far of the rides in progress in some lanes, of the rests in others."""
        books = self._numbered(lanes)
        p = self._parts + _BEFORE
        books[:, p[1] : p[2]] += books[:, p[0] : p[1]]
        return self.read(books)

    def _numbered(self, lanes: Ints) -> Floats:
        """Return the books of some lanes, with no row and the lane before each."""
        return np.column_stack([np.full(len(lanes), -1.0), lanes.astype(np.float64), self.books[lanes]])

    def read(self, books: Floats, *, window: bool = False) -> Totals:
        """Name the parts of books: of the window, or of the ride (into which its open window has been added)."""
        p = self._parts + _BEFORE
        at, lane, ride, ordinal = books[:, :4].T.astype(np.int64)
        amounts, first = (p[0], p[3]) if window else (p[1], p[2])
        return Totals(
            at,
            lane,
            ride,
            ordinal,
            books[:, amounts : amounts + self.width],
            books[:, first : first + len(EDGES)],
            books[:, p[4] : p[5]],
            books[:, p[5] : p[6]],
        )


def amounts(signals: Signals, powers: Sequence[tuple[str, Floats]]) -> Floats:
    """Return what each row adds to the totals.

    Parameters
    ----------
    signals : Signals
        n rows.
    powers : sequence of (per, (n,) float)
        Effects' powers per unit coefficient [W], each acting over distance or over time.

    Returns
    -------
    (len(AMOUNTS) + len(powers), n) float
    """
    clean, sky = signals.clean, signals.sky
    dt = clean.dt
    table = np.zeros((len(AMOUNTS) + len(powers), len(dt)))
    climb = clean.climb
    wind_known = np.where(np.isnan(sky.wind_speed), 0.0, dt)
    hvac_known = np.where(np.isnan(clean.hvac), 0.0, dt)
    rows: tuple[Floats, ...] = (
        dt,
        clean.distance,
        np.maximum(climb, 0.0),
        np.maximum(-climb, 0.0),
        clean.energy,
        clean.metered,
        clean.energy_variance,
        signals["ambient"] * dt,
        np.nan_to_num(sky.wind_speed) * dt,
        np.nan_to_num(sky.wind_north) * dt,
        np.nan_to_num(sky.wind_east) * dt,
        wind_known,
        signals["precipitation"] * dt,
        np.nan_to_num(clean.hvac) * dt,
        hvac_known,
        clean.stop,
        np.ones(len(dt)),
    )
    for row, values in zip(table, rows, strict=False):
        row[:] = values
    for row, (per, power) in zip(table[len(AMOUNTS) :], powers, strict=True):
        np.multiply(power, clean.travel if per == "distance" else dt, out=row)
    return table


@njit(cache=True)
def enter(
    lane: Any,
    ride: Any,
    window: Any,
    quality: Any,
    due: Any,
    rates: Any,
    edges: Any,
    speed_bin: Any,
    books: Any,
    parts: Any,
    rides_out: Any,
    rests_out: Any,
    windows_out: Any,
    running_out: Any,
) -> Any:
    """Enter rows into the books of their lanes, in order; return how many rides, rests and windows were closed."""
    counts = np.zeros(3, np.int64)
    shown = 0
    window_at, ride_at, first_at, window_first_at, last_at, quality_at, _ = parts
    for i in range(lane.shape[0]):
        b = books[lane[i]]
        silent = ride[i] < 0 and rates[DURATION, i] > SILENCE
        if (window[i] != b[1] and b[0] >= 0.0) or ride[i] != b[0] or silent:
            close_open(i, lane[i], b, ride[i], parts, edges, rides_out, rests_out, windows_out, counts)
            b[0], b[1] = ride[i], window[i]
        riding = ride[i] >= 0
        counts_for = riding and (rates[0, i] > 0.0 or rates[1, i] > 0.0)
        if counts_for:
            add_row(b, window_at, rates, speed_bin, i)
        elif not riding and rates[DURATION, i] <= SILENCE:
            add_row(b, ride_at, rates, speed_bin, i)
        if counts_for or not riding:
            note_edges(b, first_at, window_first_at, last_at, edges, i)
        if riding:
            count_bits(b, quality_at, quality[i])
        if due[i]:
            show(running_out[shown], i, lane[i], b, window_at, ride_at)
            shown += 1
    return counts


@njit(cache=True)
def close_open(
    i: int,
    lane: int,
    b: Any,
    ride: int,
    parts: Any,
    edges: Any,
    rides_out: Any,
    rests_out: Any,
    windows_out: Any,
    counts: Any,
) -> None:
    """Close the window at row `i`; where another ride or rest begins there, close what was open and begin it.

    Silence ends a rest: what was before it is told by the last sample that was heard.
    """
    _, ride_at, _, window_first_at, last_at, _, _ = parts
    if b[0] >= 0.0:
        copy_out(windows_out[counts[2]], i, lane, b)
        counts[2] += 1
        close_window(b, parts[0], ride_at, window_first_at, last_at, edges.shape[0])
    if ride == b[0] and ride >= 0:
        return
    if b[0] >= 0.0:
        b[last_at + LOST] = edges[LOST, i]
        copy_out(rides_out[counts[0]], i, lane, b)
        counts[0] += 1
    elif b[ride_at + DURATION] > 0.0:
        copy_out(rests_out[counts[1]], i, lane, b)
        counts[1] += 1
    open_ride(b, parts, edges, i)


@njit(cache=True)
def open_ride(b: Any, parts: Any, edges: Any, i: int) -> None:
    """Clear the totals of the ride, and begin the next one at row `i`."""
    _, ride_at, first_at, window_first_at, last_at, quality_at, _ = parts
    b[ride_at:first_at] = 0.0
    b[quality_at:] = 0.0
    for j in range(edges.shape[0]):
        b[first_at + j] = b[window_first_at + j] = b[last_at + j] = edges[j, i]


@njit(cache=True)
def add_row(b: Any, at: int, rates: Any, speed_bin: Any, i: int) -> None:
    """Add what a row stands for to the open window, or to the rest."""
    for j in range(rates.shape[0]):
        b[at + j] += rates[j, i]
    b[at + rates.shape[0] + speed_bin[i]] += rates[1, i]


@njit(cache=True)
def show(row: Any, i: int, lane: int, b: Any, window_at: int, ride_at: int) -> None:
    """Write the running totals of a lane: the ride's, and with them the open window's."""
    copy_out(row, i, lane, b)
    for j in range(ride_at - window_at):
        row[_BEFORE + ride_at + j] += b[window_at + j]


@njit(cache=True)
def close_window(b: Any, window_at: int, ride_at: int, window_first_at: int, last_at: int, n_edges: int) -> None:
    """Add the open window to its ride, and begin the next one where it ended."""
    for j in range(ride_at - window_at):
        b[ride_at + j] += b[window_at + j]
        b[window_at + j] = 0.0
    for j in range(n_edges):
        b[window_first_at + j] = b[last_at + j]


@njit(cache=True)
def note_edges(b: Any, first_at: int, window_first_at: int, last_at: int, edges: Any, i: int) -> None:
    """Note what the last sample so far says; a state of charge may become known only after the first."""
    for j in range(edges.shape[0]):
        b[last_at + j] = edges[j, i]
    if isnan(b[first_at + SOC]):
        b[first_at + SOC] = edges[SOC, i]
    if isnan(b[window_first_at + SOC]):
        b[window_first_at + SOC] = edges[SOC, i]


@njit(cache=True)
def copy_out(row: Any, i: int, lane: int, book: Any) -> None:
    """Write the row of the batch, a lane and its book into a row."""
    row[0], row[1] = i, lane
    for j in range(book.shape[0]):
        row[_BEFORE + j] = book[j]


@njit(cache=True)
def count_bits(book: Any, at: int, bits: int) -> None:
    """Count each quality bit that is set."""
    place = at
    while bits:
        if bits & 1:
            book[place] += 1.0
        bits >>= 1
        place += 1
