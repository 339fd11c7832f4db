"""Learn to which charge cars charge where their plan has a charge.

Charging ends early, or goes on beyond what dispatch had planned. The charge with which a car departs is therefore
regressed on the planned one,

    reached = planned + x_0 + x_1 (planned - 0.8) + noise,

so that the plan counts until outcomes speak against it (`socast.core.totals.day_sums`).
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.forecast.conformal import DAY_MEMORY
from socast.core.totals.day_sums import DailyRegression, NoisePrior

CENTRE: Final = 0.8
"""Planned charge at which the slope has no effect. [1]"""
PRIOR_SD: Final = np.array([0.05, 0.5])
"""Standard deviation of each coefficient before any outcome; with -1, cars charge to the same whatever the plan. [1]"""
NOISE: Final = NoisePrior(0.05**2, 4.0)
"""Variance of the noise before any outcome [1], with the weight of as many charges."""


class ChargedSoc(DailyRegression):
    """Learn the charge after planned charges: offset and slope of what is reached less what is planned. [1]"""

    def __init__(self) -> None:
        super().__init__(PRIOR_SD, NOISE)

    def add_charges(self, outcomes: Sequence[tuple[float, float]]) -> None:
        """Add planned charges with the charge that the car departed with, for the next daily update. [1]"""
        for planned, reached in outcomes:
            if np.isfinite(planned) and np.isfinite(reached):
                self.observe(np.array([[1.0, planned - CENTRE]]), np.array([reached - planned]), np.ones(1))

    def apply_daily_update(self) -> None:
        """Let the charges since the last daily update take effect."""
        if self.today.get("weight"):
            self.take_day(DAY_MEMORY)

    def expect(self, planned: Floats) -> tuple[Floats, Floats]:
        """Return the expected charge after planned charges, and its variance.

        Examples
        --------
        >>> learned = ChargedSoc()
        >>> learned.add_charges([(planned, 0.95) for planned in (0.6, 0.7, 0.8, 0.9)] * 10)
        >>> learned.apply_daily_update()
        >>> learned.expect(np.array([0.65]))[0].round(2).tolist()
        [0.95]
        """
        x = planned - CENTRE
        offset, slope = self.coefficients.tolist()
        (of_offset, of_both), (_, of_slope) = self.covariance.tolist()
        variance = self.variance + of_offset + 2.0 * of_both * x + of_slope * x**2
        return np.clip(planned + offset + slope * x, 0.0, 1.0), variance
