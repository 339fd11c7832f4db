"""Check whether speed, distance, energy and state of charge of imported rows agree with each other."""

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from core.batch import Floats
from core.vehicles import load_catalogue
from tools.importers.table.row_messages import compute_power

LONGEST_STEP: Final = 120.0
"""Longest time between two rows over which speed and power are integrated. [s]"""
LONGEST_ACCELERATION: Final = 15.0
"""Longest time between two rows from which an acceleration is taken. [s]"""
EARTH_RADIUS: Final = 6371008.8
"""Mean radius of the Earth. [m]"""
MOVING: Final = 10 / 3.6
"""Speed above which fixes are compared, because they wander around a car at rest. [m/s]"""
LEAST_FALL: Final = 0.05
"""Fall of the charge of a car from which its capacity is estimated. [1]"""
LEAST_ENERGY: Final = 2.0
"""Energy that a display of the charge must show. [kWh]"""
LARGEST_CAPACITY: Final = 400.0
"""Largest capacity of a road vehicle. [kWh]"""

SUMS: Final = (
    "duration",  # between rows that are integrated [s]
    "odometer",  # distance by the odometer, where both are known [m]
    "speed_beside_odometer",
    "fixes",  # distance by fixes, where both are known and the car drives [m]
    "speed_beside_fixes",
    "energy",  # by power, where the speed is known too [J]
    "distance",  # by speed, where the power is known too [m]
    "energy_beside_soc",  # by power, outside charging [J]
    "soc",  # fall of the state of charge in the same steps [1]
    "work",  # power times power of acceleration, less the means below [W^2]
    "work_n",
    "work_power",
    "work_kinetic",
    "work_kinetic2",
    "night",  # driving from 0 to 5 h of solar time [s]
    "driving",  # driving with a known longitude [s]
)


class CarSums(NamedTuple):
    """Hold the sums of one car by the names of `SUMS`, and its model where it is known."""

    vehicle: str
    model: str | None
    sums: Mapping[str, float]


class AgreementSums:
    """Sum what the checks compare, for each car, over rows in the order of time."""

    def __init__(self) -> None:
        self._last = pd.DataFrame()
        self._sums: dict[int, Floats] = {}
        self.span = (np.inf, -np.inf)

    def add(self, rows: np.ndarray) -> None:
        """Add rows.

        Parameters
        ----------
        rows : structured array
            Rows in the order of time, after those of the calls before.
        """
        if not len(rows):
            return
        self.span = (min(self.span[0], float(rows["time"][0])), max(self.span[1], float(rows["time"][-1])))
        frame = pd.DataFrame({name: rows[name] for name in rows.dtype.names or () if name != "ride"})
        frame["power"] = compute_power(rows)
        frame = pd.concat([self._last, frame]).sort_values(["vehicle", "time"], kind="stable", ignore_index=True)
        held = frame.groupby("vehicle", sort=False).ffill()
        held.insert(0, "vehicle", frame["vehicle"])
        self._last = held.groupby("vehicle", sort=False).tail(1)
        steps = _compute_steps({str(name): held[name].to_numpy() for name in held})
        vehicles = held["vehicle"].to_numpy()[1:]
        places, at = np.unique(vehicles, return_inverse=True)
        totals = np.array([np.bincount(at, np.nan_to_num(steps[name]), len(places)) for name in SUMS])
        for column, place in enumerate(places.tolist()):
            self._sums[place] = self._sums.get(place, np.zeros(len(SUMS))) + totals[:, column]

    def list_cars(self, names: list[str], models: Mapping[str, str], model: str | None) -> list[CarSums]:
        """Return the sums of each car.

        Parameters
        ----------
        names : list of str
            Names of the cars by their places.
        models : mapping of str to str
            Model of single cars.
        model : str, optional
            Model of all others.
        """
        return [
            CarSums(names[place], models.get(names[place], model), dict(zip(SUMS, sums.tolist(), strict=True)))
            for place, sums in sorted(self._sums.items())
        ]


