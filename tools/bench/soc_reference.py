"""Forecast the charge at the end of a shift by a textbook: three numbers a vehicle model on a climate curve.

The energy ahead is that of driving, of the climate while driving and of the climate while waiting, each by figures that
anybody can look up. Three factors of a vehicle model correct them by a Bayesian ridge regression on earlier days, with
1 as prior. A factor of the car and one of the day correct the sum. It is the baseline that a forecaster has to beat:
simpler than a regression on more terms, and better in the cold.
"""

from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.evaluate.soc.cases import SHIFT_KEY
from socast.core.evaluate.soc.regression import FEWEST_ERRORS, find_day_factors, gather_points

REFERENCE: Final = "reference"
"""Name of the baseline, and of its column; its bounds have the endings `_p05` and `_p95`. [%]"""
KWH_PER_KM: Final = 0.13
COLD_PER_KELVIN: Final = 0.006
STANDBY_KW: Final = 0.3
HEATING: Final = (16.0, 0.11, 4.5)
COOLING: Final = (23.0, 0.10, 2.0)
"""Temperature from which heating or cooling is on [°C], power per kelvin from there [kW/K], largest power [kW]."""
WAITING_SHARE: Final = 0.7
"""Climate power of a car that waits over that of one that drives. [1]"""
PRIOR_SD: Final = np.array([0.25, 0.4, 0.4])
FIXED_SD, RELATIVE_SD, ROOT_SD, READING_SD = 1.2, 0.08, 0.15, 0.5
"""Standard deviation of a row [kWh], and relative to its energy; noise of an energy of 1 kWh; reading of the charge
[%]."""
SHIFT_SD: Final = 0.07
"""Relative standard deviation of what a shift takes over the prediction. [1]"""
CAR_KWH, DAY_KWH = 25.0, 4.0
"""Energies that pull the factors of a car and of a day towards 1. [kWh]"""
MEMORY, CAR_MEMORY = 0.98, 0.97
"""Weights of a day one day later."""
CLASSES: Final = (2.0, 6.0, 15.0)
"""Edges of the classes of predicted fall, in each of which errors are collected. [%]"""
FIRST_ERRORS: Final = np.linspace(-2.2, 2.2, 15)
"""Errors over predictive standard deviation that every class begins with."""


def compute_reference(
    cases: pd.DataFrame, outlooks: pd.DataFrame, shifts: pd.DataFrame, plans: pd.DataFrame | None = None
) -> pd.DataFrame:
    """Return what the textbook expects at the end of each case: `reference`, `reference_p05`, `reference_p95`. [%]"""
    names = [REFERENCE, f"{REFERENCE}_p05", f"{REFERENCE}_p95"]
    if not len(cases):
        return pd.DataFrame(columns=names, dtype=np.float64)
    points = gather_points(cases, outlooks, shifts, plans)
    model = points.merge(shifts[[*SHIFT_KEY, "vehicle_model"]].drop_duplicates(SHIFT_KEY), on=SHIFT_KEY, how="left")
    points["model"] = pd.factorize(model["vehicle_model"].astype(str))[0]
    out = pd.DataFrame(np.clip(_predict(points), 0.0, 100.0), columns=names)
    own = points["case"].to_numpy() >= 0
    return out[own].set_axis(points.loc[own, "case"]).sort_index().reset_index(drop=True)


def make_terms(points: pd.DataFrame) -> Floats:
    """Return the energy of driving, of the climate while driving and while waiting, (n, 3). [kWh]"""
    km, drive, wait, celsius = points[["km", "drive_h", "wait_h", "ambient_c"]].to_numpy(np.float64).T
    climate = sum(
        np.minimum(slope * np.maximum(side * (celsius - begin), 0.0), most)
        for side, (begin, slope, most) in ((-1.0, HEATING), (1.0, COOLING))
    )
    driving = KWH_PER_KM * km * (1.0 + COLD_PER_KELVIN * np.maximum(20.0 - celsius, 0.0))
    return np.column_stack([driving, STANDBY_KW * (drive + wait) + climate * drive, WAITING_SHARE * climate * wait])


