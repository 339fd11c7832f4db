"""Hold each part of a drive that was cut against what the car truly did in its time."""

from collections.abc import Callable

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.cleaning import clock
from socast.tools.bench.league.drives import JOULES
from socast.tools.bench.league.loggers import Log

Sampling = Callable[[Ints], tuple[float, float]]


def find_stamps(log: Log) -> Floats:
    """Return the stamps of samples, with the weeks that a receiver has lost, (n,). [s]"""
    stamps = log.columns["time_s"]
    return np.where(stamps < clock.FIRST_LOGGER, stamps + clock.ROLLOVER, stamps)


def are_right(log: Log, rides: pd.DataFrame, sampling: Sampling, share: float, sds: float) -> bool:
    """Return whether every ride that is fit is right in its own time.

    Parameters
    ----------
    log : Log
        Samples of the car. The first sample of a ride is that whose stamp is nearest to its beginning.
    sampling : callable
        Function of rows of the log that returns the errors of distance [m] and energy [J] that no cleaning can avoid.
    share, sds : float
        Tolerance of distance and energy, as a share [1] and in standard uncertainties of the energy.
    """
    stamps, track = find_stamps(log), log.car.track
    columns = ["start_s", "duration_s", "distance_km", "energy_kwh", "energy_sd_kwh"]
    for start, duration, km, kwh, sd in rides.loc[rides["fit_for_training"], columns].to_numpy(float).tolist():
        at = int(np.nanargmin(np.abs(stamps - start)))
        if abs(stamps[at] - start) > log.car.period:
            return False
        first = float(log.true[at])
        last = first + duration
        rows = np.flatnonzero((log.true >= first - 0.5 * log.car.period) & (log.true <= last + 0.5 * log.car.period))
        distance_error, energy_error = sampling(rows[np.argsort(log.true[rows])])
        distance = 1e-3 * float(track.at("distance", last) - track.at("distance", first))
        energy = float(track.at("energy", last) - track.at("energy", first)) / JOULES
        energy_slack = max(share * abs(energy) + energy_error / JOULES, sds * sd)
        if abs(km - distance) > share * distance + 1e-3 * distance_error:
            return False
        if abs(kwh - energy) > energy_slack:
            return False
    return True
