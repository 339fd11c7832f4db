"""Estimate the measurement noise of each window and of each ride.

Energy from voltage and current has an error from changes of the power between two samples. Energy from the state of
charge has an error from its resolution. Errors that all drives of a car share (the gain of its meter, its capacity) are
excluded, because the coefficients of a fitted model compensate for them.
"""

from typing import Final

import numpy as np
from scipy.optimize import nnls

from core.batch import Floats
from core.diagnose.dataset import Windows, is_metered
from core.fit.ride_blocks import get_numbers
from core.totals.tables import CAPACITY_GAIN, METER_GAIN

MEAN_OVER_SD: Final = float(np.sqrt(2.0 / np.pi))
"""Ratio of the mean absolute value of a Gaussian error to its standard deviation."""
CLIP: Final = 0.995
"""Quantile of the squared residuals at which they are clipped, so that outliers do not affect the usual variance."""
LEAST_SHARE: Final = 0.2
"""Least variance of a window over that of the median window, so that no window outweighs all others."""
ROBUST: Final = 3.0
"""Standard deviations above which the weight of a residual decreases, after Huber."""


def compute_measurement_variance(windows: Windows) -> Floats:
    """Return the variance of the measured energy of each window without shared gains, (n,). [kWh^2]"""
    table, energy = windows.table, windows.measured
    power = get_numbers(table, "energy_vi_sd_kwh") ** 2 - (METER_GAIN * energy) ** 2
    charge = get_numbers(table, "energy_soc_sd_kwh") ** 2 - (CAPACITY_GAIN * energy) ** 2
    return np.maximum(np.where(is_metered(table), power, charge), 0.0)


def compute_ride_noise_floor(windows: Windows) -> float:
    """Return the mean absolute error per ride that measurement noise alone causes. [kWh]

    Parameters
    ----------
    windows : Windows
        The windows of the rides.

    Returns
    -------
    float
        The error that a model without any error of its own would show. [kWh]

    Notes
    -----
    For a Gaussian error, the mean absolute value is sqrt(2/π) times the standard deviation.
    """
    return float(np.mean(MEAN_OVER_SD * np.sqrt(windows.by_ride(compute_measurement_variance(windows)))))


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
            compute_measurement_variance(windows),
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
