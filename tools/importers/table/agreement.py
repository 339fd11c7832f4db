"""Check whether speed, distance, energy and charge of imported rows agree, and whether the power has the right sign."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Final, Literal, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.cleaning.clock import SIGMA
from socast.core.formatting import format_count
from socast.core.vehicles import load_catalogue
from socast.tools.importers.table.agreement_sums import FASTEST, HARDEST, CarSums, sum_cars
from socast.tools.importers.table.time_words import spell_offset

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
MOST_NAMED: Final = 5
"""Cars that are named in one line."""
USED: Final = (0.05, 1.0)
"""Consumptions of road vehicles. [kWh/km]"""
REGAINED: Final = -0.5
"""Energy per distance that a descent may regain. [kWh/km]"""
SPARSE: Final = 15.0
"""Time between rows from which the speed shows distances only roughly. [s]"""
NEARLY: Final = 1.35
"""Ratio of two distances that such rows explain. [1]"""
NIGHT: Final = 0.5
"""Largest share of the driving from 0 to 5 h of solar time. [1]"""
ASSUMED_NIGHT: Final = 0.1
"""The same where times without a zone were read as UTC, and local time would at least halve it. [1]"""
SUN: Final = "clock against sun"
"""Name of the check of the hours of driving, which needs no order of rows."""
INVERT: Final = "invert the sign of the current or the power in [fields]"
"""Remedy where the sign of all cars is wrong."""


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


class Check(NamedTuple):
    """Hold one comparison: what was found, within which limits it should lie, and what to do where it does not.

    Parameters
    ----------
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


class _Signs(NamedTuple):
    """Hold what the witnesses say of the signs of all cars: the cars whose power is inverted, and of each car."""

    evidence: Mapping[str, SignEvidence]

    @property
    def inverted(self) -> list[str]:
        """Cars with an inverted power."""
        return [name for name, each in self.evidence.items() if each.sign < 0]

    @property
    def is_common(self) -> bool:
        """Whether most of the cars of which something is known have an inverted power: the map is wrong."""
        known = [each.sign for each in self.evidence.values() if each.sign]
        return bool(known) and sum(known) < 0

    @property
    def contradiction(self) -> SignEvidence | None:
        """The first car of which witnesses contradict each other."""
        return next((each for each in self.evidence.values() if each.is_contradictory), None)


def check_agreement(cars: list[CarSums], *, is_zone_assumed: bool = False) -> list[Check]:
    """Return the checks over all cars.

    Parameters
    ----------
    is_zone_assumed : bool
        Whether times that state no zone were read as UTC.
    """
    signs = _Signs({car.vehicle: judge_sign(car) for car in cars})
    total = sum_cars(cars)
    # one car with another sign must not change what is said of the others
    alike = [car for car in cars if (signs.evidence[car.vehicle].sign < 0) == signs.is_common] or cars
    return [
        *_check_speeds(cars, total),
        _check_distance("odometer against speed", total, "odometer", "odometer"),
        _check_distance("positions against speed", total, "fixes", "positions"),
        *_check_single_cars(cars, signs),
        _check_sign(alike, signs),
        _check_consumption(sum_cars(alike), signs),
        _check_capacity(alike, signs),
        _check_night(total, is_zone_assumed=is_zone_assumed),
    ]


def _check_speeds(cars: Sequence[CarSums], total: Mapping[str, float]) -> list[Check]:
    """Return a check that has failed where speeds are impossible."""
    wild = [(*car.wild, car.vehicle) for car in cars if car.wild is not None]
    if not wild:
        return []
    time, speed, name = min(wild)
    count = int(total["wild"])
    found = (
        f"{format_count(count, 'row')} with an impossible speed, first {speed * 3.6:.4g} km/h of {name} at "
        f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M:%S} UTC"
    )
    limit = f"{FASTEST * 3.6:.0f} km/h, and a rise by {HARDEST:g} m/s each second"
    remedy = "correct or empty these cells, or the unit of the speed; the other checks leave these rows out"
    return [Check("speed", found, limit, False, remedy)]


def _check_single_cars(cars: Sequence[CarSums], signs: _Signs) -> list[Check]:
    """Return a check that has failed where the power of single cars has another sign than that of the others."""
    known = [name for name, each in signs.evidence.items() if each.sign]
    other = [name for name in known if (signs.evidence[name].sign < 0) != signs.is_common]
    if not other:
        return []
    words = [
        f"{name} ({' and '.join(each.inverted if each.sign < 0 else each.right)})"
        for name in other[:MOST_NAMED]
        for each in [signs.evidence[name]]
    ]
    more = f" and {len(other) - MOST_NAMED} more" if len(other) > MOST_NAMED else ""
    found = f"{len(other)} of {len(cars)} cars with the opposite sign of current or power: {', '.join(words)}{more}"
    listed = ", ".join(f"'{name}'" for name in other[:MOST_NAMED])
    remedy = f"invert these cars alone: inverted = [{listed}{', ...' if more else ''}] in [vehicle]"
    return [Check("sign of each car", found, "one sign for all cars", False, remedy)]


