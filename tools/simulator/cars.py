"""Draw the true parameters of cars: the catalogue, what it does not say, and random deviations of each car."""

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.errors import SettingsError
from socast.core.vehicles import load_catalogue


class Car(NamedTuple):
    """Hold the true parameters of one car in SI units; powers are electric unless stated otherwise.

    Parameters
    ----------
    mass, drag_area, rolling_resistance, capacity : float
        Values of the catalogue with random deviations of a few per cent. [kg], [m^2], [1], [J]
    under_inflation : float
        Relative deficit of the tyre pressure. [1]
    brake_drag : float
        Force of rubbing brake pads. [N]
    wear : float
        Share of the capacity of the battery that is lost. [1]
    roof_drag_area : float
        Drag area of a load on the roof. [m^2]
    odometer : float
        Reading at the first shift. [m]
    speedometer : float
        Wheel speed divided by the true speed. [1]
    warmth : float
        Temperature that the driver prefers above the usual one. [K]

    Notes
    -----
    The comments of `cars.toml` describe all other parameters.
    """

    mass: float
    drag_area: float
    rolling_resistance: float
    capacity: float
    voltage: float
    resistance: float
    efficiency: float
    motor_power: float
    regen_power: float
    regen_share: float
    electronics: float
    heater_power: float
    heater_cop: float
    cooler_power: float
    cooler_cop: float
    cabin_loss: float
    cabin_capacity: float
    pack_capacity: float
    pack_loss: float
    pack_heater: float
    pack_heater_below: float
    soc_step: float
    ride_median: float
    ride_spread: float
    under_inflation: float
    brake_drag: float
    wear: float
    roof_drag_area: float
    odometer: float
    speedometer: float
    winter_rolling: float
    warmth: float


SPREAD: Final = {
    "mass": 0.015,
    "drag_area": 0.03,
    "rolling_resistance": 0.06,
    "resistance": 0.08,
    "efficiency": 0.01,
    "electronics": 0.10,
    "cabin_loss": 0.08,
    "heater_cop": 0.03,
    "cooler_cop": 0.03,
}
"""Relative standard deviation of each parameter of a car about the value of its model. [1]"""


def make_car(model: str, rng: np.random.Generator, traits: Mapping[str, float] | None = None) -> Car:
    """Draw a car of a model."""
    known = load_catalogue()
    if model not in known:
        raise SettingsError(f"no car model is called {model!r}; choose from {', '.join(sorted(known))}")
    entry = known[model]
    base: dict[str, Any] = _traits()["default"] | _traits().get(model, {})
    base |= {
        "mass": entry.mass_kg,
        "drag_area": entry.drag_coefficient * entry.frontal_area_m2,
        "rolling_resistance": entry.rolling_resistance,
        "capacity": (entry.usable_capacity_kwh or entry.nominal_capacity_kwh) * 3.6e6,
    }
    base |= traits or {}
    fade = base.pop("fade")
    for name, spread in SPREAD.items():
        base[name] *= float(np.exp(spread * np.clip(rng.normal(), -2.5, 2.5)))
    kilometres = float(rng.uniform(8e3, 120e3))
    return Car(
        **base,
        under_inflation=float(rng.beta(2, 6)) * 0.4,
        brake_drag=float(rng.gamma(2.0, 4.0)),
        wear=min(0.25, kilometres / 120e3 * float(rng.uniform(0.05, 0.18)) * fade),
        roof_drag_area=0.12 if rng.uniform() < 0.4 else 0.0,
        odometer=kilometres * 1000,
        speedometer=float(rng.normal(1.0, 0.006)),
        warmth=0.0,
    )


def age_car(car: Car, odometer: float) -> Car:
    """Return a car at another reading of its odometer; the wear of its battery is proportional to the reading.

    Units: odometer [m].
    """
    return car._replace(odometer=odometer, wear=min(0.4, car.wear * odometer / car.odometer))


@cache
def _traits() -> dict[str, dict[str, float]]:
    """Return the content of `cars.toml`."""
    return tomllib.loads((Path(__file__).parent / "cars.toml").read_text(encoding="utf-8"))
