"""Estimate the variance of each residual of a diagnosis, and the weights that limit the influence of outliers."""

from typing import Final

import numpy as np
from scipy.optimize import nnls

from core.batch import Floats
from core.diagnose.dataset import Windows
from core.fit.measurement_noise import compute_noise_variance
from core.fit.ride_blocks import get_numbers

CLIP: Final = 0.995
"""Quantile of the squared residuals at which they are clipped, so that outliers do not affect the usual variance."""
LEAST_SHARE: Final = 0.2
"""Least variance of a window over that of the median window, so that no window outweighs all others."""
ROBUST: Final = 3.0
"""Standard deviations above which the weight of a residual decreases, after Huber."""


def estimate_window_variance(windows: Windows, residual: Floats) -> Floats:
    """Return the variance of the residual of each window: that of its measurement plus parts that grow with the drive.

    Parameters
    ----------
    windows : Windows
        The windows.
    residual : (n,) float
        Residual after refitting. [kWh]

    Returns
    -------
    (n,) float
        Variance of each residual. [kWh^2]

    Notes
    -----
    The variance is a sum of the measurement variance and parts proportional to the squares of the rolling energy, of
    the acceleration energy, and of the energy of a constant power. The coefficients are fitted and not negative.
    """
    table = windows.table
    parts = np.column_stack(
        [
            compute_noise_variance(table),
            (get_numbers(table, "effect_rolling") * get_numbers(table, "rolling_resistance")) ** 2,
            get_numbers(table, "effect_inertia_positive") ** 2,
            (get_numbers(table, "duration_s") / 3.6e6) ** 2,
        ]
    )
    size = np.mean(parts, axis=0)
    parts = parts[:, size > 0.0] / size[size > 0.0]
    square = residual**2
    shares, _ = nnls(parts, np.minimum(square, np.quantile(square, CLIP)))
    variance = parts @ shares
    middle = float(np.median(variance))
    if middle <= 0.0:
        return np.full(len(residual), max(float(np.mean(square)), 1e-12))
    return np.maximum(variance, LEAST_SHARE * middle)


def compute_robust_weights(standardised: Floats) -> Floats:
    """Return the weight of each standardised residual: 1 up to `ROBUST`, then decreasing.

    Parameters
    ----------
    standardised : (n,) float
        Residuals over their standard deviation. [1]

    Returns
    -------
    (n,) float
        Weights, above 0 and at most 1. [1]

    References
    ----------
    Huber, Annals of Mathematical Statistics 35 (1964) 73, DOI 10.1214/aoms/1177703732.
    """
    middle = float(np.median(np.abs(standardised))) / 0.6745
    if middle <= 0.0:
        return np.ones(len(standardised))
    return np.minimum(1.0, ROBUST * middle / np.maximum(np.abs(standardised), 1e-300))
