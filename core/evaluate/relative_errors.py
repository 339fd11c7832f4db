"""Compute errors relative to the energy and to the measurement noise, with intervals that allow for alike rides.

MAPE is the mean over rides of error over measured energy. It needs rides that use energy: a ride of almost none, or one
downhill that regains some, has a relative error without a bound. Rides below `LEAST_ENERGY` are therefore left out of
MAPE, and their share is reported. wMAPE, the sum of errors over the sum of energy, counts every ride.
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.evaluate.records import RelativeErrors, hold_estimate
from socast.core.stats.clustered import compute_clustered_mean, compute_clustered_ratio
from socast.core.stats.scores import UNKNOWN, Codes, compute_relative_errors

LEAST_ENERGY: Final = 0.1
"""Least measured energy of a ride that MAPE counts, that of about 500 m in town. [kWh]"""


def compute_relative_figures(measured: Floats, predicted: Floats, clusters: Codes, floor: float) -> RelativeErrors:
    """Return the errors of predictions in kWh, as shares of the energy, and over the noise floor.

    Units: measured [kWh], predicted [kWh].

    Parameters
    ----------
    clusters : (n,) int64
        Cluster of each ride, within which errors resemble each other, such as the vehicle-day.
    floor : float
        Error that measurement noise alone causes; NaN where it is unknown. [kWh]

    Examples
    --------
    >>> measured, predicted = np.array([1.0, 3.0, 0.0]), np.array([1.5, 3.0, 0.1])
    >>> errors = compute_relative_figures(measured, predicted, np.arange(3), floor=0.1)
    >>> [round(each.value, 3) for each in (errors.mae_kwh, errors.wmape, errors.mape)], round(errors.over_floor, 3)
    ([0.2, 0.15, 0.25], 2.0)
    """
    error, relative = np.abs(predicted - measured), compute_relative_errors(measured, predicted, LEAST_ENERGY)
    known = ~np.isnan(relative)
    mae = compute_clustered_mean(error, clusters)
    return RelativeErrors(
        mae_kwh=hold_estimate(mae),
        wmape=hold_estimate(compute_clustered_ratio(error, measured, clusters)),
        mape=hold_estimate(compute_clustered_mean(relative[known], clusters[known]) if known.any() else UNKNOWN),
        over_floor=divide_by_floor(mae.value, floor),
    )


def divide_by_floor(error: float, floor: float) -> float:
    """Return an error over the noise floor, NaN where the floor is zero or unknown. [1]"""
    return error / floor if floor > 0.0 else np.nan


def compute_share_below_least(measured: Floats) -> float:
    """Return the share of rides that MAPE leaves out, NaN without rides. [1]"""
    return float(np.mean(~(measured >= LEAST_ENERGY))) if len(measured) else np.nan
