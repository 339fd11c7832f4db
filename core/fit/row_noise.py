"""Estimate the variance of the error of each row of a fit, and gather what sampling distorts in it.

The variance is that of the measurement and of what no term of a model knows.

Distortions are columns of energy that a model must not mistake for an effect. Voltage, current and speed are sampled
every few seconds, and not quite at the same time.

- Lag: power that is measured a second after the motion belongs, by the change of the power, to another window.
- Unresolved braking: a car that brakes between two samples loses energy that no sample shows. The tables contain an
  estimate (`socast.core.signals.signals.compute_braking_force`), which is uncertain.

A fit estimates both beside its coefficients, with priors, and diagnosis projects them off. No prediction contains them:
the lag nearly cancels over a ride, and the coefficient of unresolved braking is what its estimate lacks, about zero. In
the recording of the tutorial, it shifts predictions by 0.4 %.
"""

from typing import Final

import numpy as np
import pandas as pd
from scipy.optimize import nnls

from socast.core.batch import Floats
from socast.core.columns import JOULES_PER_KWH
from socast.core.fit.measurement_noise import compute_noise_variance, is_metered
from socast.core.fit.ride_blocks import get_numbers, get_numbers_if_present
from socast.core.stats.scores import NORMAL_MEDIAN

DISTORTED_COLUMNS: Final = ("power_start_w", "power_end_w", "unresolved_braking_kwh")
"""Columns of the tables from which the distortions are computed; a ride table has the last one only."""
DISTORTIONS: Final = {"power_lag_s": 1.0, "unresolved_braking_share": 0.4}
"""Standard deviation of the coefficient of each column about zero.

The lag is that of two instruments that sample every 1 to 3 s [s]. Unresolved braking may be twice its estimate or none,
times the usual share of braking energy that is lost [1].
"""


DISTORTIONS_BESIDE_LOSSES: Final = DISTORTIONS | {"unresolved_braking_share": 0.2}
"""The same beside a term of losses by torque, which tells of hard driving.

Without such a term, the estimate of unresolved braking takes its place: in 63 drives of a Model 3 at 1 Hz its
coefficient becomes -0.8, and predictions, which do not have it, are 3 % too high. Twice the estimate and none are then
two standard deviations. Chosen on that car; those of a Leaf and an i3 at 1 to 3 s do not depend on it.
"""
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


def gather_distortions(table: pd.DataFrame) -> Floats:
    """Return the columns of `DISTORTIONS`, zero where a table does not have them.

    Returns
    -------
    (n, 2) float
        Change of the power from the first to the last sample [kWh/s]; estimate of the unresolved braking energy [kWh].
    """
    start, end, unresolved = (get_numbers_if_present(table, name, 0.0) for name in DISTORTED_COLUMNS)
    return np.column_stack([np.nan_to_num(end - start) / JOULES_PER_KWH, np.nan_to_num(unresolved)])
