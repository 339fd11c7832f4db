"""Sort rows by time on disk, so that files in any order and of any size need bounded memory."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

RUN_ROWS: Final = 1_000_000
"""Rows that are sorted in memory at a time."""
WINDOW_ROWS: Final = 100_000
"""Approximate number of rows that are returned at a time."""

MARKS: Final = 100
"""Marks of time per window, by which the rows of runs on disk are divided."""


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
