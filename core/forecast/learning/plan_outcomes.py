"""Learn how far shifts go as planned: how much driving and waiting is left out, or comes on top, and the way home.

Passengers do not come, rides are longer than planned, cars are sent elsewhere, and drive home in the end, of which no
plan tells. What a car does after a forecast takes an energy by the tables of its vehicle model, and so does what was
planned. The first is regressed on the planned energy of driving and of waiting, and on that of a way home,

    energy done = f_driving driving + f_waiting waiting + f_home way home + noise,

where the variance of the noise is proportional to the expected energy. All energies are computed, not measured: neither
the consumption of the car nor its display matters (Bayesian linear regression with an estimated noise).

References
----------
Gelman et al., Bayesian Data Analysis, 3rd edition, sections 14.2 and 14.8, ISBN 978-1-4398-4095-5.
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.forecast.conformal import DAY_MEMORY, weigh_day
from socast.core.totals.day_sums import DailyLearner

PLAN_PARTS: Final = "driving", "waiting", "way_home"
"""Parts of a planned energy; no plan tells of the last one."""
_HOME: Final = PLAN_PARTS.index("way_home")
WAY_HOME: Final = 5.0
"""Distance of the way home that counts once; how much of it is driven is learned. [km]"""
PRIOR_MEAN: Final = np.array([1.0, 1.0, 0.0])
PRIOR_SD: Final = np.array([0.1, 0.2, 0.7])
"""Mean and standard deviation of the share that is done of each part, before any outcome. [1]"""
PRIOR_SPREAD: Final = 0.05
"""Variance of the energy of what is done beside that of 1 kWh that is planned, before any outcome. [kWh^2/kWh]"""
PRIOR_SHIFTS: Final = 10.0
"""Number of shifts whose weight that has."""
LEAST_KWH: Final = 0.2
"""Expected energy from which a forecast teaches. [kWh]"""
LARGEST_RESIDUAL_SDS: Final = 3.0
"""A larger error counts as this one. [standard deviations]"""
FACTOR_LIMITS: Final = np.array([0.3, 0.3, 0.0]), np.array([2.0, 2.0, 3.0])
"""Limits of these shares. [1]"""


class PlanOutcomes(DailyLearner):
    """Learn what is done of what is planned.

    Attributes
    ----------
    factor, covariance : Energy done over planned energy of each part, (parts,), and their covariance. [1]
    spread : Variance of the energy done beside that of 1 kWh that is planned. [kWh^2/kWh]
    """

    def __init__(self) -> None:
        n = len(PLAN_PARTS)
        super().__init__(matrix=(n, n), right=(n,), squares=(), shifts=())

    def add_shift(self, planned: Floats, done: Floats) -> None:
        """Add the n forecasts of a shift, all together with the weight of one, for the next daily update.

        Units: planned [kWh], (n, parts); done [kWh].
        """
        expected = planned @ self.factor
        rows = np.flatnonzero(np.isfinite(expected + done) & (expected > LEAST_KWH))
        if not len(rows):
            return
        terms, expected = planned[rows], expected[rows]
        variance = self.spread * expected
        limit = LARGEST_RESIDUAL_SDS * np.sqrt(variance)
        clipped = np.clip(done[rows] - expected, -limit, limit)
        extra = clipped + terms @ (self.factor - PRIOR_MEAN)
        self.today.add("matrix", (terms / variance[:, np.newaxis]).T @ terms / len(rows))
        self.today.add("right", (terms / variance[:, np.newaxis]).T @ extra / len(rows))
        self.today.add("squares", float(np.mean(clipped**2 / expected)))
        self.today.add("shifts", 1.0)

    def apply_daily_update(self) -> None:
        """Let the shifts since the last daily update take effect."""
        if shifts := int(self.today.get("shifts")):
            self.take_day(DAY_MEMORY, weigh_day(shifts))

    def fit(self) -> None:
        """Compute factors, covariance and spread from the sums."""
        self.covariance = np.linalg.inv(self.known.get("matrix") + np.diag(PRIOR_SD**-2.0))
        factor = PRIOR_MEAN + self.covariance @ self.known.get("right")
        of_home = self.covariance[_HOME] / self.covariance[_HOME, _HOME]
        factor -= of_home * min(factor[_HOME], 0.0)  # given that a way home is not below none
        self.factor = np.clip(factor, *FACTOR_LIMITS)
        squares, shifts = float(self.known.get("squares")), float(self.known.get("shifts"))
        self.spread = (PRIOR_SHIFTS * PRIOR_SPREAD + squares) / (PRIOR_SHIFTS + shifts)
