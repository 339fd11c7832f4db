"""Learn from the outcomes of forecasts how much energy driving and waiting take beyond the forecast.

The consumption factors make a shift as a whole agree with its prediction. Within a shift the consumption may still come
early or late, waiting may take more than driving does, and both may depend on the temperature otherwise than the model
states. The fall of the charge until an outcome is therefore regressed on the two parts of its forecast,

    fall = sum over both parts of (1 + x_0 + x_1 cold + x_2 heat) part + noise,

where `cold` and `heat` are the distances from mild temperatures. The coefficients x have a normal prior with mean 0, so
that the correction stays near 1 until outcomes speak against it, and its uncertainty grows with the distance from the
temperatures that were met (Bayesian linear regression).

References
----------
Gelman et al., Bayesian Data Analysis, 3rd edition, section 14.8, ISBN 978-1-4398-4095-5.
"""

from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.forecast.conformal import DAY_MEMORY, weigh_day
from socast.core.forecast.learning.leg_energy import TEMPERATURES, compute_knot_weights
from socast.core.totals.day_sums import DaySums

MILD: Final = 14.0, 21.0
"""Temperatures between which neither cold nor heat counts. [°C]"""
SHAPES: Final = np.stack(
    [
        np.ones(len(TEMPERATURES)),
        np.maximum(MILD[0] - TEMPERATURES, 0.0) / 10.0,
        np.maximum(TEMPERATURES - MILD[1], 0.0) / 10.0,
    ]
)
"""Constant, cold and heat at each knot of temperature, (3, temperatures). [1], [10 K], [10 K]"""
PARTS: Final = 2
"""Number of parts of the energy ahead: driving and waiting. Without a plan all energy counts as driving."""
COEFFICIENTS: Final = PARTS * len(SHAPES)
"""Number of coefficients."""
PRIOR_SD: Final = np.array([0.1, 0.06, 0.06, 0.2, 0.1, 0.1])
"""Standard deviation of each coefficient before any outcome: those of driving, then those of waiting. [1]"""
LARGEST_RESIDUAL_SDS: Final = 3.0
"""A larger error counts as this one. [standard deviations]"""
FACTOR_LIMITS: Final = 0.5, 2.0
"""Limits of the correction of a part. [1]"""
_ARRAYS: Final = "_matrix", "_right"


class PartForecasts(NamedTuple):
    """Hold the forecasts of one shift whose outcome is known, (n,) float each.

    Parameters
    ----------
    driving, waiting : Forecast fall of the charge by each part, before the correction. [1]
    celsius : Outside temperature. [°C]
    fall : Fall of the charge. [1]
    sd : Standard deviation of the forecast. [1]
    """

    driving: Floats
    waiting: Floats
    celsius: Floats
    fall: Floats
    sd: Floats


class EnergyCorrection:
    """Learn the factors of driving and waiting for each basis of a forecast.

    Attributes
    ----------
    factor : (bases, 2, temperatures) float
        Factors of driving and waiting at each knot of temperature. [1]
    covariance : (bases, temperatures, 2, 2) float
        Covariance of both at each knot.
    today : DaySums
        By basis, since the last daily update: number of shifts, and normal equations.
    """

    def __init__(self, bases: int) -> None:
        self._matrix = np.zeros((bases, COEFFICIENTS, COEFFICIENTS))  # of the normal equations
        self._right = np.zeros((bases, COEFFICIENTS))
        self.today = DaySums(shifts=(bases,), matrix=(bases, COEFFICIENTS, COEFFICIENTS), right=(bases, COEFFICIENTS))
        self._compute_factors()

    def add_shift(self, basis: int, forecasts: PartForecasts) -> None:
        """Add the forecasts of a shift, all together with the weight of one, for the next daily update."""
        known = np.isfinite(np.column_stack(forecasts)).all(axis=1) & (forecasts.sd > 0.0)
        if not known.any():
            return
        driving, waiting, celsius, fall, sd = (column[known] for column in forecasts)
        shapes = compute_knot_weights(celsius, TEMPERATURES) @ SHAPES.T
        terms = np.concatenate([driving[:, np.newaxis] * shapes, waiting[:, np.newaxis] * shapes], axis=1)
        terms /= sd[:, np.newaxis]
        residual = np.clip((fall - driving - waiting) / sd, -LARGEST_RESIDUAL_SDS, LARGEST_RESIDUAL_SDS)
        self.today.add("matrix", terms.T @ terms / len(sd), (basis,))
        self.today.add("right", terms.T @ residual / len(sd), (basis,))
        self.today.add("shifts", 1.0, (basis,))

    def apply_daily_update(self) -> None:
        """Let the shifts since the last daily update take effect."""
        number, matrix, right = map(self.today.get, ("shifts", "matrix", "right"))
        for basis, shifts in enumerate(number.tolist()):
            if shifts:
                weight = weigh_day(int(shifts))
                self._matrix[basis] = DAY_MEMORY * self._matrix[basis] + weight * matrix[basis]
                self._right[basis] = DAY_MEMORY * self._right[basis] + weight * right[basis]
        self.today.clear()
        self._compute_factors()

    def _compute_factors(self) -> None:
        """Compute the factors and their covariance from the sums."""
        covariance = np.linalg.inv(self._matrix + np.diag(PRIOR_SD**-2.0))
        parts = len(self._right), PARTS, len(SHAPES)
        coefficients = np.einsum("bij,bj->bi", covariance, self._right).reshape(parts)
        self.factor = np.clip(1.0 + coefficients @ SHAPES, *FACTOR_LIMITS)
        blocks = covariance.reshape(*parts, PARTS, len(SHAPES))
        self.covariance = np.einsum("bpsqr,sk,rk->bkpq", blocks, SHAPES, SHAPES)

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self.today.dump(), [getattr(self, name).tobytes() for name in _ARRAYS]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        today, arrays = state
        self.today.load(today)
        for name, dumped in zip(_ARRAYS, arrays, strict=True):
            setattr(self, name, np.frombuffer(dumped).reshape(getattr(self, name).shape).copy())
        self._compute_factors()
