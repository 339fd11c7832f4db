"""Fit a regression to earlier days that a person could make, as a baseline with an interval of its own.

The energy of what is ahead is a sum over kilometres, hours of driving and hours of waiting, each with terms for cold
and heat, times a factor of the car and a factor of the day. Every day at midnight (UTC) the coefficients are fitted to
shifts that have ended; the factor of the day follows from what the car has used since its shift began.
"""

from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.evaluate.soc.cases import SHIFT_KEY, normalise_keys
from socast.core.stats.conformal import find_conformal_ranks

FEWEST_SHIFTS: Final = 10
"""Number of earlier shifts from which the regression is fitted."""
FEWEST_ERRORS: Final = 20
"""Number of earlier shifts with an error from which it has an interval."""
SAMPLE_INTERVAL: Final = 1800.0
"""Time between two forecasts of a shift to which it is fitted. [s]"""
COLD_BELOW: Final = 15.0
HOT_ABOVE: Final = 20.0
"""Temperatures below and above which cold and heat count. [°C]"""
RIDGE: Final = 0.02
"""Weight of the ridge relative to the mean square of each term. [1]"""
CAR_ENERGY: Final = 40.0
DAY_ENERGY: Final = 40.0
"""Energies that pull the factors of a car and of a day towards 1. [kWh]

They and `RIDGE` make the regression about as good as it gets on the fleets `autumn` and `autumn-short` with seed 1 and
`small` with seeds 1 and 2 (see `socast.tools.simulator.settings`).
"""
DAY_FACTOR: Final = (0.5, 2.0)
"""Limits of the factor of a day. [1]"""
RIDE_SPEED: Final = 22.0
"""Speed of rides whose duration no plan tells. [km/h]"""
FIXED_ERROR: Final = 1.5
"""Part of the scale of errors that does not grow with what is ahead. [%]"""
CLASSES: Final = (7.0, 20.0)
"""Edges of the classes of predicted consumption, in each of which errors are collected. [%]"""
NOMINAL: Final = 0.90
"""Nominal share of outcomes inside an interval. [1]"""
REGRESSION_COLUMNS: Final = ("regression", "regression_p05", "regression_p95")
"""State of charge that the regression expects, and the ends of its 90 % interval. [%]"""


def compute_regression(
    cases: pd.DataFrame, outlooks: pd.DataFrame, shifts: pd.DataFrame, plans: pd.DataFrame | None = None
) -> pd.DataFrame:
    """Return what the regression expects at the end of the shift of each case.

    Returns
    -------
    (n, 3) DataFrame
        `REGRESSION_COLUMNS`; NaN where too few shifts had ended. [%]
    """
    points = gather_points(cases, outlooks, shifts, plans)
    fitted = predict_by_day(points)
    own = fitted.loc[points["case"] >= 0].set_axis(points.loc[points["case"] >= 0, "case"])
    return own.sort_index().reset_index(drop=True)


def gather_points(
    cases: pd.DataFrame, outlooks: pd.DataFrame, shifts: pd.DataFrame, plans: pd.DataFrame | None
) -> pd.DataFrame:
    """Return the forecasts to which the regression is fitted, and the cases, in order of time.

    Returns
    -------
    DataFrame
        `case`: number of the case, -1 otherwise. `share` of what is ahead that counts: 1 except of legs. `km`,
        `drive_h`, `wait_h` ahead; `ambient_c` [°C]; `used_kwh`: energy until the end of the shift, NaN where it charged
        before; and columns of its shift.
    """
    made = normalise_keys(outlooks).sort_values("time_s", kind="stable")
    columns = [*SHIFT_KEY, "time_s", "shift_end_s", "planned", "soc_pct", "ahead_km", "ambient_c"]
    made = made[[name for name in columns if name in made]].dropna(subset=["soc_pct"])
    slot = np.floor(made["time_s"] / SAMPLE_INTERVAL)
    samples = made[~made[SHIFT_KEY].assign(slot=slot).duplicated()].assign(case=-1, share=1.0)
    own = cases[[*SHIFT_KEY, "time_s"]].assign(case=np.arange(len(cases))).sort_values("time_s", kind="stable")
    own = pd.merge_asof(own, made, on="time_s", by=SHIFT_KEY)
    own["share"] = 1.0
    if "leg" in cases:
        km = cases["ahead_km"].to_numpy(np.float64)[own["case"].to_numpy()]
        own["share"] = np.clip(km / own["ahead_km"].where(own["ahead_km"] > 0.0), 0.0, 1.0)
    ended = normalise_keys(shifts)
    wanted = [*SHIFT_KEY, "begin_s", "end_s", "soc_end_pct", "charged_s", "ride_km", "capacity_kwh"]
    points = pd.concat([samples, own], ignore_index=True).merge(ended[wanted], on=SHIFT_KEY)
    points = points.sort_values(["time_s", "case"], kind="stable", ignore_index=True)
    points["day"] = np.floor(points["begin_s"] / SECONDS_PER_DAY)
    ahead = _look_ahead(points, ended, plans)
    used = (points["soc_pct"] - points["soc_end_pct"]) / 100.0 * points["capacity_kwh"]
    return points.assign(**ahead, used_kwh=used.where(~(points["charged_s"] >= points["time_s"])))


