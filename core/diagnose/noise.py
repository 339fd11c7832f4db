"""How much of the error is the measurement's own: of each window, and of a ride.

Voltage times current errs by what the power does between two samples, the state of charge by its quantum. Errors that
all drives of a car share (the gain of its meter, its capacity) are left out: a fitted model takes them up in its
coefficients.
"""

from typing import Final

import numpy as np
from scipy.optimize import nnls

from core.batch import Floats
from core.diagnose.dataset import Windows, is_metered
from core.fit.ride_blocks import get_numbers
from core.totals.tables import CAPACITY_GAIN, METER_GAIN

MEAN_OVER_SD: Final = float(np.sqrt(2.0 / np.pi))
"""Mean absolute value of a Gaussian error over its standard deviation."""
CLIP: Final = 0.995
"""Quantile of the squared residuals above which they tell nothing of the usual variance."""
LEAST_SHARE: Final = 0.2
"""Least variance that a window is given, over the median window's: no window outweighs all others."""
ROBUST: Final = 3.0
"""Standard deviations from which on a residual counts less, after Huber."""


def compute_measurement_variance(windows: Windows) -> Floats:
    """Return the variance of each window's measured energy, gains left out, (n,). [kWh^2]"""
    table, energy = windows.table, windows.measured
    power = get_numbers(table, "energy_vi_sd_kwh") ** 2 - (METER_GAIN * energy) ** 2
    charge = get_numbers(table, "energy_soc_sd_kwh") ** 2 - (CAPACITY_GAIN * energy) ** 2
    return np.maximum(np.where(is_metered(table), power, charge), 0.0)


def compute_ride_noise_floor(windows: Windows) -> float:
    """Return the mean absolute error per ride that a model without any error would have. [kWh]

    Notes
    -----
    For Gaussian errors sqrt(2/π) of the standard deviation.
    """
    return float(np.mean(MEAN_OVER_SD * np.sqrt(windows.by_ride(compute_measurement_variance(windows)))))


def estimate_window_variance(windows: Windows, residual: Floats) -> Floats:
    """Return the variance of what a model leaves of each window: its measurement's, and what grows with the drive.

    Parameters
    ----------
    windows : Windows
    residual : (n,) float
        What is left after refitting. [kWh]

    Returns
    -------
    (n,) float
        [kWh^2]

    Notes
    -----
    A sum of parts that grow with the squares of the energy to roll, to speed up and of an always-on power, beside the
    measurement's variance; all with coefficients that are fitted and not negative.
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
    """Return the share of its weight that each residual keeps: all up to `ROBUST`, less beyond (Huber 1964)."""
    middle = float(np.median(np.abs(standardised))) / 0.6745
    if middle <= 0.0:
        return np.ones(len(standardised))
    return np.minimum(1.0, ROBUST * middle / np.maximum(np.abs(standardised), 1e-300))
