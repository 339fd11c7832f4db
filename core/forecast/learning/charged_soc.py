"""Learn to which charge cars charge where their plan has a charge.

Charging ends early, or goes on beyond what dispatch had planned. The charge with which a car departs is therefore
regressed on the planned one,

    reached = planned + x_0 + x_1 (planned - 0.8) + noise,

where the coefficients have a normal prior with mean 0 and the variance of the noise has an inverse gamma one, so that
the plan counts until outcomes speak against it (Bayesian linear regression).

References
----------
Gelman et al., Bayesian Data Analysis, 3rd edition, section 14.8, ISBN 978-1-4398-4095-5.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.forecast.conformal import DAY_MEMORY
from socast.core.totals.day_sums import DailyLearner

CENTRE: Final = 0.8
"""Planned charge at which the slope has no effect. [1]"""
PRIOR_SD: Final = np.array([0.05, 0.5])
"""Standard deviation of each coefficient before any outcome; with -1, cars charge to the same whatever the plan. [1]"""
NOISE_SD: Final = 0.05
"""Standard deviation of the noise before any outcome. [1]"""
NOISE_CHARGES: Final = 4.0
"""Number of charges whose weight this has."""
_ROUNDS: Final = 5  # between coefficients and noise
_SUMS: Final = 6  # n, x, x^2, y, x y, y^2


class ChargedSoc(DailyLearner):
    """Learn the charge after planned charges.

    Attributes
    ----------
    coefficients, covariance : Offset and slope, and their covariance, (2,) and (2, 2) float. [1]
    variance : Variance of the noise. [1]
    known, today : Number of charges, and sums of x, x^2, y, x y and y^2.
    """

    def __init__(self) -> None:
        super().__init__(sums=(_SUMS,))

    def add_charges(self, outcomes: Sequence[tuple[float, float]]) -> None:
        """Add planned charges with the charge that the car departed with, for the next daily update. [1]"""
        for planned, reached in outcomes:
            if np.isfinite(planned) and np.isfinite(reached):
                x, y = planned - CENTRE, reached - planned
                self.today.add("sums", [1.0, x, x * x, y, x * y, y * y])

    def apply_daily_update(self) -> None:
        """Let the charges since the last daily update take effect."""
        if self.today.get("sums")[0]:
            self.take_day(DAY_MEMORY)

    def fit(self) -> None:
        """Compute coefficients and noise from the sums."""
        n, x, xx, y, xy, yy = self.known.get("sums").tolist()
        matrix, right = np.array([[n, x], [x, xx]]), np.array([y, xy])
        self.variance = NOISE_SD**2
        for _ in range(_ROUNDS):
            self.covariance = np.linalg.inv(matrix / self.variance + np.diag(PRIOR_SD**-2.0))
            self.coefficients = self.covariance @ right / self.variance
            squares = yy - 2.0 * self.coefficients @ right + self.coefficients @ matrix @ self.coefficients
            self.variance = (NOISE_CHARGES * NOISE_SD**2 + max(float(squares), 0.0)) / (NOISE_CHARGES + n)

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
