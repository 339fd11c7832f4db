"""Guess whether the rows of a table carry only what changed, and then a period for samples."""

from typing import Final, NamedTuple

import numpy as np

from core.batch import Floats
from tools.importers.table.sampling import HOLD
from tools.importers.table.units import POWER

PERIODS: Final = (1.0, 2.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 60.0)
"""Periods that are proposed. [s]"""
TOGETHER: Final = 0.5
"""Share of the rows with speed that hold power, or the reverse, below which rows carry only what changed. [1]"""
LONGEST_STEP: Final = 300.0
"""Longest time between two values that counts as one step. [s]"""


class GuessedRows(NamedTuple):
    """Hold how rows become samples.

    Parameters
    ----------
    period, hold : float
        Time between samples, and the age up to which a value stays known. [s]
    reason : str
        Why.
    """

    period: float
    hold: float
    reason: str


def guess_rows(rows: np.ndarray) -> GuessedRows | None:
    """Return how rows become samples; None where each row is a sample.

    Parameters
    ----------
    rows : structured array
        Rows in the order of time, those of one car and time joined.
    """
    names = rows.dtype.names or ()
    energy = [name for name in ("battery_current_a", POWER) if name in names]
    if "speed_kmh" not in names or not energy:
        return None
    speed = np.isfinite(rows["speed_kmh"])
    power = np.logical_or.reduce([np.isfinite(rows[name]) for name in energy])
    fewer, both = int(min(speed.sum(), power.sum())), int((speed & power).sum())
    if not fewer or both >= TOGETHER * fewer:
        return None
    step = max(_measure_step(rows, speed), _measure_step(rows, power))
    period = next((each for each in PERIODS if each >= 0.9 * step), PERIODS[-1])
    hold = max(HOLD, 3.0 * period)
    share = f"{both / fewer:.0%} of the rows with the one of speed and power hold the other"
    return GuessedRows(period, hold, f"{share}; each changes every {step:.2g} s")


def _measure_step(rows: np.ndarray, known: Floats) -> float:
    """Return the usual time between two rows in which a field is known. [s]"""
    chosen = rows[known]
    chosen = chosen[np.argsort(chosen["vehicle"], kind="stable")]
    step = np.diff(chosen["time"])[np.diff(chosen["vehicle"]) == 0]
    step = step[(step > 0) & (step <= LONGEST_STEP)]
    return float(np.median(step)) if len(step) else HOLD
