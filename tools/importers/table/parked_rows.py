"""Add rows between those of a parked car, whose export holds a row only every few minutes then.

A step of some minutes before a drive would look like samples that are missing from it.
"""

from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

LONGEST_STEP: Final = 900.0
"""Longest time between two rows of a parked car that is filled. [s]"""
STEP: Final = 60.0
"""Time between added rows: the longest one of a logger without a period. [s]"""
MOVED: Final = 0.1
"""Distance by the odometer from which a car did not stay where it was. [km]"""


def fill_parked(blocks: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield rows in the order of time, with copies of a row of a car that stands until its next row."""
    held: np.ndarray | None = None
    last: dict[int, np.ndarray] = {}
    for block in blocks:
        rows = block if held is None else np.concatenate([held, block])
        rows = np.concatenate([rows, *_add_rows(block, last)])
        rows = rows[np.lexsort((rows["vehicle"], rows["time"]))]
        # rows that are added later come after the last row of their car
        end = int(np.searchsorted(rows["time"], rows["time"][-1] - LONGEST_STEP, "left")) if len(rows) else 0
        held = rows[end:].copy()
        if end:
            yield rows[:end]
    if held is not None and len(held):
        yield held


def _add_rows(block: np.ndarray, last: dict[int, np.ndarray]) -> list[np.ndarray]:
    """Return the rows to add before rows of a block, after the last row of each car before it."""
    added = []
    for vehicle in np.unique(block["vehicle"]).tolist():
        rows = block[block["vehicle"] == vehicle]
        rows = np.concatenate([last[vehicle], rows]) if vehicle in last else rows
        last[vehicle] = rows[-1:].copy()
        step = np.diff(rows["time"])
        stands = (rows["speed_kmh"][:-1] == 0.0) & (rows["speed_kmh"][1:] == 0.0)
        if "odometer_km" in (rows.dtype.names or ()):
            stands &= ~(np.abs(np.diff(rows["odometer_km"])) > MOVED)
        fill = np.flatnonzero(stands & (step > 1.5 * STEP) & (step <= LONGEST_STEP))
        counts = np.ceil(step[fill] / STEP - 1.5).astype("i8")
        copies = np.repeat(rows[fill], counts)
        copies["time"] += STEP * (np.arange(len(copies)) - np.repeat(np.cumsum(counts) - counts, counts) + 1.0)
        added.append(copies)
    return added
