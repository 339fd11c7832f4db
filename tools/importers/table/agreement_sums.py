"""Sum for each car what speed, distance, energy and charge of imported rows say, over rows in the order of time."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.columns import EARTH_RADIUS
from socast.tools.importers.table.row_messages import compute_power

LONGEST_STEP: Final = 120.0
"""Longest time between two rows over which speed and power are integrated, and for which a value stays known. [s]"""
LONGEST_ACCELERATION: Final = 15.0
"""Longest time between two rows from which an acceleration is taken. [s]"""
MOVING: Final = 10 / 3.6
"""Speed above which fixes are compared, because they wander around a car at rest. [m/s]"""
STANDING: Final = 0.3
"""Speed below which a car stands. [m/s]"""
FASTEST: Final = 83.0
"""Speed that no road vehicle of a fleet exceeds: 300 km/h. [m/s]"""
HARDEST: Final = 8.0
"""Acceleration that no road vehicle exceeds: the strongest sports cars reach 8 m/s^2 over a second. [m/s^2]"""
SHORT_STOP: Final = 90.0
"""Time after driving in which a standing car does not charge yet. [s]"""
MOST_CHARGED: Final = 500.0
"""Power at standstill beyond which energy and charge are not compared, because the car may charge. [W]"""
MOST_PAIRS: Final = 2048
"""Accelerations of a car that are kept; where there are more, every second one is dropped."""
PAIR: Final = ("kinetic", "power", "speed")
"""Kinetic power per mass [W/kg], power [W] and speed [m/s] of a step in which a car changes its speed."""

SUMS: Final = (
    "duration",  # between rows that are integrated [s]
    "steps",  # number of these steps
    "odometer",  # distance by the odometer, where both are known [m]
    "speed_beside_odometer",
    "fixes",  # distance by fixes, where both are known and the car drives [m]
    "speed_beside_fixes",
    "energy",  # by power, of steps in which the car drives and its speed is known [J]
    "distance",  # by speed, where the power is known too [m]
    "climb",  # net climb in steps with power, speed and elevation [m]
    "climb_distance",  # by speed, in the same steps [m]
    "energy_beside_soc",  # by power, outside charging [J]
    "soc",  # fall of the state of charge in the same steps [1]
    "charged_energy",  # by power, while the charge rises at standstill [J]
    "charged_soc",  # fall of the charge in the same steps, negative [1]
    "rest_energy",  # by power, in the first time of a stop [J]
    "rest",  # duration of the same steps [s]
    "night",  # driving from 0 to 5 h of solar time [s]
    "driving",  # driving with a known longitude [s]
    "night_as_read",  # driving from 0 to 5 h by the clock as it was read [s]
    "east",  # longitude times duration, while driving [deg s]
    "wild",  # rows with an impossible speed, or an impossible rise to it
)
_HELD: Final = ("speed_kmh", "power", "charging")
"""Fields whose last value is known for a time; of others the difference to the last value counts, however old it is."""
_USED: Final = (*_HELD, "odometer_km", "latitude_deg", "longitude_deg", "elevation_m", "soc_pct")


class CarSums(NamedTuple):
    """Hold the sums of one car.

    Parameters
    ----------
    pairs : (n, 3) float
        Accelerations, with the columns of `PAIR`.
    wild : (float, float), optional
        Time [Unix s] and value [m/s] of the first impossible speed.
    """

    vehicle: str
    model: str | None
    sums: Mapping[str, float]
    pairs: Floats = np.zeros((0, len(PAIR)))
    wild: tuple[float, float] | None = None


class AgreementSums:
    """Sum what the checks compare, for each car, over rows in the order of time."""

    def __init__(self) -> None:
        self._last = pd.DataFrame()
        self._sums: dict[int, Floats] = {}
        self._pairs: dict[int, _Pairs] = {}
        self._wild: dict[int, tuple[float, float]] = {}
        self.span = (np.inf, -np.inf)

    def add(self, rows: np.ndarray) -> None:
        """Add rows."""
        if not len(rows):
            return
        self.span = (min(self.span[0], float(rows["time"][0])), max(self.span[1], float(rows["time"][-1])))
        held, known = self._hold(rows)
        steps = _compute_steps({str(name): held[name].to_numpy() for name in held}, known)
        vehicles = held["vehicle"].to_numpy()[1:]
        places, at = np.unique(vehicles, return_inverse=True)
        totals = np.array([np.bincount(at, np.nan_to_num(steps[name]), len(places)) for name in SUMS])
        pairs = np.column_stack([steps[name] for name in PAIR])
        is_pair = np.isfinite(pairs).all(axis=1)
        speeds, times = held["speed_kmh"].to_numpy()[1:] if "speed_kmh" in held else None, held["time"].to_numpy()[1:]
        for column, place in enumerate(places.tolist()):
            self._sums[place] = self._sums.get(place, np.zeros(len(SUMS))) + totals[:, column]
            self._pairs.setdefault(place, _Pairs()).add(pairs[is_pair & (at == column)])
            if place not in self._wild and speeds is not None and totals[SUMS.index("wild"), column]:
                first = int(np.flatnonzero((steps["wild"] > 0) & (at == column))[0])
                self._wild[place] = (float(times[first]), float(speeds[first]) / 3.6)

    def _hold(self, rows: np.ndarray) -> tuple[pd.DataFrame, dict[str, Floats]]:
        """Return rows with the last known values, by car, after the last row of before, and since when they are."""
        frame = pd.DataFrame({name: rows[name] for name in ("time", "vehicle")})
        frame["power"] = compute_power(rows)
        for name in _USED:
            if name in (rows.dtype.names or ()):
                frame[name] = rows[name]
        speed = frame.get("speed_kmh")
        frame["driven at"] = np.nan if speed is None else frame["time"].where(speed > STANDING * 3.6)
        for name in _HELD:
            if name in frame:
                frame[f"{name} at"] = frame["time"].where(frame[name].notna())
        frame = pd.concat([self._last, frame]).sort_values(["vehicle", "time"], kind="stable", ignore_index=True)
        held = frame.groupby("vehicle", sort=False).ffill()
        held.insert(0, "vehicle", frame["vehicle"])
        self._last = held.groupby("vehicle", sort=False).tail(1)
        known = {name: held["time"].to_numpy() - held[f"{name} at"].to_numpy() for name in _HELD if name in held}
        return held, known

    def list_cars(self, names: list[str], models: Mapping[str, str], model: str | None) -> list[CarSums]:
        """Return the sums of each car."""
        return [
            CarSums(
                names[place],
                models.get(names[place], model),
                dict(zip(SUMS, sums.tolist(), strict=True)),
                self._pairs[place].list_all(),
                self._wild.get(place),
            )
            for place, sums in sorted(self._sums.items())
        ]


class _Pairs:
    """Keep a bounded number of rows, evenly chosen: every row, then every second one, and so on."""

    def __init__(self) -> None:
        self._kept: list[Floats] = []
        self._seen, self._stride = 0, 1

    def add(self, pairs: Floats) -> None:
        """Add rows after those of the calls before."""
        places = self._seen + np.arange(len(pairs))
        self._seen += len(pairs)
        self._kept.append(pairs[places % self._stride == 0])
        if sum(map(len, self._kept)) > 2 * MOST_PAIRS:
            while sum(map(len, self._kept)) > MOST_PAIRS:
                self._kept = [np.concatenate(self._kept)[::2]]
                self._stride *= 2

    def list_all(self) -> Floats:
        """Return the rows that were kept."""
        return np.concatenate(self._kept)[: 2 * MOST_PAIRS] if self._kept else np.zeros((0, len(PAIR)))


def sum_cars(cars: list[CarSums]) -> dict[str, float]:
    """Return the sums of all cars by the names of `SUMS`."""
    return {name: sum(car.sums[name] for car in cars) for name in SUMS}


def _compute_steps(rows: Mapping[str, Floats], ages: Mapping[str, Floats]) -> dict[str, Any]:
    """Return what each step between two rows adds to the sums, and the pairs of its acceleration."""

    def get(name: str) -> Floats:
        values = rows[name] if name in rows else np.full(len(rows["time"]), np.nan)
        return np.where(ages[name] <= LONGEST_STEP, values, np.nan) if name in ages else values

    step = np.diff(rows["time"])
    valid = (step > 0) & (step <= LONGEST_STEP) & (np.diff(rows["vehicle"]) == 0)
    step = np.where(valid, step, np.nan)
    speed, power = get("speed_kmh") / 3.6, get("power")
    rise = np.diff(speed) / step
    is_short = step <= LONGEST_ACCELERATION
    wild = valid & ((speed[1:] > FASTEST) | (is_short & (rise > HARDEST)))
    possible = (np.maximum(speed[1:], speed[:-1]) <= FASTEST) & ~(is_short & (np.abs(rise) > HARDEST))
    distance = np.where(possible, step * (speed[1:] + speed[:-1]) / 2, np.nan)
    odometer = np.diff(get("odometer_km")) * 1000.0
    odometer = np.where((odometer >= 0) & (odometer < LONGEST_STEP * 70.0), odometer, np.nan)
    fixes = measure_fixes(get("latitude_deg"), get("longitude_deg"))
    fixes = np.where((speed[1:] > MOVING) & (fixes < LONGEST_STEP * 70.0), fixes, np.nan)
    energy = step * (power[1:] + power[:-1]) / 2
    is_flagged = get("charging")[1:] > 0
    stands = np.maximum(speed[1:], speed[:-1]) < STANDING
    fall = -np.diff(get("soc_pct")) / 100.0 + 0.0 * step
    # what charging, with a flag or without one, adds to a sum must not look like driving that charges the battery
    charges = is_flagged | (stands & (fall < 0.0))
    may_charge = charges | (stands & (np.abs(energy) > MOST_CHARGED * step))
    drives = np.where(is_flagged | stands, np.nan, 0.0)
    climb = np.diff(get("elevation_m")) + drives + 0.0 * energy + 0.0 * distance
    rests = stands & ~is_flagged & (rows["time"][1:] - rows["driven at"][1:] <= SHORT_STOP)
    rest_energy = np.where(rests, energy, np.nan)
    kinetic = (speed[1:] ** 2 - speed[:-1] ** 2) / (2 * step)
    kinetic = np.where(is_short & possible & (np.abs(kinetic) > 0.5), kinetic, np.nan)
    solar = (rows["time"][1:] / 3600.0 + get("longitude_deg")[1:] / 15.0) % 24.0
    driving = np.where(np.isfinite(solar) & (speed[1:] > MOVING), step, np.nan)
    outside = np.where(may_charge, np.nan, 0.0)
    return {
        "duration": step,
        "steps": valid.astype("f8"),
        "odometer": odometer + 0.0 * distance,
        "speed_beside_odometer": distance + 0.0 * odometer,
        "fixes": fixes + 0.0 * distance,
        "speed_beside_fixes": distance + 0.0 * fixes,
        "energy": energy + 0.0 * distance + drives,
        "distance": distance + 0.0 * energy + drives,
        "climb": climb,
        "climb_distance": distance + 0.0 * climb,
        "energy_beside_soc": energy + 0.0 * fall + outside,
        "soc": fall + 0.0 * energy + outside,
        "charged_energy": np.where(charges, energy + 0.0 * fall, np.nan),
        "charged_soc": np.where(charges, fall + 0.0 * energy, np.nan),
        "rest_energy": rest_energy,
        "rest": step + 0.0 * rest_energy,
        "night": np.where(solar < 5.0, driving, np.nan),
        "driving": driving,
        "night_as_read": np.where(rows["time"][1:] / 3600.0 % 24.0 < 5.0, driving, np.nan),
        "east": get("longitude_deg")[1:] * driving,
        "wild": wild.astype("f8"),
        "kinetic": kinetic,
        "power": (power[1:] + power[:-1]) / 2 + drives,
        "speed": (speed[1:] + speed[:-1]) / 2,
    }


def measure_fixes(latitude: Floats, longitude: Floats) -> Floats:
    """Return the distance between successive fixes. [m]"""
    north = np.radians(np.diff(latitude))
    east = np.radians(np.diff(longitude)) * np.cos(np.radians(latitude[1:]))
    distance: Floats = EARTH_RADIUS * np.hypot(north, east)
    return distance
