"""Judge from independent witnesses whether the power of a car has the right sign: positive when discharging.

Four witnesses are heard. Acceleration takes power, and the charge falls by what is drawn: each of these is sufficient.
A car that has just stopped draws power for its accessories, and driving takes energy, unless the road descends: these
two count where neither of the others is known, and where they agree. Witnesses that contradict each other decide
nothing.
"""

from typing import Final, Literal, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.cleaning.clock import SIGMA
from socast.core.vehicles import load_catalogue
from socast.tools.importers.table.agreement_sums import CarSums

LEAST_FALL: Final = 0.05
"""Change of the charge of a car from which it is compared with the energy. [1]"""
LEAST_ENERGY: Final = 2.0
"""Energy that a display of the charge must show. [kWh]"""
LARGEST_CAPACITY: Final = 400.0
"""Largest capacity of a road vehicle. [kWh]"""
SMALLEST_CAPACITY: Final = 2.0
"""Smallest capacity for which the charge says something of the sign. [kWh]"""
LEAST_PAIRS: Final = 50
"""Accelerations from which a mass is estimated."""
MASSES: Final = (200.0, 7500.0)
"""Masses of road vehicles. [kg]"""
CERTAIN: Final = 6.0
"""Ratio of the mass to its standard error from which acceleration is a witness. [1]"""
CLOSE: Final = 0.6
"""Partial correlation of power and kinetic power from which acceleration outweighs all but the charge. [1]"""
OUTLIER: Final = 4.0
"""Residual beyond which a row does not count for the mass, in units of the robust spread. [1]"""
USUAL_MASS: Final = 1600.0
"""Mass of a car whose model is not known. [kg]"""
GRAVITY: Final = 9.81
"""[m/s^2]"""
DEEPEST: Final = 3000.0
"""Largest net descent of a road, beyond which recuperation explains no energy. [m]"""
ROAD: Final = (0.03, 1.0)
"""Consumptions of road vehicles without climbs. [kWh/km]"""
LEAST_REST: Final = 60.0
"""Standing time from which its power is a witness. [s]"""
REST: Final = (80.0, 8000.0)
"""Powers of the accessories of a car. [W]"""

Sign = Literal[-1, 0, 1]


class SignEvidence(NamedTuple):
    """Hold what the witnesses say of one car.

    Parameters
    ----------
    sign : int
        1 for a right sign, -1 for an inverted one, 0 where nothing decides.
    """

    sign: Sign
    right: tuple[str, ...]
    inverted: tuple[str, ...]

    @property
    def is_contradictory(self) -> bool:
        """Whether witnesses contradict each other, so that nothing is decided."""
        return self.sign == 0 and bool(self.right and self.inverted)


class MassFit(NamedTuple):
    """Hold the power per unit of kinetic power, about the mass of a car [kg], its standard error, and a correlation."""

    mass: float
    error: float
    correlation: float


def fit_mass(pairs: Floats) -> MassFit | None:
    """Return the mass that accelerations show, with outliers left out; None where there are too few."""
    if len(pairs) < LEAST_PAIRS:
        return None
    kinetic, power, speed = pairs.T
    terms = np.column_stack((np.ones(len(pairs)), speed, speed**3 / 1000.0))
    kept = np.ones(len(pairs), bool)
    for _ in range(4):
        if kept.sum() < LEAST_PAIRS or not np.ptp(kinetic[kept]) > 0.0:
            return None
        road, *_ = np.linalg.lstsq(terms[kept], np.column_stack((kinetic, power))[kept], rcond=None)
        free, driven = (np.column_stack((kinetic, power)) - terms @ road).T
        size = float(free[kept] @ free[kept])
        if size <= 0.0:
            return None
        mass = float(free[kept] @ driven[kept]) / size
        residual = driven - mass * free
        spread = SIGMA * float(np.median(np.abs(residual[kept])))
        if spread <= 0.0:
            break
        kept = np.abs(residual) <= OUTLIER * spread
    left = residual[kept]
    error = np.sqrt(float(left @ left) / max(1, len(left) - 4) / size)
    total = float(driven[kept] @ driven[kept])
    return MassFit(mass, float(error), mass * np.sqrt(size / total) if total > 0.0 else 0.0)


