"""Compute what a dispatcher would expect at the shift's end without a forecast.

- `linear`: the consumption of the vehicle per hour since it woke up for this shift, continued to the shift's end. It
  restarts after a charge.
- `model_mean`: the mean energy of the vehicle model per kilometre of ride, times the kilometres still planned. The mean
  covers shifts that ended before this one began. It includes idling and empty trips, as the outcome does.
- `rating`: the official rating times the same kilometres. US labels include charging losses.
- `regression`: see `socast.core.evaluate.soc.regression`. It alone has an interval.

All baselines start from the filtered state of charge, which is more accurate than the display, and are limited to 0 to
100 %.
"""

from bisect import bisect_left, insort
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.evaluate.soc.cases import SHIFT_KEY, normalise_keys
from socast.core.evaluate.soc.regression import compute_regression
from socast.core.vehicles import load_catalogue

PERSONS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "linear": "the car's own pace, carried on",
        "model_mean": "mean kWh/km of the vehicle model",
        "rating": "official rating, in kWh/km",
    }
)
"""Name of each baseline that a person can compute by hand -> its description."""
REGRESSION: Final = "regression"
BASELINES: Final[Mapping[str, str]] = MappingProxyType(
    {**PERSONS, REGRESSION: "kilometres, hours, cold and heat, fitted to earlier days"}
)
"""Name of each baseline -> its description."""
LEAST_PACE_TIME: Final = 900.0
"""Time over which a pace must have been observed to be continued. [s]"""
LEAST_ERRORS: Final = 20
"""Number of earlier errors from which a risk is estimated."""


def compute_baselines(
    cases: pd.DataFrame, outlooks: pd.DataFrame, shifts: pd.DataFrame, plans: pd.DataFrame | None = None
) -> pd.DataFrame:
    """Return the state of charge that each baseline expects at the end of the shift, or of the leg of cases of legs.

    Returns
    -------
    (n, columns) DataFrame
        A column for each of `BASELINES`, and `regression_p05` and `regression_p95`; NaN where the baseline gives no
        value, as `linear` for legs. [%]
    """
    linear = np.full(len(cases), np.nan) if "leg" in cases else _linear(cases, outlooks)
    persons = pd.DataFrame({"linear": np.clip(linear, 0.0, 100.0), **compute_rate_baselines(cases, shifts)})
    return pd.concat([persons, compute_regression(cases, outlooks, shifts, plans)], axis=1)


def compute_rate_baselines(cases: pd.DataFrame, shifts: pd.DataFrame) -> dict[str, Floats]:
    """Return the state of charge after the kilometres ahead, by the mean and by the official consumption. [%]"""
    catalogue = load_catalogue()
    rating = [known.rated_kwh_per_km if (known := catalogue.get(key)) else None for key in cases["vehicle_model"]]
    rates = {"model_mean": compute_mean_consumption(cases, shifts), "rating": np.array(rating, dtype=np.float64)}
    soc, km, capacity = (cases[name].to_numpy(np.float64) for name in ("soc_pct", "ahead_km", "capacity_kwh"))
    return {name: np.clip(soc - 100.0 * rate * km / capacity, 0.0, 100.0) for name, rate in rates.items()}


def compute_mean_consumption(cases: pd.DataFrame, shifts: pd.DataFrame) -> Floats:
    """Return the mean consumption of each case's vehicle model, over shifts that ended before the case's shift began.

    Shifts with a charge or without any ride are left out.

    Returns
    -------
    (n,) float
        Battery energy over kilometres of ride; NaN before the first shift has ended. [kWh/km]
    """
    known = shifts.assign(energy=(shifts["soc_begin_pct"] - shifts["soc_end_pct"]) / 100.0 * shifts["capacity_kwh"])
    known = known[known["charged_s"].isna() & known["energy"].notna() & (known["ride_km"] > 0.0)]
    known = known.astype({"vehicle_model": "str"}).sort_values("end_s", kind="stable")
    sums = known.groupby("vehicle_model", sort=False)[["energy", "ride_km"]].cumsum()
    known = known[["vehicle_model", "end_s"]].assign(rate=sums["energy"] / sums["ride_km"])
    begun = cases[["vehicle_model", "begin_s"]].astype({"vehicle_model": "str"}).assign(place=np.arange(len(cases)))
    begun = begun.sort_values("begin_s", kind="stable")
    matched = pd.merge_asof(begun, known, left_on="begin_s", right_on="end_s", by="vehicle_model")
    return matched.sort_values("place")["rate"].to_numpy(np.float64)


