"""Describe the noise of windows: a variance each, and a correlation with the next windows of the same ride.

Where power lags the motion, and where elevation is smoothed over the end of a window, one window gains what the next
one loses. Such errors nearly cancel over a ride. A model in which the windows of a ride are independent expects larger
errors of rides than there are, and finds too small differences between rides: .284 in place of .298 kW in a simulated
fleet in which each ride had a constant load of its own.
"""

from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from scipy.linalg import LinAlgError, cholesky_banded, solve_banded

from socast.core.batch import Floats, Ints
from socast.core.fit.row_noise import build_variance_parts, compute_robust_weights, estimate_variance

LAGS: Final = 3
"""Number of following windows with which a window is correlated."""
FAR: Final = 8
"""First lag that is not used. Between `LAGS` and it, correlation is that of the whole ride."""
LEAST_PAIRS: Final = 200
"""Fewest pairs of windows from which correlation is estimated."""
SHRINK: Final = 0.8
"""Factor on correlations that no process can have, until one can."""


class WindowNoise(NamedTuple):
    """Hold the noise of windows.

    Parameters
    ----------
    weight : (n,) float
        Inverse of the variance of each window. [1/kWh^2]
    ride : (n,) int64
        Ride of each window.
    correlation : (LAGS,) float
        Correlation of the standardised errors of two windows of a ride at each lag. [1]
    """

    weight: Floats
    ride: Ints
    correlation: Floats

    def whiten(self, columns: Floats) -> Floats:
        """Return columns, (n, k), such that errors are independent and of variance 1."""
        scaled = columns * np.sqrt(self.weight)[:, np.newaxis]
        if not self.correlation.any():
            return scaled
        return np.asarray(solve_banded((LAGS, 0), self._factor(), scaled))

    def convert_to_energy(self, values: Floats) -> Floats:
        """Return whitened values, (n,), as energies. [kWh]"""
        if self.correlation.any():
            factor, white = self._factor(), values
            values = factor[0] * white
            for lag in range(1, LAGS + 1):
                values[lag:] += factor[lag, :-lag] * white[:-lag]
        return np.asarray(values / np.sqrt(self.weight))

    def sum_ride_variances(self, rides: int) -> Floats:
        """Return the variance of the sum of the errors of each ride, (rides,). [kWh^2]"""
        deviation = 1.0 / np.sqrt(self.weight)
        out = np.bincount(self.ride, deviation**2, rides)
        for lag, correlation in enumerate(self.correlation.tolist(), start=1):
            same = self.ride[lag:] == self.ride[:-lag]
            both = deviation[lag:] * deviation[:-lag] * same
            out += 2.0 * correlation * np.bincount(self.ride[lag:], both, rides)
        return np.asarray(np.maximum(out, 0.0))

    def _factor(self) -> Floats:
        """Return the Cholesky factor of the correlation of all windows in the form of `cholesky_banded`."""
        return _factorise(self.ride, self.correlation)


def estimate_window_noise(table: pd.DataFrame, ride: Ints, left: Floats) -> WindowNoise:
    """Return the noise of windows from what is left without the random effects of rides and days.

    Units: left [kWh].
    """
    variance = estimate_variance(build_variance_parts(table), left)
    weight = compute_robust_weights(left / np.sqrt(variance)) ** 2 / variance
    return WindowNoise(weight, ride, estimate_correlation(left * np.sqrt(weight), ride))


def estimate_correlation(standardised: Floats, ride: Ints) -> Floats:
    """Return the correlation at each lag, less that of windows of the same ride that are farther apart.

    Returns
    -------
    (LAGS,) float
        Correlations, all from the same rides of more than `FAR` windows; zeros where there are too few.
    """
    long = np.bincount(ride)[ride] > FAR
    products = []
    for lag in range(FAR):
        n = len(ride) - lag
        same = (ride[lag:] == ride[:n]) & long[:n]
        if int(same.sum()) < LEAST_PAIRS:
            return np.zeros(LAGS)
        products.append(float(np.mean((standardised[lag:] * standardised[:n])[same])))
    far = float(np.mean(products[LAGS + 1 :]))
    found = (np.array(products[1 : LAGS + 1]) - far) / max(products[0] - far, 1e-300)
    while not _is_possible(found):
        found = SHRINK * found
    return found


def _is_possible(correlation: Floats) -> bool:
    """Return whether rides of any length can have these correlations."""
    try:
        _factorise(np.zeros(60, dtype=np.int64), correlation)
    except LinAlgError:
        return False
    return True


def _factorise(ride: Ints, correlation: Floats) -> Floats:
    """Return the lower Cholesky factor of the correlation matrix of windows, by diagonals."""
    bands = np.zeros((LAGS + 1, len(ride)))
    bands[0] = 1.0
    for lag, value in enumerate(correlation.tolist(), start=1):
        bands[lag, :-lag] = np.where(ride[lag:] == ride[:-lag], value, 0.0)
    return np.asarray(cholesky_banded(bands, lower=True))
