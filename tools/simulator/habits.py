"""Draw drivers with heater habits, who keep to their cars, and the cars that conditions change."""

from math import ceil
from typing import Final, NamedTuple

import numpy as np

from socast.core.vehicles import load_catalogue
from socast.tools.simulator.cars import Car
from socast.tools.simulator.conditions import Conditions, Newcomers
from socast.tools.simulator.driver import DrivingStyle, make_style
from socast.tools.simulator.shift import Orders

DRIVERS_PER_CAR: Final = 1.6
STRANGER: Final = 0.15
"""Share of the shifts that none of the two regular drivers of a car drives."""
SET_POINT: Final = 2.0
"""Standard deviation of the set point of drivers. [K]"""
PREHEATING: Final = 0.4
"""Share of the drivers who heat the cabin before their shift."""
PREHEATING_TIME: Final = (300.0, 1200.0)
"""Shortest and longest such time. [s]"""
SAVING: Final = 0.25
"""Share of the drivers who save heat."""
SAVED: Final = (4.0, 0.4)
"""By how much they lower the set point [K], and the share of the power of the heater that they use [1]."""
AGED: Final = (0.58, 0.72)
"""Smallest and largest share of the usable capacity that an aged pack has left. [1]"""
FADE: Final = 0.0005
"""Share of its capacity that an aged pack loses in a day. [1]"""


class Habit(NamedTuple):
    """Describe a driver and their use of the heater.

    Parameters
    ----------
    warmth : float
        Preferred temperature above the usual one. [K]
    heater_share : float
        Share of the power of the heater that is used. [1]
    preheating : float
        Time for which the cabin is heated before the shift. [s]
    """

    name: str
    style: DrivingStyle
    warmth: float
    heater_share: float
    preheating: float


def draw_habit(seed: int, driver: int) -> Habit:
    """Draw the habit of a driver."""
    rng = np.random.default_rng([seed, 8, driver])
    style, warmth = make_style(rng), float(rng.normal(0.0, SET_POINT))
    preheats, saves, time = rng.uniform() < PREHEATING, rng.uniform() < SAVING, float(rng.uniform(*PREHEATING_TIME))
    return Habit(
        f"driver-{driver + 1:03d}",
        style,
        warmth - SAVED[0] * saves,
        SAVED[1] if saves else 1.0,
        time if preheats else 0.0,
    )


def choose_driver(car: int, vehicles: int, newcomers: Newcomers, rng: np.random.Generator) -> int:
    """Return the index of the driver of a shift: one of the two regular drivers of the car, or anyone else."""
    settled = vehicles - newcomers.cars
    pool = max(2, ceil(DRIVERS_PER_CAR * settled))
    which, any_of, draw = int(rng.integers(2)), int(rng.integers(pool)), rng.uniform()
    if car >= settled:
        return pool + 2 * (car - settled) + which
    return any_of if draw < STRANGER else (2 * car + which) % pool


def apply_habit(orders: Orders, car: Car, habit: Habit) -> tuple[Orders, Car]:
    """Return the orders and the car of a shift as a driver with a habit uses them."""
    orders = orders._replace(driver_id=habit.name, style=habit.style, prepared=habit.preheating)
    return orders, car._replace(warmth=habit.warmth, heater_power=car.heater_power * habit.heater_share)


def resize_pack(car: Car, model: str, index: int, conditions: Conditions) -> tuple[Car, float | None]:
    """Return a car with the battery size that its turn gives, and the nominal capacity that it announces, if any.

    Units: nominal_kwh [kWh].

    Returns
    -------
    car : Car
        Capacity, heat capacity and heat loss of the pack grow with its size, and its resistance falls.
    """
    if not conditions.battery_sizes:
        return car, None
    nominal = conditions.battery_sizes[index % len(conditions.battery_sizes)]
    ratio = nominal / load_catalogue()[model].nominal_capacity_kwh
    car = car._replace(
        capacity=car.capacity * ratio,
        resistance=car.resistance / ratio,
        pack_capacity=car.pack_capacity * ratio,
        pack_loss=car.pack_loss * ratio ** (2 / 3),
    )
    return car, nominal


def find_pack_health(seed: int, vehicles: int, share: float) -> list[float]:
    """Return which share of its usable capacity each pack has left: (vehicles,) 1 except of aged packs. [1]"""
    rng = np.random.default_rng([seed, 10])
    order, left = rng.permutation(vehicles), rng.uniform(*AGED, vehicles)
    aged = set(order[: round(share * vehicles)].tolist())
    return [float(left[index]) if index in aged else 1.0 for index in range(vehicles)]