def estimate_capacity(car: CarSums) -> float | None:
    """Return the energy per full fall of the displayed charge. [kWh]

    Returns
    -------
    float or None
        None where less than 5 % were used, unless so much energy was that a display in % would have shown more.
    """
    fall, energy = car.sums["soc"], car.sums["energy_beside_soc"] / 3.6e6
    if abs(fall) < LEAST_FALL and (abs(energy) < LEAST_ENERGY or abs(fall) > abs(energy) / LARGEST_CAPACITY):
        return None
    return energy / fall if fall else float(np.copysign(np.inf, energy))


def find_mass(car: CarSums) -> float:
    """Return the mass of the model of a car. [kg]"""
    known = load_catalogue().get(car.model) if car.model else None
    return known.mass_kg if known else USUAL_MASS


def judge_sign(car: CarSums) -> SignEvidence:
    """Return what the witnesses say of the sign of the power of a car."""
    acceleration, is_close = _hear_acceleration(car)
    charge, rest, mean = _hear_charge(car), _hear_rest(car), _hear_mean(car)
    witnesses = {"acceleration": acceleration, "charge": charge, "power at stops": rest, "energy per km": mean}
    right, inverted = (tuple(name for name, sign in witnesses.items() if sign == each) for each in (1, -1))
    if acceleration and charge:
        sign = acceleration if acceleration == charge else 0
    elif charge:
        sign = charge
    elif acceleration:
        others = {each for each in (rest, mean) if each}
        # power that lags behind the speed makes a weak correlation of either sign
        sign = 0 if acceleration < 0 and not is_close and 1 in others else acceleration
    elif rest and mean:
        sign = mean if mean == rest else 0
    else:
        sign = mean
    return SignEvidence(sign, right, inverted)


def _hear_acceleration(car: CarSums) -> tuple[Sign, bool]:
    """Return the sign with which acceleration takes power, and whether power follows it closely."""
    fit = fit_mass(car.pairs)
    if fit is None or not MASSES[0] <= abs(fit.mass) <= MASSES[1] or abs(fit.mass) < CERTAIN * fit.error:
        return 0, False
    return (1 if fit.mass > 0.0 else -1), abs(fit.correlation) > CLOSE


def _hear_charge(car: CarSums) -> Sign:
    """Return the sign with which the charge falls by what is drawn, outside charging, else while charging."""
    of_driving = (car.sums["energy_beside_soc"], car.sums["soc"])
    of_charging = (car.sums["charged_energy"], car.sums["charged_soc"])
    for energy, fall in (of_driving, of_charging):
        if abs(fall) >= LEAST_FALL and SMALLEST_CAPACITY <= abs(energy / fall / 3.6e6) <= LARGEST_CAPACITY:
            return 1 if energy / fall > 0.0 else -1
    return 0


def _hear_rest(car: CarSums) -> Sign:
    """Return the sign with which a car that has just stopped draws power."""
    power = car.sums["rest_energy"] / car.sums["rest"] if car.sums["rest"] >= LEAST_REST else 0.0
    return (1 if power > 0.0 else -1) if REST[0] <= abs(power) <= REST[1] else 0


def _hear_mean(car: CarSums) -> Sign:
    """Return the sign with which driving takes energy, with its climbs; a descent may explain what driving regains."""
    energy, distance = car.sums["energy"], car.sums["distance"]
    if distance < 1000.0:
        return 0
    weight = find_mass(car) * GRAVITY
    if car.sums["climb_distance"] > 0.8 * distance:
        lifted = weight * car.sums["climb"] * (0.85 if car.sums["climb"] < 0.0 else 1.1)
        fitting = [sign for sign in (1, -1) if ROAD[0] <= (sign * energy - lifted) / distance / 3600.0 <= ROAD[1]]
        return fitting[0] if len(fitting) == 1 else 0  # type: ignore[return-value]
    if energy > 0.0:
        return 1
    return -1 if -energy > weight * DEEPEST else 0
