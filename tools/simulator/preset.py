"""Plan the fleets that presets describe: which cars, which shifts, which drivers, and how long each ride is.

A preset is a TOML file beside this module. A simulation without a preset draws the day, the driver and the length of
each ride on the way. A preset plans them before the first shift, so that the proportions are as described.
"""

import tomllib
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from socast.core.batch import Floats, Ints
from socast.core.errors import SettingsError
from socast.tools.simulator.cars import Car, age_car
from socast.tools.simulator.driver import DrivingStyle, make_style
from socast.tools.simulator.settings import UTC_OFFSET, Faults
from socast.tools.simulator.shift import Orders

PRESETS: Final = ("teo",)
"""Names of the presets that come with the product."""
CLUSTER: Final = 5000.0
"""Width of a cluster of distances. [m]"""
SHORTEST_RIDE: Final = 350.0
"""Shortest planned distance of a ride. [m]"""
LONGEST_RIDE: Final = 34e3
"""Longest planned distance of a ride, given by the size of the city. [m]"""
CARS_PER_ROOT_RIDE: Final = 0.2
"""Number of cars of a model divided by the square root of its rides, so that a rare model has a few cars too. [1]"""
FEWEST_CARS: Final = 2
"""Smallest number of cars of a model."""
YEAR: Final = 365
"""Number of days over which the shifts of each car are spread."""
WINTER_TYRE_SEASON: Final = ((12, 15), (3, 15))
"""First and last day, as (month, day), on which winter tyres are mandatory and mounted."""
WARMTH: Final = 1.5
"""Standard deviation of the temperature that drivers prefer above the usual one. [K]"""


class Fleet(NamedTuple):
    """Hold the settings that all cars of a preset share; the comments in its file describe each of them."""

    coldest: float
    hottest: float
    drivers_per_car: float
    rides_per_shift: float
    daily_km: float
    begin_h: tuple[float, float]
    charge: tuple[float, float]
    charge_below: float
    prepared_s: float
    boarding_s: tuple[float, float]
    alighting_s: tuple[float, float]
    idle_s: float
    estimate_factor: float
    false_start: float
    errand: float
    never_sends: Sequence[str]
    may_lack: Sequence[str]

    @property
    def faults(self) -> Faults:
        """Rates of faults that apply by default."""
        return Faults(false_start=self.false_start, errand=self.errand)


class Preset(NamedTuple):
    """Hold a fleet as a file describes it.

    Parameters
    ----------
    models : mapping of str to mapping
        The tables `rides` and `traits` of each vehicle model.
    """

    fleet: Fleet
    models: Mapping[str, Mapping[str, Any]]


class Driver(NamedTuple):
    """Describe a driver, who drives in the same way on every shift.

    Parameters
    ----------
    warmth : float
        As in `cars.Car`. [K]
    """

    name: str
    style: DrivingStyle
    warmth: float


class PlannedShift(NamedTuple):
    """Hold a shift that a car has to drive.

    Parameters
    ----------
    distances : (n,) float
        Distance of each ride. [m]
    """

    day: int
    driver: Driver
    distances: Floats


class PlannedCar(NamedTuple):
    """Hold the model, the traits and the shifts of one car of a preset."""

    model: str
    traits: Mapping[str, float]
    planned_shifts: list[PlannedShift]


def refuse_unused_settings(name: str | None, given: Sequence[str]) -> None:
    """Raise an error for settings that have no effect with a preset, or without one."""
    if name is None and "rides" in given:
        raise SettingsError(f"--rides needs a preset; give one such as --preset {PRESETS[0]}")
    idle = [f"--{setting.replace('_', '-')}" for setting in given if setting != "rides"]
    if name is not None and idle:
        raise SettingsError(f"preset {name} has its own {', '.join(idle)}; leave that out, --rides sets its size")


@cache
def load_preset(name: str) -> Preset:
    """Return a preset that comes with the product."""
    if name not in PRESETS:
        raise SettingsError(f"no preset is called {name!r}; choose from {', '.join(PRESETS)}")
    tables = tomllib.loads((Path(__file__).parent / f"{name}.toml").read_text(encoding="utf-8"))
    return Preset(Fleet(**tables.pop("fleet")), tables)


def plan_cars(preset: Preset, rides: int, seed: int) -> list[PlannedCar]:
    """Return the cars of a fleet and their shifts."""
    totals = np.array([sum(table["rides"]) for table in preset.models.values()])
    numbers = apportion_total(totals, rides)
    cars = [max(FEWEST_CARS, round(CARS_PER_ROOT_RIDE * number**0.5)) for number in numbers]
    drivers = make_drivers(round(preset.fleet.drivers_per_car * sum(cars)), seed)
    places = []
    for index, (model, table) in enumerate(preset.models.items()):
        rng = np.random.default_rng([seed, 6, index])
        deck = draw_distances(np.array(table["rides"]), numbers[index], rng)
        hands = np.array_split(deck, cars[index])
        places += [PlannedCar(model, table["traits"], _duties(preset.fleet, hand, drivers, rng)) for hand in hands]
    return places


