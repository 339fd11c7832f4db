"""Made-up series of car-days: cars of a fleet that share the weather of dates, and differ by what is planted."""

from datetime import date

import numpy as np

from socast.core.condition.car_days import Series

FIRST = date(2018, 9, 1).toordinal()


def make_fleet(
    seed: int, cars: int = 8, days: int = 120, *, step: float = 0.0, at: int = 60, rate: float = 0.0
) -> Series:
    """Return the logarithms of the factors of cars, with heavy-tailed noise; a step or rate [1/year] is of the first.

    Each car rests on one day in seven, and days share a deviation of 3 % and a season.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(days)
    amount = rng.uniform(5.0, 25.0, (cars, days))
    of_date = 0.03 * rng.normal(size=days) + 0.02 * np.sin(2.0 * np.pi * time / 365.0)
    noise = 0.03 / np.sqrt(2.0) * rng.standard_t(4, size=(cars, days))
    noise += 0.15 * rng.normal(size=(cars, days)) / np.sqrt(amount)
    value = 0.05 * rng.normal(size=(cars, 1)) + of_date + noise
    value += 0.01 / np.sqrt(365.0) * rng.normal(size=(cars, days)).cumsum(axis=1)
    value[0, at:] += step
    value[0] += rate * time / 365.25
    value[rng.uniform(size=(cars, days)) < 1.0 / 7.0] = np.nan
    return Series(FIRST + time, value, amount, np.zeros((cars, days)))
