"""Learn how far shifts go as planned: how much driving and waiting is left out, or comes on top, and the way home.

Passengers do not come, rides are longer than planned, cars are sent elsewhere, and in the end they drive home, which is
in no plan. What a car does after a forecast takes an energy by the tables of its vehicle model, and so does what was
planned. The first is regressed on the planned energy of driving and of waiting, and on that of a way home,

    energy done = f_driving driving + f_waiting waiting + f_home way home + noise,

where the variance of the noise is proportional to the expected energy. All energies are computed, not measured: neither
the consumption of the car nor its display matters.
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.forecast.conformal import DAY_MEMORY, weigh_day
from socast.core.totals.day_sums import DailyRegression, NoisePrior

PLAN_PARTS: Final = "driving_kwh", "waiting_kwh", "way_home_kwh"
"""Parts of the energy that is expected of a plan; the way home is in no plan."""
_HOME: Final = PLAN_PARTS.index("way_home_kwh")
WAY_HOME: Final = 5.0
"""Distance of a way home whose learned share is 1. [km]"""
PRIOR_MEAN: Final = np.array([1.0, 1.0, 0.0])
PRIOR_SD: Final = np.array([0.1, 0.2, 0.7])
"""Mean and standard deviation of the share that is done of each part, before any outcome. [1]"""
SPREAD: Final = NoisePrior(0.05, 10.0)
"""Variance of the energy of what is done beside that of 1 kWh that is planned, before any outcome [kWh^2/kWh], with the
weight of as many shifts."""
LEAST_KWH: Final = 0.2
"""Expected energy from which a forecast teaches. [kWh]"""
LARGEST_RESIDUAL_SDS: Final = 3.0
"""A larger error counts as this one. [standard deviations]"""
FACTOR_LIMITS: Final = np.array([0.3, 0.3, 0.0]), np.array([2.0, 2.0, 3.0])
"""Limits of these shares. [1]"""


class PlanOutcomes(DailyRegression):
    """Learn what is done of what is planned; the coefficients are the shares that come on top of `PRIOR_MEAN`.

    Attributes
    ----------
    factor, covariance : Energy done over planned energy of each part, (parts,), and their covariance. [1]
    variance : Variance of the energy that is done where 1 kWh is expected. [kWh^2/kWh]
    """

    def __init__(self) -> None:
        super().__init__(PRIOR_SD, SPREAD)

    def add_shift(self, planned: Floats, done: Floats) -> None:
        """Add the n forecasts of a shift, all together with the weight of one, for the next daily update.

        Units: planned [kWh], (n, parts); done [kWh].
        """
        expected = planned @ self.factor
        rows = np.flatnonzero(np.isfinite(expected + done) & (expected > LEAST_KWH))
        if len(rows):
            planned, expected = planned[rows], expected[rows]
            of_shares = np.einsum("ni,ij,nj->n", planned, self.covariance, planned)
            limit = LARGEST_RESIDUAL_SDS * np.sqrt(self.variance * expected + of_shares)
            clipped = expected + np.clip(done[rows] - expected, -limit, limit)
            self.observe(planned, clipped - planned @ PRIOR_MEAN, expected)

    def apply_daily_update(self) -> None:
        """Let the shifts since the last daily update take effect."""
        if shifts := int(self.today.get("weight")):
            self.take_day(DAY_MEMORY, weigh_day(shifts))

    def fit(self) -> None:
        """Compute the factors from the known sums."""
        super().fit()
        factor = PRIOR_MEAN + self.coefficients
        of_home = self.covariance[_HOME] / self.covariance[_HOME, _HOME]
        factor -= of_home * min(factor[_HOME], 0.0)  # most probable where that of the way home is not negative
        self.factor = np.clip(factor, *FACTOR_LIMITS)
