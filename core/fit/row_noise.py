"""Estimate the variance of the error of each row of a fit: its measurement, and what no term of a model knows."""

from typing import Final

import numpy as np
import pandas as pd
from scipy.optimize import nnls

from core.batch import Floats
from core.fit.ride_blocks import get_numbers

CLIP: Final = 0.995
"""Quantile of the squared residuals at which they are clipped, so that outliers do not affect the usual variance."""
LEAST_SHARE: Final = 0.2
"""Least variance of a row over that of the median row, so that no row outweighs all others."""
ROBUST: Final = 3.0
"""Standard deviations above which the weight of a residual decreases, after Huber."""
LEAST_ROWS: Final = 50
"""Fewest rows from which the parts of the variance are estimated; with fewer, `USUAL_PARTS` holds."""
USUAL_PARTS: Final = (1.0, 0.15**2, 0.15**2, 300.0**2)
"""Factors on the variance of the measurement, the squared rolling and speeding-up energies [1], and the square of the
energy of 1 W [W^2]. Estimated on simulated fleets.
"""


def build_variance_parts(rows: pd.DataFrame, label: Floats) -> Floats:
    """Return the parts of the variance of rows.

    Parameters
    ----------
    rows : (n, columns) DataFrame
        Windows or rides.
    label : (n,) float
        Variance of the measurement. [kWh^2]

    Returns
    -------
    (n, 4) float
        The measurement, and the squares of the rolling energy, of the energy of speeding up, and of the energy of 1 W.
        [kWh^2]
    """
    return np.column_stack(
        [
            label,
            (get_numbers(rows, "effect_rolling") * get_numbers(rows, "rolling_resistance")) ** 2,
            get_numbers(rows, "effect_inertia_positive") ** 2,
            (get_numbers(rows, "duration_s") / 3.6e6) ** 2,
        ]
    )


def estimate_variance(parts: Floats, residual: Floats) -> Floats:
    """Return the variance of each residual: a sum of parts with fitted factors that are not negative.

    Parameters
    ----------
    parts : (n, k) float
        Parts of the variance. [kWh^2]
    residual : (n,) float
        Residuals. [kWh]

    Returns
    -------
    (n,) float
        Variance. [kWh^2]
    """
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
