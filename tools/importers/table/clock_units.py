"""Judge in which unit a clock counts: by distances, by accelerations, by its name, and by the usual period."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.tools.importers.table.agreement_sums import MOVING, measure_fixes
from socast.tools.importers.table.time_source import TIME_UNITS, find_time_unit

UNITS: Final = ("ns", "us", "ms", "s", "min", "h", "d")
"""Units that are told from each other by far."""
TICKS: Final = ("0.1 s", "10 ms")
"""Units that are told only by a distance in known units."""
LEAST_DISTANCE: Final = 300.0
"""Distance from which the unit of a clock is judged. [m]"""
LEAST_GROWTHS: Final = 3
"""Changes of an odometer from which a distance is known."""
NEAR_TICK: Final = 0.1
"""Largest logarithm of the ratio of the distance in ticks to the right one."""
FAR: Final = 2.5
"""Logarithm of a ratio of distances from which the unit in a name is doubted."""
USUAL_ACCELERATION: Final = 2.0
"""Acceleration that one of 100 steps of a drive has, about. [m/s^2]"""
LEAST_STEPS: Final = 20
"""Changes of speed from which accelerations are judged."""
LONGEST_GAP: Final = 20.0
"""Longest step over which speed is integrated, in usual steps."""
USUAL_PERIODS: Final = (0.005, 120.0)
"""Times between two rows of a logger. [s]"""


def judge_unit(parts: Sequence[np.ndarray], named: str | None, units: Mapping[str, str | None]) -> tuple[str, str]:
    """Return the unit of times that count from a start, and why.

    Parameters
    ----------
    units : mapping of str to str or None
        Unit of each field, None where it is not known and the values are as they stand in the file.
    """
    ratio, witness = find_ratio(parts)
    if ratio is not None:
        exact = named is None and all(units.get(field) is not None for field in ("speed_kmh", "odometer_km"))
        unit = find_nearest(ratio, [*UNITS, *TICKS] if exact else UNITS)
        distance = f"distance by speed agrees with {'the odometer' if witness == 'odometer' else 'positions'} in {unit}"
        if named is None or named == unit:
            return unit, distance
        if abs(np.log(ratio / (find_time_unit(named) or 1.0))) > FAR:
            return unit, f"{distance}, not in {named} as the name says; check it"
        return named, f"unit in the name: {named}"
    if (acceleration := _find_acceleration(parts)) is not None:
        unit = find_nearest(acceleration / USUAL_ACCELERATION, UNITS)
        named_acceleration = acceleration / (find_time_unit(named) or 1.0) if named else 0.0
        if named is None or not 0.02 < named_acceleration < 50.0:
            shown = f"in {unit} a car accelerates as speed does here"
            return unit, shown if named is None else f"{shown}, not in {named} as the name says; check it"
    if named is not None:
        return named, f"unit in the name: {named}"
    period = _find_period(parts)
    least, most = USUAL_PERIODS
    unit = next((each for each in ("s", "ms", "us", "ns") if least <= period * TIME_UNITS[each] <= most), "s")
    return unit, f"{unit} by the usual step of {period:.4g}; check it"


def find_ratio(parts: Sequence[np.ndarray]) -> tuple[float | None, str]:
    """Return distance by odometer or fixes over the integral of speed by the numbers of a clock, and the witness."""
    for field, measure in (("odometer", _measure_odometer), ("fixes", _measure_fixes)):
        sums = np.zeros(2)
        for rows in parts:
            for car in _divide(rows):
                sums += measure(car)
        if sums[0] > LEAST_DISTANCE and sums[1] > 0.0:
            return float(sums[0] / sums[1]), field
    return None, ""


def _divide(rows: np.ndarray) -> list[np.ndarray]:
    """Return the rows of each car in the order of time."""
    cars = [rows[rows["vehicle"] == each] for each in np.unique(rows["vehicle"])]
    return [car[np.argsort(car["time"], kind="stable")] for car in cars]


def _take(rows: np.ndarray, field: str) -> tuple[Floats, Floats]:
    """Return times and values where a field is known."""
    if field not in (rows.dtype.names or ()):
        return np.zeros(0), np.zeros(0)
    known = np.isfinite(rows[field]) & np.isfinite(rows["time"])
    return rows["time"][known], rows[field][known]


def _integrate_speed(rows: np.ndarray) -> tuple[Floats, Floats]:
    """Return times, and the integral of speed up to each of them; gaps add nothing."""
    time, speed = _take(rows, "speed_kmh")
    step = np.diff(time)
    usual = float(np.median(step[step > 0])) if np.any(step > 0) else 0.0
    added = np.where(step <= LONGEST_GAP * usual, step * (speed[1:] + speed[:-1]) / 7.2, 0.0)
    return time, np.concatenate(([0.0], np.cumsum(added))) if len(time) else np.zeros(0)


def _measure_odometer(rows: np.ndarray) -> Floats:
    """Return the distance by odometer, and the integral of speed beside it."""
    time, integral = _integrate_speed(rows)
    at, odometer = _take(rows, "odometer_km")
    growth = np.diff(odometer)
    if len(time) < 2 or np.sum(growth > 0) < LEAST_GROWTHS or np.any(growth < -1.0):
        return np.zeros(2)
    first, last = (float(np.interp(at[end], time, integral)) for end in (0, -1))
    return np.array([(odometer[-1] - odometer[0]) * 1000.0, last - first])


def _measure_fixes(rows: np.ndarray) -> Floats:
    """Return the distance by fixes while the car moves, and the integral of speed beside it."""
    time, integral = _integrate_speed(rows)
    speed = _take(rows, "speed_kmh")[1] / 3.6
    at, latitude = _take(rows, "latitude_deg")
    longitude = _take(rows, "longitude_deg")[1]
    if len(time) < 2 or len(at) < 2 or len(longitude) != len(latitude):
        return np.zeros(2)
    distance = measure_fixes(latitude, longitude)
    moves = (np.interp(at[1:], time, speed) > MOVING) & (distance < 5000.0)
    beside = np.diff(np.interp(at, time, integral))
    return np.array([distance[moves].sum(), beside[moves].sum()])


def _find_acceleration(parts: Sequence[np.ndarray]) -> float | None:
    """Return the acceleration per number of the clock that one of 100 steps has, None where speed hardly changes."""
    found = []
    for rows in parts:
        for car in _divide(rows):
            time, speed = _take(car, "speed_kmh")
            step, change = np.diff(time), np.abs(np.diff(speed)) / 3.6
            changes = (step > 0) & (change > 0)
            found.append(change[changes] / step[changes])
    values = np.concatenate(found) if found else np.zeros(0)
    return float(np.percentile(values, 95)) if len(values) >= LEAST_STEPS else None


def _find_period(parts: Sequence[np.ndarray]) -> float:
    """Return the usual step of the clock."""
    steps = np.concatenate([np.diff(np.unique(car["time"])) for rows in parts for car in _divide(rows)] or [np.ones(1)])
    return float(np.median(steps)) if len(steps) else 1.0


def find_nearest(ratio: float, units: Sequence[str] = UNITS) -> str:
    """Return the unit that is nearest to a number of seconds; one of `TICKS` only where it fits exactly."""
    seconds = {unit: find_time_unit(unit) or 1.0 for unit in units}
    exact = [unit for unit in TICKS if unit in seconds and abs(np.log(ratio / seconds[unit])) < NEAR_TICK]
    return exact[0] if exact else min(UNITS, key=lambda unit: abs(np.log(ratio / seconds[unit])))
