"""A Bayesian linear regression with unknown noise, from sums that lose weight day by day.

Each observation y has terms x, and noise whose variance is proportional to a known one,

    y = x · coefficients + noise.

All that observations leave behind are sums: of their weights, and of x x^T, x y and y^2 times their weights over the
known variances. Coefficients and variance follow from each other in a few rounds.

References
----------
Gelman et al., Bayesian Data Analysis, 3rd edition, sections 14.2 and 14.8, ISBN 978-1-4398-4095-5.
"""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.totals.day_sums import DailyLearner

_ROUNDS: Final = 5


class NoisePrior(NamedTuple):
    """Hold the variance of the noise before any data, and the number of observations whose weight it has."""

    variance: float
    weight: float


class DailyRegression(DailyLearner):
    """Learn coefficients from observations, which the next daily update adds.

    Parameters
    ----------
    sd : Standard deviation of each coefficient, which are 0 before any data, (n,) float.

    Attributes
    ----------
    coefficients, covariance : Mean and covariance, (n,) and (n, n) float.
    variance : Variance of the noise over the known one.
    """

    def __init__(self, sd: Floats, noise: NoisePrior) -> None:
        self._precision, self._noise, n = np.diag(sd**-2.0), noise, len(sd)
        super().__init__(weight=(), matrix=(n, n), right=(n,), squares=())

    def observe(self, terms: Floats, values: Floats, variance: Floats, weight: float = 1.0) -> None:
        """Add m observations, with a weight in all, for the next daily update; the terms are (m, n)."""
        weighted = terms.T * (weight / len(values) / variance)
        self.today.add("weight", weight)
        self.today.add("matrix", weighted @ terms)
        self.today.add("right", weighted @ values)
        self.today.add("squares", weight * float(np.mean(values**2 / variance)))

    def fit(self) -> None:
        """Compute coefficients and variance from the known sums."""
        weight, matrix, right, squares = (self.known.get(name) for name in ("weight", "matrix", "right", "squares"))
        self.variance = self._noise.variance
        for _ in range(_ROUNDS):
            self.covariance = np.linalg.inv(matrix / self.variance + self._precision)
            self.coefficients = self.covariance @ right / self.variance
            rest = squares - 2.0 * self.coefficients @ right + self.coefficients @ matrix @ self.coefficients
            known = self._noise.weight * self._noise.variance
            self.variance = (known + max(float(rest), 0.0)) / (self._noise.weight + float(weight))
