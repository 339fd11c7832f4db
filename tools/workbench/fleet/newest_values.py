"""The newest values of each car, and how samples of telemetry change them."""

from math import nan
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Ints
from socast.core.compiled_cache import njit
from socast.core.wire.live_fields import list_live_fields
from socast.core.wire.messages import Forecast
from socast.core.wire.sample_reader import SampleColumns

COLUMNS: Final = (
    *("time", "latitude", "longitude", "speed", "faults", "riding", "charging"),
    *("far_latitude", "far_longitude", "elapsed", "heard"),
    *(column for field in list_live_fields(Forecast) for column in field.columns),
)
"""Newest values of a car: Unix s, degrees, km/h, numbers, and the declared fields of a forecast; NaN where unknown.

A fix far from the one before it is believed once another one lies near it. `socast.tools.workbench.fleet.fleet_time`
describes `elapsed` and `heard`.
"""
NEAR_DEG: Final = 0.05
"""Distance in latitude and longitude from which a fix is far from the one before it. [deg]"""
_CAR: Final = np.dtype([(name, np.float64) for name in COLUMNS])


def make_unknown_cars(cars: int) -> NDArray[np.void]:
    """Return the values of cars that have sent nothing."""
    return np.array([(nan,) * len(COLUMNS)], _CAR).repeat(cars)


def write_samples(cars: NDArray[np.void], rows: Ints, samples: SampleColumns) -> NDArray[np.bool_]:
    """Write samples to the newest values of their cars, in the order of the samples.

    A position is left out if it is impossible, or far from the one before it and from the last one that was far.

    Parameters
    ----------
    cars : (cars,) structured
        Values with the names of `COLUMNS`, changed in place.
    rows : (n,) int
        Row of the car of each sample, -1 for a sample that is left out.

    Returns
    -------
    (n,) bool
        Whether the car is now at the position of the sample, or was before a later sample.
    """
    is_taken = np.zeros(len(rows), np.bool_)
    _write_samples(cars, rows, samples, samples.find_fixes(), is_taken)
    return is_taken


def compile_kernel() -> None:
    """Compile the loop over samples, or load it from the cache, so that nobody waits for it later."""
    write_samples(
        make_unknown_cars(1), np.zeros(1, np.int64), SampleColumns(*np.zeros((len(SampleColumns._fields), 1)))
    )


@njit(cache=True)
def _write_samples(cars: Any, rows: Any, samples: Any, is_fix: Any, is_taken: Any) -> None:
    """Write samples one by one, and whether the position of each was taken."""
    for i in range(len(rows)):
        if rows[i] < 0:
            continue
        car = cars[rows[i]]
        if is_fix[i]:
            is_taken[i] = _write_fix(car, samples.latitude[i], samples.longitude[i])
        if not np.isnan(samples.speed[i]):
            car.speed = samples.speed[i]
        if not np.isnan(samples.soc[i]) and np.isnan(car.soc_sd_pct):  # until a forecast brings the filtered charge
            car.soc_pct = samples.soc[i]
        car.charging = 1.0 if samples.charging[i] == 1.0 else 0.0
        if np.isnan(car.time):
            car.time = samples.time[i]


@njit
def _write_fix(car: Any, latitude: Any, longitude: Any) -> Any:
    """Write a possible position, and return whether it was taken."""
    is_first = np.isnan(car.latitude)
    is_near = abs(latitude - car.latitude) < NEAR_DEG and abs(longitude - car.longitude) < NEAR_DEG
    is_second = abs(latitude - car.far_latitude) < NEAR_DEG and abs(longitude - car.far_longitude) < NEAR_DEG
    if is_first or is_near or is_second:
        car.latitude, car.longitude = latitude, longitude
        car.far_latitude, car.far_longitude = np.nan, np.nan
        return True
    car.far_latitude, car.far_longitude = latitude, longitude
    return False
