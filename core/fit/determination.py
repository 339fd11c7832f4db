"""Tell which coefficients the rides of a fit determine, and which drives would determine the others.

A coefficient is determined where its standard deviation is at most `DETERMINED` of that of its prior. For each other
one, the Fisher information of what might be driven next is added to that of the rides: more days like these, or drives
that are made for one phenomenon, such as hills. The errors of such a drive are those that the fit estimated: of each
row, and of the ride and the day as a whole.

References
----------
Chaloner, Verdinelli, Statistical Science 10 (1995) 273, DOI 10.1214/ss/1177009939: Bayesian design of experiments by
the posterior covariance of a linear model.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.batch import Floats
from socast.core.columns import GRAVITY, JOULES_PER_KWH, KMH, STANDARD_AIR_DENSITY, ZERO_CELSIUS
from socast.core.fit.accessory_curve import LEVELS
from socast.core.fit.nested_effects import SHARED, integrate_car_factor
from socast.core.fit.priors import is_curved
from socast.core.fit.records import Determination
from socast.core.fit.window_fit import build_prediction_columns
from socast.core.fit.window_solver import GroupFit, GroupRows
from socast.core.models import Term
from socast.core.models.features import EFFECT_PREFIX, Columns
from socast.core.vehicles.fleet import CarParameters

DETERMINED: Final = 0.5
"""Standard deviation over that of the prior up to which a coefficient is determined by the rides. [1]"""
MOST_DAYS: Final = 200
"""Largest number of more days like those of the fit that is worth naming."""
MOST_DRIVES: Final = 10
"""Largest number of drives that is worth naming."""
MINUTES: Final = 30
"""Length of a drive. [min]"""
LEVEL_PREFIX: Final = "accessories: "
"""Beginning of the name of a level of the accessory curve."""
ELEVATION: Final = "elevation"
"""What rides lack whose roads have no slope at all: measured elevation varies on level roads too."""
DRIVER: Final = 75.0
"""Mass of the driver. [kg]"""


class Drive(NamedTuple):
    """Describe a drive that is made for one phenomenon.

    Parameters
    ----------
    low, high : float
        Lowest and highest speed. [km/h]
    acceleration : float
        Acceleration and deceleration between them. [m/s^2]
    grade : float
        Grade of the road, up and down in turn. [1]
    ambient_c : float, optional
        Outside temperature, the usual one without it. [°C]
    """

    low: float
    high: float
    acceleration: float = 0.0
    grade: float = 0.0
    ambient_c: float | None = None


DRIVES: Final[Mapping[str, Drive]] = MappingProxyType(
    {
        "at a steady 50 km/h": Drive(50.0, 50.0),
        "at a steady 110 km/h": Drive(110.0, 110.0),
        "over hills of 5 %": Drive(50.0, 50.0, grade=0.05),
        "in town, with gentle starts and stops": Drive(0.0, 50.0, 0.8),
        "with hard starts and stops": Drive(0.0, 70.0, 2.0),
        "standing, switched on": Drive(0.0, 0.0),
        "below \N{MINUS SIGN}5 °C": Drive(0.0, 60.0, 0.8, ambient_c=-5.0),
        "above 32 °C": Drive(0.0, 60.0, 0.8, ambient_c=32.0),
    }
)
"""Drives by name."""


def determine_terms(
    terms: Sequence[Term], group: GroupRows, fitted: GroupFit, figures: Mapping[str, float]
) -> list[Determination]:
    """Return how far the rides determine each coefficient and each level of the accessory curve.

    Parameters
    ----------
    terms : sequence of Term
        Terms of the model.
    group : GroupRows
        Rows of the fit.
    figures : mapping of str to float
        Figures of the car, and the usual outside temperature [°C], by column of the ride table.
    """
    plain = tuple(term for term in terms if not is_curved(term))
    names = {term.name: i for i, term in enumerate(plain)}
    if group.curved:
        names |= {f"{LEVEL_PREFIX}{level}": group.terms + i for i, level in enumerate(LEVELS)}
    before = np.sqrt(np.diag(group.prior.covariance))
    cars = integrate_car_factor(fitted.elimination.cars, fitted.spreads.car).sums
    known = cars.sum(axis=0)[: len(before), : len(before)]
    share = _compute_shares(before, known)
    rest = [i for i in names.values() if share[i] > DETERMINED]
    slopes = {term.name for term in plain if not known[names[term.name]].any() and _takes_slope(term)}
    days = _count(before, known, rest, known / max(len(group.car), 1), MOST_DAYS)
    drives = {
        name: _count(before, known, rest, _inform(plain, group, fitted, figures, drive), MOST_DRIVES)
        for name, drive in DRIVES.items()
        if rest and not (slopes and drive.grade)  # without elevation, no drive shows what hills do
    }
    found = []
    for name, i in names.items():
        able = {} if name in slopes else {drive: counts[i] for drive, counts in drives.items() if i in counts}
        best = min(able, key=able.__getitem__, default="")
        found.append(
            Determination(
                name=name,
                sd_over_prior=float(share[i]),
                determined=bool(share[i] <= DETERMINED),
                days=days.get(i),
                drive=best,
                drives=able.get(best),
                missing=ELEVATION if name in slopes else "",
            )
        )
    return found


def _takes_slope(term: Term) -> bool:
    """Return whether a term needs the elevation of the road."""
    names = [name.removeprefix(EFFECT_PREFIX) for name in term.columns if name.startswith(EFFECT_PREFIX)]
    return any("grade" in effects.get(name).arguments for name in names)


def _compute_shares(before: Floats, information: Floats) -> Floats:
    """Return each standard deviation, given some information, over that of the prior. [1]"""
    return np.sqrt(np.diag(np.linalg.inv(np.eye(len(before)) + information * np.outer(before, before))))


def _count(before: Floats, information: Floats, rest: Sequence[int], each: Floats, most: int) -> dict[int, int]:
    """Return how many times an information determines each coefficient of `rest`, without those it does not."""
    found: dict[int, int] = {}
    for number in _list_counts(most):
        share = _compute_shares(before, information + number * each)
        found |= {i: number for i in rest if i not in found and share[i] <= DETERMINED}
        if len(found) == len(rest):
            break
    return found


def _list_counts(most: int) -> list[int]:
    """Return the numbers to try: all up to 10, then in steps of about a tenth.

    Examples
    --------
    >>> _list_counts(14)
    [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14]
    """
    made = [1]
    while made[-1] < most:
        made.append(min(made[-1] + max(made[-1] // 10, 1), most))
    return made


def _inform(
    plain: tuple[Term, ...],
    group: GroupRows,
    fitted: GroupFit,
    figures: Mapping[str, float],
    drive: Drive,
) -> Floats:
    """Return the information of a drive on the coefficients and the numbers of the curve."""
    hours = group.columns[:, -1]
    minutes = min(max(round(60.0 * float(np.mean(hours))), 1), MINUTES)
    table = _simulate_drive(plain, figures, minutes, drive)
    columns = Columns(table)
    design, _ = build_prediction_columns(plain, columns, len(table), fitted.curve)
    weight = fitted.products.sums[:, -2, -2].sum() / float(hours @ hours)  # the mean weight of a row of the fit
    spreads = fitted.spreads
    shared = np.column_stack(
        [columns["effect_rolling"] * columns["rolling_resistance"], columns["duration_s"] / 3600.0]
    )
    variances = np.array([spreads.ride_drive**2 + spreads.day_drive**2, spreads.ride_power**2 + spreads.day_power**2])
    noise = np.eye(len(table)) * spreads.row**2 / weight + (shared * variances[:SHARED]) @ shared.T
    return np.asarray(design.T @ np.linalg.solve(noise, design))


def _simulate_drive(plain: tuple[Term, ...], figures: Mapping[str, float], minutes: int, drive: Drive) -> pd.DataFrame:
    """Return the rows of a drive, each of some minutes, with the energies of the effects of terms."""
    time = np.arange(MINUTES * 60, dtype=np.float64)
    rise = (drive.high - drive.low) * KMH
    speed = np.full(len(time), drive.high * KMH)
    if drive.acceleration:
        ramp = rise / drive.acceleration
        phase = time % (2.0 * ramp + 30.0)  # speed up, hold for 20 s, slow down, stand for 10 s
        rising, falling = phase * drive.acceleration, (2.0 * ramp + 20.0 - phase) * drive.acceleration
        speed = drive.low * KMH + np.clip(np.minimum(rising, falling), 0.0, rise)
    change = np.gradient(speed)
    slope = drive.grade * np.where(time // 120 % 2 == 0, 1.0, -1.0)
    mass = np.full(len(time), figures["mass_kg"] + DRIVER)
    ambient_c = figures["ambient_c"] if drive.ambient_c is None else drive.ambient_c
    ambient = np.full(len(time), ambient_c + ZERO_CELSIUS)
    resist = figures["rolling_resistance"] * np.sqrt(1.0 - slope**2) + slope
    force = mass * (change + GRAVITY * resist) + 0.5 * STANDARD_AIR_DENSITY * figures["drag_area_m2"] * speed**2
    force = np.where(speed > 0.0, force, 0.0)
    signals = {
        "speed": speed,
        "acceleration": change,
        "grade": slope,
        "mass": mass,
        "tyre_load": mass * GRAVITY * np.sqrt(1.0 - slope**2),
        "ambient": ambient,
        "air_density": STANDARD_AIR_DENSITY * 288.15 / ambient,
        "headwind": np.zeros(len(time)),
        "traction": force,
        "wheel_power": force * speed,
        "braking_force": np.maximum(-force, 0.0),
        "dt": np.ones(len(time)),
    }
    window = (time // (60 * minutes)).astype(np.int64)
    made = {"duration_s": np.bincount(window).astype(np.float64)}
    for column in {"effect_rolling", *(name for term in plain for name in term.columns)}:
        if column.startswith(EFFECT_PREFIX):
            effect = effects.get(column.removeprefix(EFFECT_PREFIX))
            known = set(effect.arguments) <= set(signals)
            power = effect.power(signals) if known else np.zeros(len(time))
            made[column] = np.bincount(window, power) / JOULES_PER_KWH
    table = pd.DataFrame(made)
    return table.assign(**{name: figures[name] for name in CarParameters._fields}, ambient_c=ambient_c)
