"""Bring the rows of all files into the order of time on disk, and find times that files cover twice for one car."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.tools.importers.table.units import POWER

RUN_ROWS: Final = 1_000_000
"""Rows that are sorted in memory at a time."""
WINDOW_ROWS: Final = 100_000
"""Approximate number of rows that are returned at a time."""

MARKS: Final = 100
"""Marks of time per window, by which the rows of runs on disk are divided."""
BACKWARD: Final = 60.0
"""Step back between two rows of a file, in the order of the file, from which a new part of the file begins. [s]"""
LEAST: Final = 60.0
"""Time that must be covered twice; less is the end of one ride and the start of the next. [s]"""
LEAST_SHARE: Final = 0.5
"""Share of the shorter part that is covered twice, where this is less than `LEAST`. [1]"""
MOST_PARTS: Final = 0.01
"""Parts per row of a file above which its rows are in no order, and the file counts as one part. [1]"""
COVERED_TWICE: Final = (
    "a time that their file covers twice (its clock steps back: set zone in [time] where it is local time, or divide "
    "the file)"
)
"""Cause for which rows are left out: two drives in one would be a third one that nobody drove."""
KEY_FIELDS: Final = ("speed_kmh", POWER, "battery_current_a", "soc_pct", "odometer_km")
"""Fields of which the first that the map has is compared: files with other fields may cover the same time."""


def sort_rows(
    blocks: Iterable[np.ndarray], folder: Path, run_rows: int = RUN_ROWS, window_rows: int = WINDOW_ROWS
) -> Iterator[np.ndarray]:
    """Yield rows in the order of time and vehicle; rows of equal time and vehicle keep their order."""
    marked = max(1, window_rows // MARKS)
    with TemporaryDirectory(prefix=".import-", dir=folder) as name:
        runs: list[_Run] = []
        held: list[np.ndarray] = []
        for block in blocks:
            held.append(block)
            if sum(map(len, held)) >= run_rows:
                runs.append(_Run(_sort(held), Path(name) / f"{len(runs)}.rows", marked))
                held.clear()
        if not runs:
            yield from _divide(held, window_rows)
            return
        if sum(map(len, held)):
            runs.append(_Run(_sort(held), Path(name) / f"{len(runs)}.rows", marked))
        held.clear()
        yield from _merge(runs, window_rows // marked)


class _Run:
    """Hold sorted rows in a file and return them in the order of time."""

    def __init__(self, rows: np.ndarray, path: Path, marked: int) -> None:
        self.marks = rows["time"][::marked].copy()
        self._path, self._dtype, self._size, self._read = path, rows.dtype, len(rows), 0
        self._block = marked
        self._buffer = rows[:0].copy()
        rows.tofile(path)

    def take(self, bound: float) -> np.ndarray:
        """Return the rows before a time that were not returned yet."""
        parts = [self._buffer]
        while self._read < self._size and not (len(parts[-1]) and parts[-1]["time"][-1] >= bound):
            offset = self._read * self._dtype.itemsize
            parts.append(np.fromfile(self._path, self._dtype, self._block, offset=offset))
            self._read += len(parts[-1])
        rows = np.concatenate(parts)
        end = int(np.searchsorted(rows["time"], bound, "left"))
        self._buffer = rows[end:].copy()
        return rows[:end]


def _sort(parts: list[np.ndarray]) -> np.ndarray:
    """Return rows in the order of time and vehicle."""
    rows = np.concatenate(parts)
    return rows[np.lexsort((rows["vehicle"], rows["time"]))]


def _divide(parts: list[np.ndarray], window_rows: int) -> Iterator[np.ndarray]:
    """Yield the rows of blocks in spans of time."""
    if not parts:
        return
    rows = _sort(parts)
    bounds = np.unique(np.searchsorted(rows["time"], rows["time"][window_rows::window_rows], "left"))
    yield from (part for part in np.split(rows, bounds) if len(part))


def _merge(runs: list[_Run], per_window: int) -> Iterator[np.ndarray]:
    """Yield the rows of sorted runs in spans of time."""
    marks = np.sort(np.concatenate([run.marks for run in runs]))
    for bound in np.unique(np.append(marks[per_window::per_window], np.inf)).tolist():
        rows = _sort([run.take(bound) for run in runs])
        if len(rows):
            yield rows


class Overlap(NamedTuple):
    """Hold what is covered twice.

    Parameters
    ----------
    files : tuple of str
        Files that cover time twice, one where it is a file whose clock steps back.
    duration : float
        Time that is covered twice. [s]
    start : float
        First such time. [Unix s]
    """

    files: tuple[str, ...]
    duration: float
    start: float
    vehicle: int


class _Part(NamedTuple):
    """Hold the span of rows that follow each other in a file."""

    start: float
    end: float
    file: str


class TimeSpans:
    """Collect the spans of time that each file covers for each car."""

    def __init__(self) -> None:
        self._parts: dict[int, dict[str, list[Floats]]] = defaultdict(lambda: defaultdict(list))
        self._rows: dict[tuple[int, str], int] = defaultdict(int)
        self._steps_back: dict[tuple[int, str], int] = defaultdict(int)

    def add(self, file: str, rows: np.ndarray) -> None:
        """Add rows of a file, in the order of the file."""
        names = rows.dtype.names or ()
        key = next((name for name in KEY_FIELDS if name in names), None)
        known = rows if key is None else rows[np.isfinite(rows[key])]
        for vehicle in np.unique(known["vehicle"]).tolist():
            times = known["time"][known["vehicle"] == vehicle]
            parts = self._parts[vehicle][file]
            cuts = np.flatnonzero(np.diff(times) < -BACKWARD) + 1
            is_ordered = len(cuts) <= 1 + MOST_PARTS * len(times)
            new = [
                np.array([part.min(), part.max(), part[-1]])
                for part in (np.split(times, cuts) if is_ordered else [times])
            ]
            if parts and times[0] - parts[-1][2] >= -BACKWARD:
                last = parts.pop()
                new[0] = np.array([min(last[0], new[0][0]), max(last[1], new[0][1]), new[0][2]])
            parts += new
            self._rows[vehicle, file] += len(times)
            self._steps_back[vehicle, file] += len(cuts)

    def find_overlap(self) -> Overlap | None:
        """Return what is covered twice, None where nothing is."""
        files: set[str] = set()
        duration, start, car = 0.0, np.inf, -1
        for vehicle, of_files in self._parts.items():
            twice = _find_twice(self._list_parts(vehicle, of_files))
            for first, second, length in twice:
                files |= {first.file, second.file}
                duration += length
                if second.start < start:
                    start, car = second.start, vehicle
        return Overlap(tuple(sorted(files)), duration, float(start), car) if files else None

    def list_steps_back(self) -> dict[int, list[tuple[float, float]]]:
        """Return the first and last times [Unix s] that one file covers twice, of each car that has some."""
        found = {}
        for vehicle, of_files in self._parts.items():
            twice = _find_twice(self._list_parts(vehicle, of_files))
            times = [
                (second.start, second.start + length) for first, second, length in twice if first.file == second.file
            ]
            if times:
                found[vehicle] = times
        return found

    def _list_parts(self, vehicle: int, of_files: Mapping[str, list[Floats]]) -> list[_Part]:
        """Return the parts of all files of a car in the order of time; a file in no order is one part."""
        parts = []
        for file, spans in of_files.items():
            ends = np.array(spans)
            if self._steps_back[vehicle, file] > 1 + MOST_PARTS * self._rows[vehicle, file]:
                ends = np.array([[ends[:, 0].min(), ends[:, 1].max(), 0.0]])
            parts += [_Part(float(low), float(high), file) for low, high, _ in ends]
        return sorted(parts)


def _find_twice(parts: list[_Part]) -> list[tuple[_Part, _Part, float]]:
    """Return pairs of parts that cover the same time, and for how long the second of them does so. [s]"""
    found = []
    before: _Part | None = None
    for part in parts:
        if before is not None:
            length = min(before.end, part.end) - part.start
            shorter = min(before.end - before.start, part.end - part.start)
            if length > min(LEAST, LEAST_SHARE * shorter) and length > 0.0:
                found.append((before, part, length))
        if before is None or part.end > before.end:
            before = part
    return found


def leave_out_covered_twice(
    blocks: Iterable[np.ndarray], spans: TimeSpans, causes: Counter[str]
) -> Iterator[np.ndarray]:
    """Yield rows without those that one file has beside others at the same times, and count these.

    A row that is there twice is kept, as where a file holds its content twice.

    Parameters
    ----------
    blocks : iterable of structured arrays
        Rows in the order of time and vehicle; the first block comes when all files are read.
    """
    twice: dict[int, list[tuple[float, float]]] | None = None
    for rows in blocks:
        twice = spans.list_steps_back() if twice is None else twice
        wrong = np.zeros(len(rows), bool)
        for vehicle, times in twice.items():
            for start, end in times:
                wrong |= (rows["vehicle"] == vehicle) & (rows["time"] >= start) & (rows["time"] <= end)
        if wrong.any():
            wrong &= ~_is_repeated(rows)
            causes[COVERED_TWICE] += int(wrong.sum())
        yield rows[~wrong]


def _is_repeated(rows: np.ndarray) -> np.ndarray:
    """Return which rows equal a neighbour, (n,) bool."""
    content = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), -1)
    same = np.zeros(len(rows) + 1, bool)
    same[1:-1] = (content[1:] == content[:-1]).all(axis=1)
    return same[1:] | same[:-1]