def _compute_steps(rows: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return what each step between two rows adds to the sums."""

    def get(name: str) -> Floats:
        return rows[name] if name in rows else np.full(len(rows["time"]), np.nan)

    step = np.diff(rows["time"])
    valid = (step > 0) & (step <= LONGEST_STEP) & (np.diff(rows["vehicle"]) == 0)
    step = np.where(valid, step, np.nan)
    speed, power = get("speed_kmh") / 3.6, get("power")
    distance = step * (speed[1:] + speed[:-1]) / 2
    odometer = np.diff(get("odometer_km")) * 1000.0
    odometer = np.where((odometer >= 0) & (odometer < LONGEST_STEP * 70.0), odometer, np.nan)
    fixes = _measure_fixes(get("latitude_deg"), get("longitude_deg"))
    fixes = np.where((speed[1:] > MOVING) & (fixes < LONGEST_STEP * 70.0), fixes, np.nan)
    energy = step * (power[1:] + power[:-1]) / 2
    is_charging = (get("charging")[1:] > 0) | ((speed[1:] < 0.3) & (energy < -500.0 * step))
    fall = np.where(is_charging, np.nan, -np.diff(get("soc_pct")) / 100.0) + 0.0 * step
    kinetic = (speed[1:] ** 2 - speed[:-1] ** 2) / (2 * step)
    kinetic = np.where((step <= LONGEST_ACCELERATION) & (np.abs(kinetic) > 0.5), kinetic, np.nan)
    mean_power = power[1:] + 0.0 * kinetic
    solar = (rows["time"][1:] / 3600.0 + get("longitude_deg")[1:] / 15.0) % 24.0
    driving = np.where(np.isfinite(solar) & (speed[1:] > MOVING), step, np.nan)
    return {
        "duration": step,
        "odometer": odometer + 0.0 * distance,
        "speed_beside_odometer": distance + 0.0 * odometer,
        "fixes": fixes + 0.0 * distance,
        "speed_beside_fixes": distance + 0.0 * fixes,
        "energy": energy + 0.0 * distance,
        "distance": distance + 0.0 * energy,
        "energy_beside_soc": energy + 0.0 * fall,
        "soc": fall + 0.0 * energy,
        "work": mean_power * kinetic,
        "work_n": np.isfinite(mean_power * kinetic).astype("f8"),
        "work_power": mean_power,
        "work_kinetic": kinetic + 0.0 * mean_power,
        "work_kinetic2": kinetic**2 + 0.0 * mean_power,
        "night": np.where(solar < 5.0, driving, np.nan),
        "driving": driving,
    }


def _measure_fixes(latitude: Floats, longitude: Floats) -> Floats:
    """Return the distance between successive fixes. [m]"""
    north = np.radians(np.diff(latitude))
    east = np.radians(np.diff(longitude)) * np.cos(np.radians(latitude[1:]))
    distance: Floats = EARTH_RADIUS * np.hypot(north, east)
    return distance


class Check(NamedTuple):
    """Hold one comparison: what was found, within which limits it should lie, and what to do where it does not.

    Parameters
    ----------
    name : str
        What is compared.
    found : str
        Values found.
    limit : str
        Limits.
    passed : bool or None
        None where the data for it are missing.
    remedy : str
        What to correct in the map; empty where nothing is wrong.
    """

    name: str
    found: str
    limit: str
    passed: bool | None
    remedy: str = ""


def check_agreement(cars: list[CarSums]) -> list[Check]:
    """Return the checks over all cars.

    Parameters
    ----------
    cars : list of CarSums
        Sums of each car.
    """
    total = {name: sum(car.sums[name] for car in cars) for name in SUMS}
    return [
        _check_distance("odometer against speed", total["odometer"], total["speed_beside_odometer"], "odometer"),
        _check_distance("positions against speed", total["fixes"], total["speed_beside_fixes"], "positions"),
        _check_sign(total),
        _check_consumption(total),
        _check_capacity(cars),
        _check_night(total),
    ]


def _check_distance(name: str, measured: float, by_speed: float, what: str) -> Check:
    """Compare a distance with that by speed."""
    limit = "ratio from 0.9 to 1.1"
    if by_speed < 1000.0 or (what == "odometer" and measured < 5000.0):
        return Check(name, f"less than {5 if what == 'odometer' else 1} km to compare", limit, None)
    ratio = measured / by_speed
    found = f"{what} {measured / 1000:.1f} km, speed {by_speed / 1000:.1f} km, ratio {ratio:.3g}"
    if 0.9 <= ratio <= 1.1:
        return Check(name, found, limit, True)
    likely = {
        1.609344: "the speed is probably in mph",
        3.6: "the speed is probably in m/s",
        1 / 1.609344: f"the {'odometer is' if what == 'odometer' else 'speed is'} probably in "
        f"{'miles' if what == 'odometer' else 'km/h, not mph'}",
        1 / 3.6: "the speed is probably in km/h, not m/s",
        1000.0: "the odometer is probably in m",
    }
    near = min(likely, key=lambda each: abs(np.log(ratio / each)) if ratio > 0 else np.inf)
    words = likely[near] if ratio > 0 and abs(np.log(ratio / near)) < 0.1 else "one of them is wrong or has gaps"
    return Check(name, found, limit, False, f"{words}; correct the unit in [fields]")


def fit_mass(total: Mapping[str, float]) -> float | None:
    """Return the power per unit of kinetic power, which is about the mass of the car. [kg]

    Parameters
    ----------
    total : mapping of str to float
        Sums by the names of `SUMS`.

    Returns
    -------
    float or None
        None where fewer than 50 steps have power and a changing speed.
    """
    n = total["work_n"]
    if n < 50:
        return None
    covariance = total["work"] - total["work_power"] * total["work_kinetic"] / n
    variance = total["work_kinetic2"] - total["work_kinetic"] ** 2 / n
    return covariance / variance if variance > 0 else None


def _check_sign(total: Mapping[str, float]) -> Check:
    """Check that acceleration takes power, and about as much as a car has mass."""
    limit = "200 to 7500 kg"
    mass = fit_mass(total)
    if mass is None:
        return Check("power of acceleration", "too few rows with power and changing speed", limit, None)
    found = f"{mass:,.0f} kg per acceleration"
    if 200.0 <= mass <= 7500.0:
        return Check("power of acceleration", found, limit, True)
    if mass < -100.0:
        words = "acceleration charges the battery: invert the sign of the current or the power in [fields]"
    else:
        words = "power and speed do not belong together: check their units, and that their clocks agree"
    return Check("power of acceleration", found, limit, False, words)


def _check_consumption(total: Mapping[str, float]) -> Check:
    """Check that the energy per distance is that of a road vehicle."""
    limit = "0.05 to 1 kWh/km"
    if total["distance"] < 1000.0:
        return Check("energy per km", "less than 1 km with power and speed", limit, None)
    used = total["energy"] / total["distance"] / 3600.0
    found = f"{used:.3g} kWh/km over {total['distance'] / 1000:.1f} km"
    if 0.05 <= used <= 1.0:
        return Check("energy per km", found, limit, True)
    words = (
        "the sign of current or power is wrong: invert it in [fields]"
        if used < 0
        else "check the units of power and speed"
    )
    return Check("energy per km", found, limit, False, words)


def estimate_capacity(car: CarSums) -> float | None:
    """Return the energy per full fall of the displayed charge. [kWh]

    Parameters
    ----------
    car : CarSums
        Sums of the car.

    Returns
    -------
    float or None
        None where less than 5 % were used, unless so much energy was that a display in % would have shown more.
    """
    fall, energy = car.sums["soc"], car.sums["energy_beside_soc"] / 3.6e6
    if abs(fall) < LEAST_FALL and (abs(energy) < LEAST_ENERGY or abs(fall) > abs(energy) / LARGEST_CAPACITY):
        return None
    return energy / fall if fall else float(np.copysign(np.inf, energy))


def _check_capacity(cars: list[CarSums]) -> Check:
    """Compare the energy by power with the change of the state of charge."""
    catalogue = load_catalogue()
    found = [(car, capacity) for car in cars if (capacity := estimate_capacity(car)) is not None]
    if not found:
        return Check("energy against charge", "no car used 5 % of its charge with power known", "capacity", None)
    known = [
        (car, value, catalogue[car.model].nominal_capacity_kwh)
        for car, value in found
        if car.model is not None and car.model in catalogue
    ]
    if known:
        ratios = [value / nominal for _, value, nominal in known]
        ratio = float(np.median(ratios))
        text = f"{ratio:.0%} of the nominal capacity (median of {len(known)} car{'s' * (len(known) > 1)})"
        return _judge_capacity(text, "60 to 115 %", 0.6 <= ratio <= 1.15, ratio, ratio)
    value = float(np.median([capacity for _, capacity in found]))
    text = f"{value:.3g} kWh per 100 % (median of {len(found)} car{'s' * (len(found) > 1)})"
    return _judge_capacity(text, "4 to 250 kWh", 4.0 <= value <= 250.0, value, value / 50.0)


def _judge_capacity(found: str, limit: str, passed: bool, sign: float, scale: float) -> Check:
    """Return the check of a capacity with the remedy that its value suggests."""
    if passed:
        return Check("energy against charge", found, limit, True)
    if sign < 0:
        words = "the charge rises while energy is drawn: invert the sign of the current or the power in [fields]"
    elif scale > 8:
        words = "the charge hardly changes; if it is a fraction, set unit = '1' for soc_pct"
    else:
        words = "check the units of power and charge, and the model of the car"
    return Check("energy against charge", found, limit, False, words)


def _check_night(total: Mapping[str, float]) -> Check:
    """Check by the sun that the clock has the right time zone."""
    limit = "at most 50 % of the driving from 0 to 5 h solar time"
    if total["driving"] < 1800.0:
        return Check("clock against sun", "less than half an hour of driving with positions", limit, None)
    share = total["night"] / total["driving"]
    words = "set zone in [time], unless the cars drive at night"
    return Check("clock against sun", f"{share:.0%}", limit, share <= 0.5, "" if share <= 0.5 else words)
