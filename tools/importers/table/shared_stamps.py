"""Give rows of one car that share a stamp times of their own: stamps cut to whole minutes, or times of sending.

A stamp that is cut (floored) to a quantum of 60, 10 or 1 s stands for all rows of that quantum. Rows of a full quantum
lie evenly in it; the rows of a first one end with it, and those of a last one begin with it. A stamp that is a time of
sending stands for the rows since the one before. The number of rows per stamp, against the time to the stamp before and
after it, tells which of both holds, and the period.

Rows that share a stamp and hold different fields are parts of one row and stay together.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints

QUANTA: Final = (60.0, 30.0, 20.0, 15.0, 10.0, 5.0, 2.0, 1.0)
"""Quanta to which loggers cut their stamps. [s]"""
LEAST_SHARED: Final = 0.2
"""Share of the rows of a car that share a stamp from which stamps are taken for shared; fewer are left alone. [1]"""
MOST_GROUPS: Final = 1000
"""Stamps of a car from which its way of stamping is found."""
ON_QUANTUM: Final = 0.98
"""Share of stamps that are whole quanta. [1]"""
IN_ROW: Final = 0.6
"""Share of stamps that are followed by the next quantum, of stamps that are cut to it. [1]"""
FULL: Final = 0.9
"""Share of its usual rows from which a quantum is full; one row less is full too. [1]"""
NEAR: Final = 0.3
"""Deviation of the rows per time of a stamp from the usual ones up to which it fits. [1]"""
MOST_MISFITS: Final = 0.3
"""Share of stamps that do not fit, beyond which nothing shows when the rows were taken. [1]"""
COPIES: Final = 0.9
"""Share of rows that repeat the row before, of a table that holds rows twice. [1]"""
LEFT_OUT: Final = "a stamp shared by rows of which some are missing, so that their times are not known"
"""Cause: a row that cannot be placed in time."""


class StampRule(NamedTuple):
    """Describe how a car stamps its rows.

    Parameters
    ----------
    kind : str
        `cut`, `sent after` (time of sending), `sent before` (the rows follow the stamp) or `unknown`.
    quantum : float
        Time for which a cut stamp stands, 0 for others. [s]
    period : float
        Usual time between two rows. [s]
    reach : float
        Longest time for which a stamp stands. [s]
    is_reversed : bool
        Whether the file holds the newest row first.
    """

    kind: str
    quantum: float
    period: float
    reach: float
    is_reversed: bool

    def describe(self) -> str:
        """Return what was found, and how rows are placed."""
        if self.kind == "cut":
            return f"stamps cut to {self.quantum:g} s: rows spread evenly over them, one every {self.period:.3g} s"
        if self.kind == "unknown":
            return "nothing shows when the rows of a stamp were taken: they are left out"
        side = "before" if self.kind == "sent after" else "after"
        return f"stamps of sending: rows spread evenly over the time {side} them, one every {self.period:.3g} s"


class _Groups(NamedTuple):
    """Hold the stamps of a car in the order of the file, how many rows share each, and what was counted of them."""

    stamps: list[Floats]
    sizes: list[Ints]


class StampStatistics:
    """Count over the rows of files how many rows share a stamp."""

    def __init__(self) -> None:
        self._groups: dict[int, _Groups] = defaultdict(lambda: _Groups([], []))
        self._kept: dict[int, int] = defaultdict(int)
        self._most: dict[int, int] = defaultdict(int)
        self._rows: dict[int, int] = defaultdict(int)
        self._shared: dict[int, int] = defaultdict(int)
        self._copies: dict[int, int] = defaultdict(int)

    def add(self, rows: np.ndarray) -> None:
        """Add rows in the order of a file."""
        for vehicle in np.unique(rows["vehicle"]).tolist():
            of_car = rows[rows["vehicle"] == vehicle]
            starts = np.flatnonzero(np.append(True, np.diff(of_car["time"]) != 0)[: len(of_car)])
            places = number_in_stamp(of_car, starts)
            sizes = np.maximum.reduceat(places, starts) + 1
            self._rows[vehicle] += int(sizes.sum())
            self._shared[vehicle] += int(sizes[sizes > 1].sum())
            self._most[vehicle] = max(self._most[vehicle], int(sizes.max()))
            if sizes.max() > 1:
                self._copies[vehicle] += _count_copies(of_car)
            if self._kept[vehicle] < MOST_GROUPS:
                self._groups[vehicle].stamps.append(of_car["time"][starts])
                self._groups[vehicle].sizes.append(sizes)
                self._kept[vehicle] += len(starts)

    def find_rules(self) -> dict[int, StampRule]:
        """Return how cars stamp their rows, for those of which rows share stamps."""
        return {vehicle: rule for vehicle in self._groups if (rule := self._find_rule(vehicle)) is not None}

    def _find_rule(self, vehicle: int) -> StampRule | None:
        """Return how a car stamps its rows, None where each row has a stamp of its own."""
        shared = self._shared[vehicle]
        if shared < LEAST_SHARED * self._rows[vehicle] or not shared:
            return None
        stamps = np.concatenate(self._groups[vehicle].stamps)
        sizes = np.concatenate(self._groups[vehicle].sizes).astype("f8")
        usual = float(np.median(sizes[sizes > 1])) if (sizes > 1).any() else 2.0
        if usual <= 3.0 and self._copies[vehicle] >= COPIES * shared * (1.0 - 1.0 / usual):
            return None
        steps = np.diff(stamps)
        is_reversed = bool((steps < 0).sum() > (steps > 0).sum())
        if is_reversed:
            stamps, sizes = stamps[::-1], sizes[::-1]
        order = np.argsort(stamps, kind="stable")
        kind, quantum, period = _find_kind(stamps[order], sizes[order])
        reach = max(quantum, self._most[vehicle] * period)
        return StampRule(kind, quantum, period, reach, is_reversed)


def number_in_stamp(rows: np.ndarray, starts: Ints) -> Ints:
    """Return which row of its stamp each row belongs to; rows with other fields than those before belong together."""
    places = np.zeros(len(rows), "i8")
    if len(starts) == len(rows):
        return places
    lengths = np.diff(np.append(starts, len(rows)))
    for name in rows.dtype.names or ():
        if name in {"time", "vehicle", "ride"}:
            continue
        known = np.isfinite(rows[name])
        before = np.cumsum(known) - known
        np.maximum(places, np.where(known, before - np.repeat(before[starts], lengths), 0), out=places)
    return places


def _count_copies(rows: np.ndarray) -> int:
    """Return the number of rows that repeat all fields of the row before with the same stamp."""
    same = np.ones(len(rows) - 1, bool)
    for name in rows.dtype.names or ():
        if name != "ride":
            first, second = rows[name][:-1], rows[name][1:]
            same &= (first == second) | (np.isnan(first) & np.isnan(second))
    return int(same.sum())


def _find_kind(stamps: Floats, sizes: Floats) -> tuple[str, float, float]:
    """Return how stamps are made, their quantum and the period of the rows."""
    if len(stamps) < 2:
        return "unknown", 0.0, 0.0
    steps = np.diff(stamps)
    for quantum in QUANTA:
        off = np.abs(stamps / quantum - np.round(stamps / quantum)) * quantum
        follows = np.abs(steps - quantum) < 1e-3
        if np.mean(off < 1e-3) < ON_QUANTUM or not follows.any() or follows.mean() < IN_ROW:
            continue
        inner = np.append(False, follows) & np.append(follows, False)
        counts = sizes[inner] if inner.any() else sizes[np.append(follows, False) | np.append(False, follows)]
        full = counts[counts >= FULL * np.median(counts) - 1.0]
        if not inner.any():
            full = np.array([sizes.max()])
        elif np.mean(counts < FULL * np.median(counts) - 1.0) > MOST_MISFITS:
            return "unknown", 0.0, 0.0
        return "cut", quantum, quantum / float(full.mean())
    fits = []
    for kind, of in (("sent after", sizes[1:]), ("sent before", sizes[:-1])):
        near = steps <= 3.0 * np.median(steps)
        rate = steps[near] / of[near]
        period = float(np.median(rate))
        fits.append((float(np.mean(np.abs(rate / period - 1.0) > NEAR)), kind, period))
    misfits, kind, period = min(fits)
    return (kind, 0.0, period) if misfits <= MOST_MISFITS else ("unknown", 0.0, 0.0)


def spread_rows(
    blocks: Iterable[np.ndarray], rules: Mapping[int, StampRule], counts: dict[int, int], left_out: dict[int, int]
) -> Iterator[np.ndarray]:
    """Yield rows in the order of time, with times of their own.

    Parameters
    ----------
    blocks : iterable of structured arrays
        Rows in the order of time and vehicle; a block holds all rows of a time.
    counts, left_out : dict of int to int
        Receive the number of rows of each car that were placed, and that could not be.
    """
    if not rules:
        yield from blocks
        return
    spreader = _Spreader(rules, counts, left_out)
    for rows in blocks:
        if len(ready := spreader.take(rows)):
            yield ready
    if len(ready := spreader.finish()):
        yield ready


class _Spreader:
    """Hold rows whose place depends on later ones, and those that must wait for them."""

    def __init__(self, rules: Mapping[int, StampRule], counts: dict[int, int], left_out: dict[int, int]) -> None:
        self.rules, self.counts, self.left_out = rules, counts, left_out
        self.reach = max(rule.reach for rule in rules.values()) + 1.0
        self._open: np.ndarray | None = None
        self._placed: list[np.ndarray] = []
        self._last: dict[int, float] = {}

    def take(self, rows: np.ndarray) -> np.ndarray:
        """Return the rows before which no later row can come."""
        if not len(rows):
            return rows
        end = float(rows["time"][-1])
        rows = rows if self._open is None else np.concatenate([self._open, rows])
        is_due = rows["time"] <= end - self.reach
        self._open = rows[~is_due].copy()
        self._place(rows[is_due])
        return self._release(end - 2.0 * self.reach)

    def finish(self) -> np.ndarray:
        """Return the rows that waited."""
        rows, self._open = self._open, None
        if rows is not None:
            self._place(rows)
        return self._release(np.inf)

    def _place(self, rows: np.ndarray) -> None:
        """Give rows their times; rows after them may still be open."""
        has_rule = np.isin(rows["vehicle"], list(self.rules))
        self._placed.append(rows[~has_rule])
        for vehicle in np.unique(rows["vehicle"][has_rule]).tolist():
            of_car = rows[rows["vehicle"] == vehicle].copy()
            following = np.inf
            if self._open is not None and (later := self._open["time"][self._open["vehicle"] == vehicle]).size:
                following = float(later[0])
            starts = np.flatnonzero(np.append(True, np.diff(of_car["time"]) > 0))
            stamps = of_car["time"][starts]
            before = np.append(self._last.get(vehicle, -np.inf), stamps[:-1])
            times = place_in_time(of_car, starts, before, np.append(stamps[1:], following), self.rules[vehicle])
            self._last[vehicle] = float(stamps[-1])
            known = np.isfinite(times)
            self.counts[vehicle] = self.counts.get(vehicle, 0) + int(known.sum())
            self.left_out[vehicle] = self.left_out.get(vehicle, 0) + int((~known).sum())
            of_car["time"] = times
            self._placed.append(of_car[known])

    def _release(self, bound: float) -> np.ndarray:
        """Return placed rows before a time."""
        rows = np.concatenate(self._placed)
        rows = rows[np.lexsort((rows["vehicle"], rows["time"]))]
        end = int(np.searchsorted(rows["time"], bound, "left"))
        self._placed = [rows[end:].copy()]
        return rows[:end]


def place_in_time(rows: np.ndarray, starts: Ints, before: Floats, after: Floats, rule: StampRule) -> Floats:
    """Return the time of each row of a car, NaN where nothing shows it. [s]"""
    lengths = np.diff(np.append(starts, len(rows)))
    places = number_in_stamp(rows, starts)
    sizes = np.maximum.reduceat(places, starts) + 1
    stamps = rows["time"][starts]
    if rule.is_reversed:
        places = np.repeat(sizes, lengths) - 1 - places
    if rule.kind == "unknown":
        first, step = np.where(sizes == 1, stamps, np.nan), np.zeros(len(stamps))
    elif rule.kind == "cut":
        first, step = _place_cut(stamps, sizes, before, after, rule)
    else:
        first, step = _place_sent(stamps, sizes, before, after, rule)
    times: Floats = np.repeat(first, lengths) + places * np.repeat(step, lengths)
    return times


def _place_cut(stamps: Floats, sizes: Ints, before: Floats, after: Floats, rule: StampRule) -> tuple[Floats, Floats]:
    """Return the first time and the step of the rows of cut stamps."""
    quantum, period = rule.quantum, rule.period
    goes_on, went_on = after - stamps < 1.5 * quantum, stamps - before < 1.5 * quantum
    is_inner = goes_on & went_on
    is_full = sizes >= FULL * quantum / period - 1.0
    step = np.where(is_inner, quantum / sizes, np.minimum(period, quantum / sizes))
    # the first rows of a recording end with their quantum, the last ones begin with it
    first = np.where(goes_on & ~went_on, stamps + quantum - sizes * step, stamps)
    return np.where(is_full | ~is_inner, first, np.nan), step


def _place_sent(stamps: Floats, sizes: Ints, before: Floats, after: Floats, rule: StampRule) -> tuple[Floats, Floats]:
    """Return the first time and the step of the rows of stamps of sending."""
    is_after = rule.kind == "sent after"
    room = np.where(is_after, stamps - before, after - stamps)
    share = room / (sizes * rule.period)
    fits = np.abs(share - 1.0) <= 0.5
    step = np.where(fits, np.where(fits, room, 0.0) / sizes, np.minimum(rule.period, room / sizes))
    return (stamps - (sizes - 1) * step if is_after else stamps), step
