"""Consumption factors of cars and drivers, learned from shift to shift.

The logarithm of the used over the predicted energy of a shift is the sum of three parts: of the car, of its driver and
of the day. A cold battery holds less, which adds a fourth part that is the same for all cars and proportional to the
cold. Each shift updates all of them in proportion to their variances: a Kalman filter with a scalar measurement.
Cars and drivers change, so the variance of each grows with each of their shifts, up to the variance among all cars or
drivers.
"""

from hashlib import blake2b
from math import log
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Ints, take_keys
from socast.core.forecast.filter_state import CAPACITY_SD, DEFAULT_QUANTUM
from socast.core.forecast.soc_filter import DRIVER_SD, ENERGY_SD

CAR_SD: Final = 0.08
"""Standard deviation of the consumption of cars of a model about its mean. [1]"""
DAY_FACTOR_SD: Final = 0.06
"""Standard deviation of the consumption of days with the same car and driver. [1]"""
CAR_CHANGE_SHIFTS: Final = 60
"""Number of shifts, a quarter's, in which a car may change by `CAR_SD`: tyres, wear, load."""
DRIVER_CHANGE_SHIFTS: Final = 240
"""Number of shifts, a year's, in which a driver may change by `DRIVER_SD`."""
COLD_BATTERY: Final = 10.0
"""Temperature below which a battery holds less. [°C]"""
COLD_LOSS: Final = 0.002
"""Share of its capacity that it lacks for each kelvin below that, before any shift. Estimated. [1/K]"""
COLD_LOSS_SD: Final = 0.002
"""Standard deviation of that share. [1/K]"""
LARGEST_LOG_ERROR: Final = 1.0
"""A shift with a larger logarithm of used over predicted energy is ignored. [1]"""
KEPT_DRIVERS: Final = 10_000
"""Number of drivers that are remembered, beside `DRIVERS_PER_CAR`: those with the newest shifts."""
DRIVERS_PER_CAR: Final = 8
"""Number of drivers per car that are remembered; rarely do more share one, stand-ins included."""


class LogFactor(NamedTuple):
    """Hold the normal distribution of the logarithm of a consumption factor, or of a part of it."""

    mean: float
    variance: float


UNKNOWN_CAR: Final = LogFactor(0.0, CAR_SD**2 + CAPACITY_SD**2)
"""Part of a car without a shift so far, whose usable capacity is not known either."""
UNKNOWN_DRIVER: Final = LogFactor(0.0, DRIVER_SD**2)
"""Part of a driver without a shift so far."""


class ConsumptionFactors:
    """Learn how much each car and driver uses, as the logarithm of used over predicted energy.

    Cars are identified by their lanes, drivers by their codes, see `compute_driver_code`.
    """

    def __init__(self) -> None:
        self._cars: dict[int, LogFactor] = {}
        self._drivers: dict[int, LogFactor] = {}  # the driver with the newest shift is the last
        self._cold_loss = LogFactor(COLD_LOSS, COLD_LOSS_SD**2)  # for each kelvin

    def expect(self, lane: int, driver: int | None = None) -> LogFactor:
        """Return the distribution of a shift of a car, with its driver where that is known."""
        car, person = self.get_car(lane), self.get_driver(driver)
        return LogFactor(car.mean + person.mean, car.variance + person.variance + DAY_FACTOR_SD**2)

    def get_car(self, lane: int) -> LogFactor:
        """Return the distribution of the part of a car."""
        return self._cars.get(lane, UNKNOWN_CAR)

    def get_driver(self, driver: int | None) -> LogFactor:
        """Return the distribution of the part of a driver; of any driver for None."""
        return UNKNOWN_DRIVER if driver is None else self._drivers.get(driver, UNKNOWN_DRIVER)

    def expect_cold_loss(self, celsius: Any) -> Any:
        """Return the part of the cold, 0 where the temperature is unknown. [1]"""
        return self._cold_loss.mean * np.fmax(COLD_BATTERY - celsius, 0.0)

    def add_shift(
        self,
        lane: int,
        driver: int | None,
        predicted_kwh: float,
        used_kwh: float,
        capacity_kwh: float,
        ambient_c: float = COLD_BATTERY,
        weight: float = 1.0,
    ) -> None:
        """Update the parts of a car, its driver and the cold by a shift.

        `weight` is that of the shift for the part of the cold, as the shifts of a day share much else. [1]
        """
        if not (predicted_kwh > 0.0 and used_kwh > 0.0 and abs(log(used_kwh / predicted_kwh)) < LARGEST_LOG_ERROR):
            return
        expected, car = self.expect(lane, driver), self.get_car(lane)
        reading_sd = DEFAULT_QUANTUM * capacity_kwh / used_kwh
        total = expected.variance + ENERGY_SD**2 / predicted_kwh + reading_sd**2 / 6.0
        cold, (mean, variance) = max(COLD_BATTERY - ambient_c, 0.0), self._cold_loss
        residual = log(used_kwh / predicted_kwh) - expected.mean - mean * cold
        gain = cold * variance / (total / weight + cold**2 * variance)
        self._cold_loss = LogFactor(mean + gain * residual, variance - gain * cold * variance)
        self._cars[lane] = _update_part(car, residual, total, CAR_SD, CAR_CHANGE_SHIFTS)
        if driver is not None:
            person = self.get_driver(driver)
            self._drivers.pop(driver, None)
            self._drivers[driver] = _update_part(person, residual, total, DRIVER_SD, DRIVER_CHANGE_SHIFTS)
            if len(self._drivers) > KEPT_DRIVERS + DRIVERS_PER_CAR * len(self._cars):
                del self._drivers[next(iter(self._drivers))]

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self._cars = take_keys(self._cars, lanes)

    def dump(self) -> Any:
        """Return the state as plain lists."""
        return list(self._cars.items()), list(self._drivers.items()), self._cold_loss

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        cars, drivers, cold_loss = state
        self._cold_loss = LogFactor(*cold_loss)
        self._cars = {int(lane): LogFactor(*part) for lane, part in cars}
        self._drivers = {int(code): LogFactor(*part) for code, part in drivers}


def _update_part(part: LogFactor, residual: float, total: float, sd: float, shifts: int) -> LogFactor:
    """Return a part after a shift, where `total` is the variance of the residual and the part changes meanwhile."""
    mean = part.mean + part.variance / total * residual
    return LogFactor(mean, age_variance(part.variance - part.variance**2 / total, sd, shifts))


def age_variance(variance: float, sd: float, shifts: int) -> float:
    """Return a variance after a shift, of what changes by `sd` in a number of shifts; it is at most `sd` squared."""
    return min(variance + sd**2 / shifts, sd**2)


def compute_driver_code(driver: str) -> int:
    """Return the code of a driver: 48 bits of a hash, stable and practically unique.

    Examples
    --------
    >>> compute_driver_code("driver-037") == compute_driver_code("driver-037") != compute_driver_code("driver-038")
    True
    """
    return int.from_bytes(blake2b(driver.encode(), digest_size=6).digest(), "big")
