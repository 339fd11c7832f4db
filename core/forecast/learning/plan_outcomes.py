"""Learn how far shifts go as planned: how much driving and waiting is left out, or comes on top.

Passengers do not come, rides are longer than planned, and cars are sent elsewhere. What a car does after a forecast
takes an energy by the tables of its vehicle model, and so does what was planned. The first is regressed on the planned
energy of driving and of waiting,

    energy done = (1 + x_driving) driving + (1 + x_waiting) waiting + noise,

where the variance of the noise is proportional to the planned energy. Both energies are computed, not measured: neither
the consumption of the car nor its display matters (Bayesian linear regression with an estimated noise).

References
----------
Gelman et al., Bayesian Data Analysis, 3rd edition, sections 14.2 and 14.8, ISBN 978-1-4398-4095-5.
"""

from typing import Any, Final

import numpy as np

from socast.core.batch import Floats
from socast.core.forecast.conformal import DAY_MEMORY, weigh_day
from socast.core.totals.day_sums import DaySums

PRIOR_SD: Final = np.array([0.1, 0.2])
"""Standard deviation of the share of driving, and of waiting, that comes on top of plans, before any outcome. [1]"""
PRIOR_SPREAD: Final = 0.05
"""Variance of the energy of what is done beside that of 1 kWh that is planned, before any outcome. [kWh^2/kWh]"""
PRIOR_SHIFTS: Final = 10.0
"""Number of shifts whose weight that has."""
LEAST_KWH: Final = 0.2
"""Planned energy from which a forecast teaches. [kWh]"""
LARGEST_RESIDUAL_SDS: Final = 3.0
"""A larger error counts as this one. [standard deviations]"""
FACTOR_LIMITS: Final = 0.3, 2.0
"""Limits of the energy that is done over that of plans. [1]"""


class PlanOutcomes:
    """Learn what is done of what is planned.

    Attributes
    ----------
    factor, covariance : Energy done over planned energy, of driving and of waiting, and the covariance of both. [1]
    spread : Variance of the energy done beside that of 1 kWh that is planned. [kWh^2/kWh]
    """

    def __init__(self) -> None:
        self._known = DaySums(matrix=(2, 2), right=(2,), squares=(), shifts=())
        self.today = DaySums(matrix=(2, 2), right=(2,), squares=(), shifts=())
        self._compute_factors()

    def add_shift(self, driving: Floats, waiting: Floats, done: Floats) -> None:
        """Add the forecasts of a shift, all together with the weight of one, for the next daily update.

        Units: driving [kWh], waiting [kWh], done [kWh].
        """
        planned = driving + waiting
        rows = np.flatnonzero(np.isfinite(driving + waiting + done) & (planned > LEAST_KWH))
        if not len(rows):
            return
        terms = np.column_stack([driving, waiting])[rows]
        variance = self.spread * planned[rows]
        residual = done[rows] - terms @ self.factor
        clipped = np.clip(residual, *(side * LARGEST_RESIDUAL_SDS * np.sqrt(variance) for side in (-1.0, 1.0)))
        extra = clipped + terms @ (self.factor - 1.0)
        self.today.add("matrix", (terms / variance[:, np.newaxis]).T @ terms / len(rows))
        self.today.add("right", (terms / variance[:, np.newaxis]).T @ extra / len(rows))
        self.today.add("squares", float(np.mean(clipped**2 / planned[rows])))
        self.today.add("shifts", 1.0)

    def apply_daily_update(self) -> None:
        """Let the shifts since the last daily update take effect."""
        if shifts := int(self.today.get("shifts")):
            self._known.age(DAY_MEMORY, self.today, weigh_day(shifts))
        self.today.clear()
        self._compute_factors()

    def _compute_factors(self) -> None:
        """Compute factors, covariance and spread from the sums."""
        self.covariance = np.linalg.inv(self._known.get("matrix") + np.diag(PRIOR_SD**-2.0))
        self.factor = np.clip(1.0 + self.covariance @ self._known.get("right"), *FACTOR_LIMITS)
        squares, shifts = float(self._known.get("squares")), float(self._known.get("shifts"))
        self.spread = (PRIOR_SHIFTS * PRIOR_SPREAD + squares) / (PRIOR_SHIFTS + shifts)

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self._known.dump(), self.today.dump()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        known, today = state
        self._known.load(known)
        self.today.load(today)
        self._compute_factors()
