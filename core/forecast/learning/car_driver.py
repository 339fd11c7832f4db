"""What each car and each driver takes over what the model says, and how each car's shifts go, from shift to shift.

The logarithm of what a shift took over what was predicted is what the car always takes, and its driver, and a rest that
is of the day. Each shift tells of all three, by how unsure they are: a Kalman filter with a scalar measurement. Cars
and drivers change: what is known of them ages with each of their shifts, though never beyond what is known of cars and
drivers at large.
"""

from collections import deque
from hashlib import blake2b
from math import log, nan
from statistics import fmean, median
from typing import Any, Final, NamedTuple

from core.forecast.soc_filter import COARSEST, DRIVER, NOISE

CAR: Final = 0.08
"""Standard deviation of what cars of a model take, about what they take on average. [1]"""
DAY: Final = 0.06
"""The same of days of one car and driver."""
SEASON: Final = 60
"""Shifts, a quarter's, in which a car may change as much as cars differ: tyres, wear, what it carries."""
CAREER: Final = 240
"""Shifts, a year's, in which a driver may change as much as drivers differ."""
MOST_OFF: Final = 0.7
"""A shift that is off by more, as a logarithm, is not learned from."""
LEAST_SHIFTS: Final = 3
"""Shifts of a car from which on it has habits."""
KEPT_SHIFTS: Final = 20
"""Shifts of a car that are remembered."""
KEPT_DRIVERS: Final = 10_000
"""Drivers that are remembered, beside `DRIVERS_A_CAR`: those whose shifts were last."""
DRIVERS_A_CAR: Final = 8
"""More than share one, shifts and stand-ins together."""


class Habit(NamedTuple):
    """How a shift went: how long it was [h], and the energy predicted of it over what is usual in as many hours."""

    hours: float
    busy: float


class Scales:
    """Mean and variance of what each car and driver takes, as the logarithm of the energy over the predicted.

    Cars go by their lanes, drivers by their codes, see `code_of`.
    """

    def __init__(self) -> None:
        self._habits: dict[int, deque[Habit]] = {}
        self._cars: dict[int, tuple[float, float]] = {}
        self._drivers: dict[int, tuple[float, float]] = {}  # whose shift was last at the end

    def expected(self, lane: int, driver: int | None = None) -> tuple[float, float]:
        """Return mean and variance for a car, and for its driver where it is known."""
        car, spread = self._cars.get(lane, (0.0, CAR**2))
        person, unsure = self.part_of(driver)
        return car + person, spread + unsure + DAY**2

    def part_of(self, driver: int | None) -> tuple[float, float]:
        """Return mean and variance of the part that is a driver's."""
        return self._drivers.get(-1 if driver is None else driver, (0.0, DRIVER**2))

    def learn(self, lane: int, driver: int | None, predicted_kwh: float, used_kwh: float, capacity_kwh: float) -> None:
        """Learn from a shift."""
        if not (predicted_kwh > 0.0 and used_kwh > 0.0 and abs(log(used_kwh / predicted_kwh)) < MOST_OFF):
            return
        mean, variance = self.expected(lane, driver)
        car, spread = self._cars.get(lane, (0.0, CAR**2))
        read = COARSEST * capacity_kwh / used_kwh
        total = variance + NOISE**2 / predicted_kwh + read**2 / 6.0
        off = log(used_kwh / predicted_kwh) - mean
        self._cars[lane] = car + spread / total * off, older(spread - spread**2 / total, CAR, SEASON)
        if driver is not None:
            person, unsure = self.part_of(driver)
            self._drivers.pop(driver, None)
            self._drivers[driver] = person + unsure / total * off, older(unsure - unsure**2 / total, DRIVER, CAREER)
            if len(self._drivers) > KEPT_DRIVERS + DRIVERS_A_CAR * len(self._cars):
                del self._drivers[next(iter(self._drivers))]

    def went(self, lane: int, habit: Habit) -> None:
        """Remember how a shift of a car went."""
        self._habits.setdefault(lane, deque(maxlen=KEPT_SHIFTS)).append(habit)

    def habit(self, lane: int) -> Habit:
        """Return how the shifts of a car go; NaN while too few are known."""
        known = self._habits.get(lane, ())
        if len(known) < LEAST_SHIFTS:
            return Habit(nan, nan)
        return Habit(median(each.hours for each in known), fmean(each.busy for each in known))

    def dump(self) -> Any:
        """Return the state as plain lists."""
        habits = [(lane, list(known)) for lane, known in self._habits.items()]
        return list(self._cars.items()), list(self._drivers.items()), habits

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        cars, drivers, habits = state
        self._cars = {int(lane): (mean, variance) for lane, (mean, variance) in cars}
        self._drivers = {int(code): (mean, variance) for code, (mean, variance) in drivers}
        self._habits = {int(lane): deque((Habit(*h) for h in own), maxlen=KEPT_SHIFTS) for lane, own in habits}


def older(variance: float, usual: float, shifts: int) -> float:
    """Return a variance a shift later, of what changes by the deviation that is usual in so many shifts."""
    return min(variance + usual**2 / shifts, usual**2)


def code_of(driver: str) -> int:
    """Return the code of a driver, of 48 bits: the same for good, and of two drivers hardly ever.

    Examples
    --------
    >>> code_of("driver-037") == code_of("driver-037") != code_of("driver-038")
    True
    """
    return int.from_bytes(blake2b(driver.encode(), digest_size=6).digest(), "big")
