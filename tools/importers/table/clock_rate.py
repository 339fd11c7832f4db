"""Recognise clocks that stand still: columns of times in which far more rows follow each other than a logger writes."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.tools.importers.table.agreement import Check
from socast.tools.importers.table.agreement_sums import LONGEST_STEP
from socast.tools.importers.table.units import POWER

SHORTEST_PERIOD: Final = 0.005
"""Mean time between two rows below which a clock is wrong: loggers of drives write at most 100 rows in a second. [s]"""
FEWEST_ROWS: Final = 100
"""Rows from which a clock is judged."""
STEADY: Final = 0.9
"""Share of the steps of a count that are larger than 0. [1]"""
CLOCK_RATE: Final = "clock against rows"
"""Name of the check that the times of rows are far enough apart."""


class ClockRate:
    """Sum the time that rows cover, without gaps, for each car."""

    def __init__(self) -> None:
        self.rows: dict[int, int] = {}
        self.powered: dict[int, int] = {}
        self.covered: dict[int, float] = {}

    def add(self, rows: np.ndarray) -> None:
        """Add rows of one block of a file."""
        for vehicle in np.unique(rows["vehicle"]).tolist():
            of_car = rows[rows["vehicle"] == vehicle]
            times, known = of_car["time"], np.zeros(len(of_car), bool)
            for name in {"battery_current_a", POWER} & set(rows.dtype.names or ()):
                known |= np.isfinite(of_car[name])
            self.powered[vehicle] = self.powered.get(vehicle, 0) + int(known.sum())
            self.rows[vehicle] = self.rows.get(vehicle, 0) + len(times)
            self.covered[vehicle] = self.covered.get(vehicle, 0.0) + sum_close_steps(times)

    def find_power_step(self, vehicle: int) -> float:
        """Return the mean time between two rows of a car with a power, infinite without one. [s]"""
        count = self.powered.get(vehicle, 0)
        return self.covered[vehicle] / count if count else np.inf

    def find_fault(self, vehicles: Mapping[int, str] | list[str], column: str) -> Check | None:
        """Return a failed check of the first car whose rows follow each other too fast, None where there is none."""
        for vehicle, count in self.rows.items():
            covered = self.covered[vehicle]
            if count >= FEWEST_ROWS and covered < SHORTEST_PERIOD * count:
                return Check(
                    CLOCK_RATE,
                    f"{count:,} rows of {vehicles[vehicle]} cover {describe_rate(count, covered)}",
                    f"at least {SHORTEST_PERIOD * 1e3:g} ms between rows",
                    False,
                    f"the times in column '{column}' are wrong: name another column in [time]; where that counts from "
                    f"0, give its unit and origin_column = '{column}'",
                )
        return None


def describe_rate(rows: int, covered: float) -> str:
    """Return how much time rows cover, and how far apart they are on average.

    Units: covered [s].

    Examples
    --------
    >>> describe_rate(30384, 76.0)
    '76 s without gaps, 2.5 ms a row'
    """
    return f"{covered:.3g} s without gaps, {covered / rows * 1e3:.2g} ms a row"


def is_too_fast(times: Floats) -> bool:
    """Return whether rows follow each other faster than any logger writes them.

    Parameters
    ----------
    times : (n,) float
        Times of the rows of a file, in its order, NaN where unknown. [s]
    """
    known = times[np.isfinite(times)]
    return len(known) >= FEWEST_ROWS and sum_close_steps(known) < SHORTEST_PERIOD * len(known)


def is_steady(times: Floats) -> bool:
    """Return whether nearly every row is later than the row before it."""
    known = times[np.isfinite(times)]
    return len(known) > 1 and bool(np.mean(np.diff(known) > 0.0) > STEADY)


def sum_close_steps(times: Floats) -> float:
    """Return the time between rows that lie close together. [s]"""
    steps = np.diff(np.sort(times))
    return float(steps[steps <= LONGEST_STEP].sum())