def _predict(points: pd.DataFrame) -> Floats:
    """Return mean and bounds of each point, (n, 3). [%]"""
    terms, used = make_terms(points), points["used_kwh"].to_numpy(np.float64)
    capacity, soc = (points[name].to_numpy(np.float64) for name in ("capacity_kwh", "soc_pct"))
    ended, day = points["end_s"].to_numpy(np.float64), points["day"].to_numpy(np.float64)
    model, car = points["model"].to_numpy(), pd.factorize(points["vehicle_id"])[0]
    shift = points.groupby(SHIFT_KEY, sort=False).ngroup().to_numpy()
    known = np.isfinite(terms).all(axis=1)
    sample = (points["case"].to_numpy() < 0) & known & np.isfinite(used)
    out = np.full((len(points), 3), np.nan)
    sds = np.full(len(points), np.nan)
    for today, kind in sorted(set(zip(day[known].tolist(), model[known].tolist(), strict=True))):
        mine = known & (day == today) & (model == kind)
        past = sample & (model == kind) & (ended < SECONDS_PER_DAY * today)
        age = today - day[past]
        slopes, covariance = _fit(terms[past], used[past], MEMORY**age / np.bincount(shift[past])[shift[past]])
        of_car = np.ones(int(car.max()) + 1)
        if past.any():
            _, first = np.unique(shift[past], return_index=True)
            weight = CAR_MEMORY ** age[first]
            sums = [
                np.bincount(car[past][first], weight * energy[first], len(of_car))
                for energy in (used[past], terms[past] @ slopes)
            ]
            of_car = (CAR_KWH + sums[0]) / (CAR_KWH + sums[1])
        plain = (terms[mine] @ slopes) * of_car[car[mine]]
        energy = plain * find_day_factors(points[mine], plain, DAY_KWH) * points["share"].to_numpy(np.float64)[mine]
        variance = np.einsum("ni,ij,nj->n", terms[mine], covariance, terms[mine])
        variance += (SHIFT_SD * energy) ** 2 + ROOT_SD**2 * np.maximum(energy, 0.0)
        sds[mine] = np.hypot(100.0 * np.sqrt(variance) / capacity[mine], READING_SD)
        out[mine, 0] = soc[mine] - 100.0 * energy / capacity[mine]
        ago = sample & (ended < SECONDS_PER_DAY * today) & np.isfinite(sds)
        errors = (soc - 100.0 * used / capacity - out[:, 0])[ago] / sds[ago]
        out[mine, 1:] = _find_bounds(errors, (soc - out[:, 0])[ago], shift[ago], out[mine, 0], soc[mine], sds[mine])
    return out


def _fit(terms: Floats, used: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return mean and covariance of the three factors."""
    variance = (FIXED_SD + RELATIVE_SD * used) ** 2
    weighted = terms * (weight / variance)[:, np.newaxis]
    precision = np.diag(PRIOR_SD**-2.0)
    covariance = np.asarray(np.linalg.inv(precision + weighted.T @ terms), np.float64)
    return covariance @ (precision @ np.ones(3) + weighted.T @ used), covariance


def _find_bounds(errors: Floats, fall: Floats, shift: Floats, mean: Floats, soc: Floats, sd: Floats) -> Floats:
    """Return the bounds by the quantiles of earlier errors of the same class of predicted fall, (n, 2). [%]"""
    then, now = np.digitize(fall, CLASSES), np.digitize(soc - mean, CLASSES)
    out = np.empty((len(mean), 2))
    for which in np.unique(now).tolist():
        alike = then == which
        values, weights = errors[alike], np.ones(int(alike.sum()))
        if len(np.unique(shift[alike])) >= FEWEST_ERRORS:
            weights *= len(np.unique(shift[alike])) / max(len(values), 1)
        elif len(values):
            weights /= np.bincount(pd.factorize(shift[alike])[0])[pd.factorize(shift[alike])[0]]
        values, weights = np.append(values, FIRST_ERRORS), np.append(weights, np.ones(len(FIRST_ERRORS)))
        order = np.argsort(values)
        place = (np.cumsum(weights[order]) - 0.5 * weights[order]) / weights.sum()
        low, high = np.interp((0.05, 0.95), place, values[order])
        mine = now == which
        out[mine] = mean[mine, np.newaxis] + sd[mine, np.newaxis] * np.array([low, high])
    return out