def compute_empirical_risk(expected: Floats, became: Floats, time: Floats, ended: Floats, levels: Floats) -> Floats:
    """Return the probability of ending below levels, from the earlier errors of the same baseline.

    Units: levels [%].

    Parameters
    ----------
    expected, became : (n,) float
        Expected state of charge, NaN where there is none, and its outcome. [%]

    Returns
    -------
    (n, levels) float
        NaN where fewer than `LEAST_ERRORS` errors were known.

    Notes
    -----
    With m known errors, k of which would lead below the level, the probability is (k + 1/2) / (m + 1).

    Examples
    --------
    >>> n = np.arange(30.0)
    >>> risk = compute_empirical_risk(np.full(30, 50.0), 50.0 - n % 2, n, n + 0.5, np.full((30, 1), 49.5))
    >>> risk[-1].round(2).tolist()
    [0.48]
    """
    known = np.flatnonzero(np.isfinite(expected))
    coming = iter(known[np.argsort(ended[known], kind="stable")].tolist())
    following = next(coming, None)
    errors: list[float] = []
    out = np.full(levels.shape, np.nan)
    for row in known[np.argsort(time[known], kind="stable")].tolist():
        while following is not None and ended[following] <= time[row]:
            insort(errors, float(became[following] - expected[following]))
            following = next(coming, None)
        if len(errors) >= LEAST_ERRORS:
            worse = [bisect_left(errors, float(level - expected[row])) for level in levels[row]]
            out[row] = (np.array(worse) + 0.5) / (len(errors) + 1.0)
    return out


def _linear(cases: pd.DataFrame, outlooks: pd.DataFrame) -> Floats:
    """Return the state of charge at the end that the pace so far gives. [%]"""
    since, soc_then = _begun(cases, outlooks)
    time, soc = cases["time_s"].to_numpy(np.float64), cases["soc_pct"].to_numpy(np.float64)
    left = np.maximum(cases["shift_end_s"].to_numpy(np.float64) - time, 0.0)
    passed = time - since
    pace = np.divide(soc_then - soc, passed, out=np.full(len(cases), np.nan), where=passed >= LEAST_PACE_TIME)
    return np.asarray(soc - pace * left)


def _begun(cases: pd.DataFrame, outlooks: pd.DataFrame) -> tuple[Floats, Floats]:
    """Return when the pace began [s] and the state of charge then [%]: when the car woke up, or first after a charge.

    The state of charge at the beginning of a shift is that of its departure, so the first forecast gives it instead.
    """
    reported = normalise_keys(outlooks)[[*SHIFT_KEY, "time_s", "soc_pct"]].dropna(subset=["soc_pct"])
    reported = reported.sort_values("time_s", kind="stable")
    woken = reported.drop_duplicates(SHIFT_KEY)
    begun = cases[SHIFT_KEY].merge(woken, on=SHIFT_KEY, how="left")[["time_s", "soc_pct"]].to_numpy(np.float64)
    charged = cases[[*SHIFT_KEY, "charged_s"]].assign(place=np.arange(len(cases))).dropna(subset="charged_s")
    charged = charged.sort_values("charged_s", kind="stable")
    matched = pd.merge_asof(
        charged, reported, left_on="charged_s", right_on="time_s", by=SHIFT_KEY, direction="forward"
    )
    begun[matched["place"].to_numpy()] = matched[["time_s", "soc_pct"]].to_numpy(np.float64)
    return begun[:, 0], begun[:, 1]
