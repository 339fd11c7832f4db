"""Estimate the noise of the measured energy, and the error that it alone causes: the noise floor.

Energy from voltage and current has an error from changes of the power between two samples. Energy from the state of
charge has an error from its resolution. Errors that all drives of a car share (the gain of its meter, its capacity) are
excluded, because the coefficients of a fitted model compensate for them.

This is the only definition of the noise floor: evaluation, comparison, diagnosis and the addition of effects use it.
"""

from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.fit.ride_blocks import ENERGY, get_numbers, get_numbers_if_present
from socast.core.totals.measured_energy import METER_GAIN

MEAN_OVER_SD: Final = float(np.sqrt(2.0 / np.pi))
"""Ratio of the mean absolute value of a Gaussian error to its standard deviation. [1]"""


def is_metered(table: pd.DataFrame) -> NDArray[np.bool_]:
    """Return which rides or windows are measured by voltage and current, not by the state of charge, (n,)."""
    return np.asarray(get_numbers(table, ENERGY) == get_numbers_if_present(table, "energy_vi_kwh"))


def compute_noise_variance(table: pd.DataFrame) -> Floats:
    """Return the variance of the measured energy of each ride or window, without the gains that a car's drives share.

    Returns
    -------
    (n,) float
        Variance; NaN where the uncertainty is unknown. [kWh^2]

    Examples
    --------
    >>> ride = pd.DataFrame({"energy_kwh": [2.0], "energy_vi_kwh": [2.0], "energy_vi_sd_kwh": [np.hypot(0.03, 0.02)]})
    >>> compute_noise_variance(ride).round(6)
    array([0.0009])
    """
    energy = get_numbers(table, ENERGY)
    power = get_numbers_if_present(table, "energy_vi_sd_kwh") ** 2 - (METER_GAIN * energy) ** 2
    charge = get_numbers_if_present(table, "energy_soc_noise_kwh") ** 2
    return np.maximum(np.where(is_metered(table), power, charge), 0.0)


def compute_noise_floor(variance: Floats) -> float:
    """Return the mean absolute error per ride that measurement noise alone causes. [kWh]

    Parameters
    ----------
    variance : (n,) float
        Variance of the measured energy of each ride, of `compute_noise_variance`; NaN where it is unknown. [kWh^2]

    Returns
    -------
    float
        Error that a model without any error would show, over the rides of known variance; NaN where there is none.
        [kWh]

    Notes
    -----
    For a Gaussian error, the mean absolute value is sqrt(2/π) times the standard deviation.

    Examples
    --------
    >>> round(compute_noise_floor(np.array([0.0025, 0.01])), 4)
    0.0598
    """
    known = np.sqrt(variance[np.isfinite(variance)])
    return float(MEAN_OVER_SD * known.mean()) if len(known) else float("nan")