def make_drivers(count: int, seed: int) -> list[Driver]:
    """Draw the drivers of a fleet."""
    drivers = []
    for index in range(count):
        rng = np.random.default_rng([seed, 7, index])
        drivers.append(Driver(f"driver-{index + 1:03d}", make_style(rng), float(rng.normal(0.0, WARMTH))))
    return drivers


def draw_distances(counts: Ints, number: int, rng: np.random.Generator) -> Floats:
    """Return the distances of rides in random order, in proportion to the counts of clusters.

    Units: returns [m].

    Notes
    -----
    The logarithm of the share of longer rides is interpolated monotonically (Fritsch and Carlson 1980, SIAM J. Numer.
    Anal. 17:238) between the edges of the clusters. So the density has no steps and falls where the counts fall. The
    draws are stratified: the number of rides in each cluster deviates from its share by one at most.
    """
    filled = int(np.flatnonzero(counts)[-1]) + 1
    edges = np.append(SHORTEST_RIDE, np.minimum(CLUSTER * np.arange(1.0, filled + 1), LONGEST_RIDE))
    longer = 1.0 - np.append(0.0, np.cumsum(counts[:filled])) / counts.sum()
    longer[-1] = 0.2 / counts.sum()  # a fifth of a ride is beyond: a logarithm needs something
    grid = np.linspace(edges[0], edges[-1], 4000)
    shorter = 1.0 - np.exp(PchipInterpolator(edges, np.log(longer))(grid))
    quantiles = (np.arange(number) + rng.uniform(size=number)) / number
    return rng.permutation(np.interp(quantiles, shorter, grid))


def apportion_total(shares: Ints, total: int) -> list[int]:
    """Return whole numbers in proportion to shares that add up to a total, by the largest-remainder method.

    Examples
    --------
    >>> apportion_total(np.array([5, 3, 1]), 10)
    [6, 3, 1]
    """
    exact = shares / shares.sum() * total
    whole = np.floor(exact).astype(int)
    whole[np.argsort(whole - exact, kind="stable")[: total - int(whole.sum())]] += 1
    return [int(number) for number in whole]


def make_orders(fleet: Fleet, duty: PlannedShift) -> Orders:
    """Return the orders of dispatch for a planned shift."""
    return Orders(
        driver_id=duty.driver.name,
        style=duty.driver.style,
        distances=duty.distances,
        charge=fleet.charge,
        charge_below=fleet.charge_below,
        prepared=fleet.prepared_s,
        boarding=fleet.boarding_s,
        alighting=fleet.alighting_s,
        idle=fleet.idle_s,
        estimate_factor=fleet.estimate_factor,
    )


def adapt_car(fleet: Fleet, car: Car, duty: PlannedShift, begin: float) -> Car:
    """Return a car with its age, its tyres and the temperature that its driver prefers at the begin of a shift.

    Units: begin [s].
    """
    car = age_car(car, car.odometer + 1000.0 * fleet.daily_km * duty.day)
    rolling = car.winter_rolling if is_winter_tyre_season(begin) else 0.0
    return car._replace(winter_rolling=rolling, warmth=duty.driver.warmth)


def is_winter_tyre_season(time: float) -> bool:
    """Return whether winter tyres are mandatory in Montreal at a time.

    Units: time [s].

    Examples
    --------
    >>> is_winter_tyre_season(datetime(2018, 12, 15, 12, tzinfo=UTC).timestamp())
    True
    """
    day = datetime.fromtimestamp(time + UTC_OFFSET, UTC)
    first, last = WINTER_TYRE_SEASON
    return (day.month, day.day) >= first or (day.month, day.day) <= last


def _duties(fleet: Fleet, hand: Floats, drivers: list[Driver], rng: np.random.Generator) -> list[PlannedShift]:
    """Return the shifts of a car, at most one a day, spread over the year."""
    shifts = min(YEAR, max(1, round(len(hand) / fleet.rides_per_shift)))
    days = ((np.arange(shifts) + rng.uniform(size=shifts)) * YEAR / shifts).astype(int)
    days = np.maximum.accumulate(days - np.arange(shifts)) + np.arange(shifts)  # no day twice
    who = rng.integers(len(drivers), size=shifts)
    parts = np.array_split(hand, shifts)
    return [PlannedShift(int(day), drivers[i], part) for day, i, part in zip(days, who, parts, strict=True)]