def _look_ahead(points: pd.DataFrame, shifts: pd.DataFrame, plans: pd.DataFrame | None) -> dict[str, Floats]:
    """Return kilometres and hours ahead: by the plan, or as earlier shifts of the car were."""
    time = points["time_s"].to_numpy(np.float64)
    planned = points["planned"].to_numpy(bool) & np.isfinite(points["ahead_km"].to_numpy(np.float64))
    usual_hours, usual_pace = _find_habits(points, shifts)
    passed = (time - points["begin_s"].to_numpy(np.float64)) / 3600.0
    left = (points["shift_end_s"].to_numpy(np.float64) - time) / 3600.0
    hours = np.where(planned, np.maximum(left, 0.0), np.maximum(usual_hours - passed, 0.25))
    km = np.where(planned, points["ahead_km"].to_numpy(np.float64), usual_pace * hours)
    drive = km / _find_speed(points, plans)
    return {"km": km, "drive_h": drive, "wait_h": np.maximum(hours - drive, 0.0)}


def _find_speed(points: pd.DataFrame, plans: pd.DataFrame | None) -> Floats:
    """Return the speed of the rides of the newest plan before each point. [km/h]"""
    speed = np.full(len(points), RIDE_SPEED)
    if plans is None or not len(plans):
        return speed
    told = plans[(plans["plan_km"] > 0.0) & (plans["plan_drive_s"] > 0.0)].sort_values("time_s", kind="stable")
    mine = points[["vehicle_id", "time_s"]].assign(place=np.arange(len(points)))
    matched = pd.merge_asof(
        mine.sort_values("time_s", kind="stable"), told.drop_duplicates(["vehicle_id", "time_s"]), on="time_s",
        by="vehicle_id",
    ).sort_values("place")  # fmt: skip
    found = (3600.0 * matched["plan_km"] / matched["plan_drive_s"]).to_numpy(np.float64)
    return np.where(np.isfinite(found), found, speed)


def _find_habits(points: pd.DataFrame, shifts: pd.DataFrame) -> tuple[Floats, Floats]:
    """Return the mean length [h] and pace [km/h] of shifts that ended before the day of each point."""
    known = shifts.sort_values("end_s", kind="stable")
    known = known.assign(hours=(known["end_s"] - known["begin_s"]) / 3600.0)
    known = known.assign(count=1.0, ride_km=known["ride_km"].fillna(0.0))
    names = ["hours", "ride_km", "count"]
    before = points[["vehicle_id", "day"]].assign(
        midnight=SECONDS_PER_DAY * points["day"], place=np.arange(len(points))
    )
    before = before.sort_values("midnight", kind="stable")
    sums = known.assign(**known.groupby("vehicle_id", sort=False)[names].cumsum())
    fleet = known.assign(**known[names].cumsum())
    own_sums, all_sums = sums[["vehicle_id", "end_s", *names]], fleet[["end_s", *names]]
    of_car = pd.merge_asof(before, own_sums, left_on="midnight", right_on="end_s", by="vehicle_id")
    of_all = pd.merge_asof(before, all_sums, left_on="midnight", right_on="end_s")
    own = (of_car["count"] >= 3.0).to_numpy(bool)
    sums_of = {
        name: np.where(own, of_car[name].to_numpy(np.float64), of_all[name].to_numpy(np.float64)) for name in names
    }
    back = np.argsort(before["place"].to_numpy(), kind="stable")
    hours, pace = sums_of["hours"] / sums_of["count"], sums_of["ride_km"] / sums_of["hours"]
    return hours[back], pace[back]


def predict_by_day(points: pd.DataFrame) -> pd.DataFrame:
    """Return `REGRESSION_COLUMNS` of each point, from shifts that ended before the UTC day of its shift."""
    terms, used = make_terms(points), points["used_kwh"].to_numpy(np.float64)
    capacity, soc = (points[name].to_numpy(np.float64) for name in ("capacity_kwh", "soc_pct"))
    ended, day = points["end_s"].to_numpy(np.float64), points["day"].to_numpy(np.float64)
    car = pd.factorize(points["vehicle_id"])[0]
    shift = points.groupby(SHIFT_KEY, sort=False).ngroup().to_numpy()
    sample = points["case"].to_numpy() < 0
    known = np.isfinite(terms).all(axis=1)
    learned = sample & known & np.isfinite(used)
    expected, low, high = (np.full(len(points), np.nan) for _ in range(3))
    for today in np.unique(day).tolist():
        past = learned & (ended < SECONDS_PER_DAY * today)
        mine = known & (day == today)
        if len(np.unique(shift[past])) < FEWEST_SHIFTS or not mine.any():
            continue
        slopes = fit_ridge(terms[past], used[past], 1.0 / np.bincount(shift[past])[shift[past]])
        of_car = _find_car_factors(terms[past] @ slopes, used[past], car[past], shift[past], int(car.max()) + 1)
        plain = np.maximum(terms[mine] @ slopes, 0.0) * of_car[car[mine]]
        ahead = plain * find_day_factors(points[mine], plain, DAY_ENERGY) * points["share"].to_numpy(np.float64)[mine]
        expected[mine] = soc[mine] - 100.0 * ahead / capacity[mine]
        ago = past & np.isfinite(expected)
        fall = soc - expected
        bounds = _find_bounds(
            (soc - 100.0 * used / capacity - expected)[ago] / (FIXED_ERROR + fall[ago]),
            fall[ago],
            shift[ago],
            fall[mine],
        )
        low[mine], high[mine] = (expected[mine] + bound * (FIXED_ERROR + fall[mine]) for bound in bounds)
    return pd.DataFrame(dict(zip(REGRESSION_COLUMNS, np.clip((expected, low, high), 0.0, 100.0), strict=True)))