def _check_distance(name: str, total: Mapping[str, float], of: str, what: str) -> Check:
    """Compare a distance with that by speed."""
    limit, measured, by_speed = "ratio from 0.9 to 1.1", total[of], total[f"speed_beside_{of}"]
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
    if ratio > 0 and abs(np.log(ratio / near)) < 0.1:
        return Check(name, found, limit, False, f"{likely[near]}; correct the unit in [fields]")
    apart = total["duration"] / max(total["steps"], 1.0)
    if apart > SPARSE and 1 / NEARLY <= ratio <= NEARLY:
        return Check(name, f"{found}; rows {apart:.3g} s apart show no distance by speed", limit, None)
    return Check(name, found, limit, False, "one of them is wrong or has gaps: draw both over the time")


def _check_sign(cars: Sequence[CarSums], signs: _Signs) -> Check:
    """Check that acceleration takes power, and about as much as a car has mass."""
    name, limit = "power of acceleration", f"{MASSES[0]:g} to {MASSES[1]:g} kg"
    fits = [fit for car in cars if (fit := fit_mass(car.pairs)) is not None]
    if not fits:
        return Check(name, "too few rows with power and changing speed", limit, None)
    mass = float(np.median([fit.mass for fit in fits]))
    found = f"{mass:,.0f} kg per acceleration"
    if MASSES[0] <= mass <= MASSES[1]:
        return Check(name, found, limit, True)
    if signs.is_common:
        return Check(name, found, limit, False, f"acceleration charges the battery: {INVERT}")
    if mass < -MASSES[0] and signs.contradiction is not None:
        return Check(name, found, limit, False, _describe_contradiction(signs.contradiction))
    words = "power and speed do not belong together: check their units, and that their clocks agree"
    return Check(name, found, limit, False, words)


def _describe_contradiction(evidence: SignEvidence) -> str:
    """Return which witnesses contradict each other; no sign is advised."""
    right, inverted = " and ".join(evidence.right), " and ".join(evidence.inverted)
    return (
        f"witnesses contradict each other: {right} for this sign, {inverted} against it; check that speed, power and "
        "charge have one clock"
    )


def _check_consumption(total: Mapping[str, float], signs: _Signs) -> Check:
    """Check that the energy per distance is that of a road vehicle."""
    name, limit = "energy per km", f"{USED[0]:g} to {USED[1]:g} kWh/km"
    if total["distance"] < 1000.0:
        return Check(name, "less than 1 km with power and speed", limit, None)
    used = total["energy"] / total["distance"] / 3600.0
    found = f"{used:.3g} kWh/km over {total['distance'] / 1000:.1f} km"
    if USED[0] <= used <= USED[1] and not signs.is_common:
        return Check(name, found, limit, True)
    if signs.is_common:
        return Check(name, found, limit, False, "the sign of current or power is wrong: invert it in [fields]")
    if REGAINED <= used < USED[0] and any(each.sign for each in signs.evidence.values()):
        words = "a descent or braking may have regained it, as other values say that the sign is right"
        return Check(name, f"{found}; {words}", limit, None)
    if REGAINED <= used < 0.0:
        words = "a descent may have regained it, or the sign is wrong: nothing in the file shows which"
        return Check(name, f"{found}; {words}", limit, None)
    return Check(name, found, limit, False, "check the units of power and speed")


def _check_capacity(cars: Sequence[CarSums], signs: _Signs) -> Check:
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
        text = f"{ratio:.0%} of the nominal capacity (median of {format_count(len(known), 'car')})"
        return _judge_capacity(text, "60 to 115 %", 0.6 <= ratio <= 1.15, ratio, ratio, signs)
    value = float(np.median([capacity for _, capacity in found]))
    text = f"{value:.3g} kWh per 100 % (median of {format_count(len(found), 'car')})"
    return _judge_capacity(text, "4 to 250 kWh", 4.0 <= value <= 250.0, value, value / 50.0, signs)


def _judge_capacity(found: str, limit: str, passed: bool, sign: float, scale: float, signs: _Signs) -> Check:
    """Return the check of a capacity with the remedy that its value suggests."""
    if passed:
        return Check("energy against charge", found, limit, True)
    if sign < 0 and signs.is_common:
        words = f"the charge rises while energy is drawn: {INVERT}"
    elif sign < 0 and signs.contradiction is not None:
        words = _describe_contradiction(signs.contradiction)
    elif scale > 8:
        words = "the charge hardly changes; if it is a fraction, set unit = '1' for soc_pct"
    else:
        words = "check the units of power and charge, and the model of the car"
    return Check("energy against charge", found, limit, False, words)


def _check_night(total: Mapping[str, float], *, is_zone_assumed: bool) -> Check:
    """Check by the sun that the clock has the right time zone."""
    most = ASSUMED_NIGHT if is_zone_assumed else NIGHT
    limit = f"at most {most * 100:g} % of the driving from 0 to 5 h solar time"
    if total["driving"] < 1800.0:
        return Check(SUN, "less than half an hour of driving with positions", limit, None)
    share = total["night"] / total["driving"]
    as_local = total["night_as_read"] / total["driving"]
    zone = spell_offset(round(total["east"] / total["driving"] / 15.0) * 3600.0)
    if share <= most or (share <= NIGHT and as_local > share / 2.0):
        return Check(SUN, f"{share:.0%}", limit, True)
    words = "set zone in [time], unless the cars drive at night"
    if is_zone_assumed and as_local <= share / 2.0:
        words = f"set zone = '{zone}' in [time], unless the times are UTC and the cars drive at night"
        return Check(SUN, f"{share:.0%}, and {as_local:.0%} with local time", limit, False, words)
    return Check(SUN, f"{share:.0%}", limit, False, words)
