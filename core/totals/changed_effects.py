"""Carry the open totals of every lane over to a model with other effects."""

from collections.abc import Sequence

import numpy as np

from socast.core.cleaning.quality import CAUSES
from socast.core.columns import SPEED_BINS
from socast.core.totals.accumulator import AMOUNTS, DURATION, EDGES, OPEN_WINDOW


def carry_totals(state: bytes, before: Sequence[str], now: Sequence[str]) -> bytes:
    """Return open totals of other effects; what was not summed before is unknown until its ride ends."""
    head, width = OPEN_WINDOW + 1, len(AMOUNTS) + len(before) + SPEED_BINS
    rows = np.frombuffer(state).reshape(-1, head + 2 * width + 3 * len(EDGES) + len(CAUSES))
    place = {name: len(AMOUNTS) + number for number, name in enumerate(before)}
    parts = [rows[:, :head]]
    for begin in (head, head + width):  # of the window, and of the ride before it
        amounts = rows[:, begin : begin + width]
        unknown = np.where(amounts[:, DURATION] > 0.0, np.nan, 0.0)
        energies = [amounts[:, place[name]] if name in place else unknown for name in now]
        parts += [amounts[:, : len(AMOUNTS)], *(energy[:, None] for energy in energies), amounts[:, -SPEED_BINS:]]
    return np.hstack([*parts, rows[:, head + 2 * width :]]).tobytes()