def make_terms(points: pd.DataFrame) -> Floats:
    """Return the nine terms of each point, (n, 9): kilometres, driving and waiting, each plain, times cold, times heat.

    Examples
    --------
    >>> point = {"km": [20.0], "drive_h": [1.0], "wait_h": [0.5], "ambient_c": [5.0]}
    >>> make_terms(pd.DataFrame(point)).tolist()
    [[20.0, 1.0, 0.5, 20.0, 1.0, 0.5, 0.0, 0.0, 0.0]]
    """
    ahead = points[["km", "drive_h", "wait_h"]].to_numpy(np.float64)
    ambient = points["ambient_c"].to_numpy(np.float64)[:, np.newaxis]
    cold, heat = np.maximum(COLD_BELOW - ambient, 0.0) / 10.0, np.maximum(ambient - HOT_ABOVE, 0.0) / 10.0
    return np.hstack([ahead, ahead * cold, ahead * heat])


def fit_ridge(terms: Floats, used: Floats, weight: Floats) -> Floats:
    """Return the coefficients of a ridge regression without intercept.

    Units: used [kWh].
    """
    scale = np.sqrt(np.average(terms**2, axis=0, weights=weight))
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = terms / scale
    weighted = scaled * weight[:, np.newaxis]
    ridge = RIDGE * float(weight.sum()) * np.eye(terms.shape[1])
    return np.asarray(np.linalg.solve(scaled.T @ weighted + ridge, weighted.T @ used) / scale)


def _find_car_factors(expected: Floats, used: Floats, car: Floats, shift: Floats, cars: int) -> Floats:
    """Return the factor of each car, (cars,), from the first point of each shift."""
    _, first = np.unique(shift, return_index=True)
    energy = np.bincount(car[first], used[first], cars)
    return (CAR_ENERGY + energy) / (CAR_ENERGY + np.bincount(car[first], np.maximum(expected[first], 0.0), cars))


def find_day_factors(points: pd.DataFrame, expected: Floats, pull_kwh: float) -> Floats:
    """Return the factor of the day at each point: what the car used since the shift began, over what was expected.

    The energy expected of the time so far is that of what was ahead at the first point, minus that of what is ahead
    now. A charge begins anew. `pull_kwh` is the energy that pulls the factor towards 1.
    """
    begun = points["charged_s"].notna() & (points["time_s"] > points["charged_s"])
    stock = points["soc_pct"] / 100.0 * points["capacity_kwh"]
    table = points[SHIFT_KEY].assign(begun=begun, expected=expected, stock=stock)
    first = table.groupby([*SHIFT_KEY, "begun"], sort=False)[["expected", "stock"]].transform("first")
    used = (first["stock"] - stock).to_numpy(np.float64)
    so_far = (first["expected"] - expected).to_numpy(np.float64)
    factor = (pull_kwh + np.maximum(used, 0.0)) / (pull_kwh + np.maximum(so_far, 0.0))
    return np.clip(factor, *DAY_FACTOR)


def _find_bounds(errors: Floats, fall: Floats, shift: Floats, ahead: Floats) -> tuple[Floats, Floats]:
    """Return the 5 % and 95 % quantiles of earlier errors in the class of each of `ahead`, or of all classes."""
    low, high = np.full(len(ahead), np.nan), np.full(len(ahead), np.nan)
    then, now = np.digitize(fall, CLASSES), np.digitize(ahead, CLASSES)
    for which in np.unique(now).tolist():
        alike = then == which
        if len(np.unique(shift[alike])) < FEWEST_ERRORS:
            alike = np.ones(len(then), bool)
        count = len(np.unique(shift[alike]))
        if count >= FEWEST_ERRORS:
            ranks = np.clip(find_conformal_ranks(count, (0.5 - NOMINAL / 2.0, 0.5 + NOMINAL / 2.0)), 0, count - 1)
            low[now == which], high[now == which] = np.quantile(errors[alike], ranks / (count - 1))
    return low, high
