"""Guess from speed and power whether the power of a row is that of its moment or the mean over the time beside it.

The kinetic energy that a car gains between two rows comes from the power between them. A mean power over the time
before a row therefore follows the change of kinetic energy before the row, and not the one after it. The power of a
moment follows both alike. So does a mean with the row in its middle, which the rows cannot tell from it.
"""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import KMH, PowerSpan

FEWEST: Final = 200
"""Rows of a driving car from which a power is judged."""
LONGEST_STEP: Final = 10.0
"""Longest time between two rows that are compared. [s]"""
REGULAR: Final = 0.2
"""Largest difference of the times to the rows before and after, over their mean. [1]"""
ONE_SIDED: Final = (0.8, 1.1)
"""Shares of the kinetic power beside a row that one side of it has, with which the power covers this side. [1]

63 drives of a Model 3 with means over a second (DOI 10.1016/j.patter.2024.100950) have 0.9 to 1.0; 31 drives of a BMW
i3 (DOI 10.21227/6jr9-5235) sampled every 1 or 3 s 0.4 to 0.6, and 0.9 to 1.0 as means over the time before."""
EXPLAINED: Final = 0.9
"""Least share of the variance of the power that speed and its changes explain. [1]

A meter that lags by half a step has the shares of a mean; with steps of 3 s it usually explains less."""
SLOWEST: Final = 1.0
"""Speed above which a car drives. [m/s]"""


class SpanEvidence(NamedTuple):
    """Hold what the rows say of a power.

    Parameters
    ----------
    share : float
        Share of the kinetic power beside a row that the one before it has in the power of the row. [1]
    explained : float
        Share of the variance of the power that speed and its changes explain. [1]
    """

    share: float
    explained: float

    @property
    def span(self) -> PowerSpan | None:
        """What the power covers, None where nothing shows that it is no moment."""
        if self.explained < EXPLAINED:
            return None
        least, most = ONE_SIDED
        return "before" if least <= self.share <= most else "after" if least <= 1.0 - self.share <= most else None


def measure_span(times: Floats, speed_kmh: Floats, power: Floats) -> SpanEvidence | None:
    """Return what rows of a car say of its power, None where too few of them do.

    Units: times [s], power [W].

    Notes
    -----
    Least squares of P_i = a K_i + b K_(i+1) + c v_i + d v_i^3 + e with K_i = (v_i^2 - v_(i-1)^2) / (2 (t_i - t_(i-1))).
    The share is a / (a + b).
    """
    speed, step = speed_kmh * KMH, np.diff(times)
    kinetic = np.divide(np.diff(speed**2), 2.0 * step, out=np.full(len(step), np.nan), where=step > 0.0)
    before, after, between = step[:-1], step[1:], speed[1:-1]
    columns = np.column_stack([kinetic[:-1], kinetic[1:], between, between**3, np.ones(len(between))])
    watts = power[1:-1]
    is_regular = (np.abs(after - before) <= REGULAR * 0.5 * (before + after)) & (before <= LONGEST_STEP)
    used = is_regular & np.isfinite(watts) & np.isfinite(columns).all(axis=1) & (between > SLOWEST)
    if used.sum() < FEWEST or np.ptp(watts[used]) == 0.0:
        return None
    factors, *_ = np.linalg.lstsq(columns[used], watts[used], rcond=None)
    if factors[0] + factors[1] <= 0.0:
        return None
    left = watts[used] - columns[used] @ factors
    return SpanEvidence(float(factors[0] / (factors[0] + factors[1])), float(1.0 - left.var() / watts[used].var()))
