"""Duration and intensity of the newest shifts of each car, and what they let expect of the rest of one in progress.

A car without a plan repeats one of its earlier shifts: of those that were longer than the present one is already, each
is as likely. Their mean is expected; how far they differ, and how few they are, is the uncertainty.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, sum_weighted

LEAST_SHIFTS: Final = 3
"""Number of shifts from which the rest of a shift is expected."""
KEPT_SHIFTS: Final = 20
"""Number of newest shifts of a car that are remembered."""
SHIFT_SPREAD: Final = 0.3
"""Standard deviation of the rest of a shift over its mean, before any shift. [1]"""
SPREAD_SHIFTS: Final = 2.0
"""Number of shifts whose weight that spread has."""
SHIFT_PATTERNS: Final = np.dtype([(name, "f8", (KEPT_SHIFTS,)) for name in ("hours", "relative_power")])
"""Durations of a car's newest shifts [h], and their energies over the usual energy of as many hours [1]."""
NO_SHIFTS: Final = np.full(2 * KEPT_SHIFTS, np.nan).view(SHIFT_PATTERNS)[0]
"""Those of a car that has ended none."""


class RestOfShift(NamedTuple):
    """Hold what is expected of the rest of n shifts, (n,) float each, NaN where no known shift was as long.

    Parameters
    ----------
    hours : Mean of the time until the end. [h]
    work, work_sd : Mean and standard deviation of the energy until then, over the usual energy of an hour. [h]
    """

    hours: Floats
    work: Floats
    work_sd: Floats


def remember_shift(known: Any, hours: float, relative_power: float) -> None:
    """Add the newest shift of a car to those that are known of it, one row of SHIFT_PATTERNS."""
    for of_car, value in zip(known, (hours, relative_power), strict=True):
        of_car[1:] = of_car[:-1].copy()
        of_car[0] = value


def expect_rest(patterns: NDArray[np.void], elapsed: Floats) -> RestOfShift:
    """Return what is expected of the rest of shifts, by (n,) SHIFT_PATTERNS and the time since they began [s]."""
    hours, power = patterns["hours"], patterns["relative_power"]
    left = hours - elapsed[:, np.newaxis] / 3600.0
    longer = (left > 0.0) & np.isfinite(hours[:, [LEAST_SHIFTS - 1]])
    number = longer.sum(axis=1)
    left, work = np.where(longer, left, 0.0), np.where(longer, power * left, 0.0)
    weights = longer / np.maximum(number, 1)[:, np.newaxis]
    mean = sum_weighted(work, weights)
    squares = number * sum_weighted((work - mean[:, np.newaxis]) ** 2, weights)
    variance = (squares + SPREAD_SHIFTS * (SHIFT_SPREAD * mean) ** 2) / (number - 1.0 + SPREAD_SHIFTS)
    of_next = variance * (1.0 + 1.0 / np.maximum(number, 1))
    known = np.where(number > 0, 1.0, np.nan)
    return RestOfShift(known * sum_weighted(left, weights), known * mean, known * np.sqrt(of_next))
