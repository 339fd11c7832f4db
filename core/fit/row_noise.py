"""Estimate the variance of the error of each row of a fit: its measurement, and what no term of a model knows."""

from typing import Final

import numpy as np
import pandas as pd
from scipy.optimize import nnls

from socast.core.batch import Floats
from socast.core.fit.measurement_noise import compute_noise_variance, is_metered
from socast.core.fit.ride_blocks import get_numbers
from socast.core.stats.scores import NORMAL_MEDIAN

CLIP: Final = 0.995
"""Quantile of the squared residuals at which they are clipped, so that outliers do not affect the usual variance."""
LEAST_SHARE: Final = 0.2
"""Least variance of a row over that of the median row, so that no row outweighs all others."""
ROBUST: Final = 4.0
"""Standard deviations above which the weight of a residual decreases, after Huber.

The error of sampled power is skewed: peaks between two samples are missed. A lower limit would cut its longer side.
"""
LEAST_ROWS: Final = 50
"""Fewest rows from which the parts of the variance are estimated; with fewer, `USUAL_PARTS` holds."""
USUAL_PARTS: Final = (1.0, 0.15**2, 0.15**2, 300.0**2)
"""Factors on the variance of the measurement, the squared rolling and speeding-up energies [1], and the square of the
energy of 1 W [W^2]. Estimated on simulated fleets.
"""


def expect_label_variance(rows: pd.DataFrame) -> Floats:
    """Return the expected variance of the measured energy of rows, of their time and motion only.

    Where voltage and current are measured, the stated variance of a row rests on the powers that were sampled in it. A
    row in which a peak of the power was sampled has more energy and a larger variance than one in which it fell between
    two samples. Weights by the stated variance would therefore favour rows with too little energy. The expected
    variance is the sum of a part per time and a part per kinetic energy gained, fitted to the stated ones, of which the
    largest are clipped. Fits scale it by their residuals.

    Returns
    -------
    (n,) float
        Variance. Rows that are not metered have the stated one, zero where it is unknown. [kWh^2]
    """
    stated = compute_noise_variance(rows)
    metered = is_metered(rows)
    known = metered & np.isfinite(stated)
    if not known.any():
        return np.nan_to_num(stated)
    time, kinetic = get_numbers(rows, "duration_s"), np.nan_to_num(get_numbers(rows, "effect_inertia_positive"))
    parts = np.column_stack([time, kinetic])
    size = np.maximum(np.mean(parts[known], axis=0), 1e-300)
    shares, _ = nnls(parts[known] / size, np.minimum(stated[known], np.quantile(stated[known], CLIP)))
    return np.where(metered, parts / size @ shares, np.nan_to_num(stated))


def build_variance_parts(rows: pd.DataFrame) -> Floats:
    """Return the parts of the variance of rows.

    Returns
    -------
    (n, 4) float
        The measurement (`expect_label_variance`), and the squares of the rolling energy, of the energy of speeding up,
        and of the energy of 1 W. [kWh^2]
    """
    return np.column_stack(
        [
            expect_label_variance(rows),
            (get_numbers(rows, "effect_rolling") * get_numbers(rows, "rolling_resistance")) ** 2,
            get_numbers(rows, "effect_inertia_positive") ** 2,
            (get_numbers(rows, "duration_s") / 3.6e6) ** 2,
        ]
    )


def estimate_variance(parts: Floats, residual: Floats) -> Floats:
    """Return the variance of each residual: a sum of parts with fitted factors that are not negative.

    Units: parts [kWh^2], residual [kWh], returns [kWh^2].
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

    Returns
    -------
    (n,) float
        Weights, above 0 and at most 1. [1]

    References
    ----------
    Huber, Annals of Mathematical Statistics 35 (1964) 73, DOI 10.1214/aoms/1177703732.
    """
    middle = float(np.median(np.abs(standardised))) / NORMAL_MEDIAN
    if middle <= 0.0:
        return np.ones(len(standardised))
    return np.minimum(1.0, ROBUST * middle / np.maximum(np.abs(standardised), 1e-300))
