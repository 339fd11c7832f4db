"""State how far the error of rides falls towards the measurement noise when a model takes a step.

The error above the noise is what remains of the mean absolute error after the error that measurement noise alone causes
on the same rides (`socast.core.fit.measurement_noise`) is subtracted. The share removed is the fall of the error over
the error above the noise before the step. All intervals are 95 % intervals by vehicle-day; they hold the chance of days
and not an error of the estimated noise.
"""

import numpy as np
from msgspec.structs import replace

from socast.core.batch import Floats
from socast.core.diagnose.add.records import ErrorFall, RemovedShare
from socast.core.evaluate.records import hold_estimate
from socast.core.fit.measurement_noise import MEAN_OVER_SD
from socast.core.stats.clustered import compute_clustered_mean, compute_fieller_interval
from socast.core.stats.scores import Codes


def measure_fall(measured: Floats, before: Floats, after: Floats, noise: Floats, clusters: Codes) -> ErrorFall:
    """Return the errors of two models on the same rides.

    Units: measured [kWh], before [kWh], after [kWh].

    Parameters
    ----------
    noise : (n,) float
        Variance of the measured energy, NaN where it is unknown. Such a ride has the mean noise of the others. [kWh^2]

    Notes
    -----
    With the absolute errors b and a before and after, and the expected absolute error n of the noise, the share removed
    is the ratio of the means of b - a and b - n; Fieller's interval holds for a denominator near zero too.
    """
    if not len(measured):
        return ErrorFall()
    worse, better = np.abs(before - measured), np.abs(after - measured)
    mae, change = float(worse.mean()), compute_clustered_mean(better - worse, clusters)
    fall = ErrorFall(
        rides=len(measured),
        clusters=len(np.unique(clusters)),
        mae_before_kwh=mae,
        mae_after_kwh=float(better.mean()),
        fall=-change.value / mae if mae > 0.0 else 0.0,
        change_kwh=hold_estimate(change),
    )
    known = np.isfinite(noise)
    if not known.any():
        return fall
    alone = MEAN_OVER_SD * np.sqrt(np.where(known, noise, 0.0))
    alone = np.where(known, alone, alone[known].mean())
    above = [compute_clustered_mean(error - alone, clusters) for error in (worse, better)]
    fall = replace(
        fall,
        noise_kwh=float(alone.mean()),
        above_before_kwh=hold_estimate(above[0]),
        above_after_kwh=hold_estimate(above[1]),
    )
    if fall.is_noise_overestimated:
        return fall
    value, low, high = compute_fieller_interval(worse - better, worse - alone, clusters)
    return replace(fall, removed=RemovedShare(value=value, low=low, high=high))
