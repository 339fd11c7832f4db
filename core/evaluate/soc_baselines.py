"""What a person would expect at the shift's end without a forecast.

- `linear`: what the car has used so far in this shift, an hour, carried on to its end. After a charge it begins anew.
- `model_mean`: mean energy of the vehicle model a kilometre of ride, times the kilometres still planned. The mean is
  over shifts that had ended before this one began; idling and empty ways are in its energy, as they are in the outcome.
- `rating`: the official rating times the same kilometres. US labels count the losses of charging.

All begin at the filtered state of charge, which is better than what a person reads, and stay within 0 and 100 %.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
import pandas as pd

from core.batch import Floats
from core.evaluate.soc_judged import KEY, keyed
from core.vehicles import catalogue

BASELINES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "linear": "the car's own pace, carried on",
        "model_mean": "mean kWh/km of the vehicle model",
        "rating": "official rating, in kWh/km",
    }
)
"""What a person would use -> what it is called."""
SETTLED: Final = 900.0
"""Nobody carries on a pace that was seen for less time. [s]"""


def baselines(cases: pd.DataFrame, outlooks: pd.DataFrame, shifts: pd.DataFrame) -> pd.DataFrame:
    """Return what each baseline expects at the shift's end.

    Parameters
    ----------
    cases : DataFrame
        Of `core.evaluate.soc_judged.judged`.
    outlooks, shifts : DataFrame
        All that the pipeline told.

    Returns
    -------
    DataFrame
        A row a case, a column of each of `BASELINES`, NaN where it has no answer. [%]
    """
    rating = [known.rated_kwh_per_km if (known := catalogue().get(key)) else None for key in cases["vehicle_model"]]
    rates = {
        "model_mean": mean_consumption(cases, shifts),
        "rating": np.array(rating, dtype=np.float64),
    }
    found = {"linear": _linear(cases, outlooks)}
    for name, kwh_per_km in rates.items():
        used = kwh_per_km * cases["ahead_km"].to_numpy(np.float64) / cases["capacity_kwh"].to_numpy(np.float64)
        found[name] = cases["soc_pct"].to_numpy(np.float64) - 100.0 * used
    return pd.DataFrame({name: np.clip(found[name], 0.0, 100.0) for name in BASELINES})


def mean_consumption(cases: pd.DataFrame, shifts: pd.DataFrame) -> Floats:
    """Return the mean consumption of each case's vehicle model, over shifts that ended before its own began.

    Shifts in which the car charged, or nobody had a ride, tell nothing.

    Returns
    -------
    (n,) float64
        Energy of the battery over kilometres of ride, NaN before any shift has ended. [kWh/km]
    """
    told = shifts.assign(energy=(shifts["soc_begin_pct"] - shifts["soc_end_pct"]) / 100.0 * shifts["capacity_kwh"])
    told = told[told["charged_s"].isna() & told["energy"].notna() & (told["ride_km"] > 0.0)]
    told = told.astype({"vehicle_model": "str"}).sort_values("end_s", kind="stable")
    sums = told.groupby("vehicle_model", sort=False)[["energy", "ride_km"]].cumsum()
    told = told[["vehicle_model", "end_s"]].assign(rate=sums["energy"] / sums["ride_km"])
    asked = cases[["vehicle_model", "begin_s"]].astype({"vehicle_model": "str"}).assign(place=np.arange(len(cases)))
    asked = asked.sort_values("begin_s", kind="stable")
    found = pd.merge_asof(asked, told, left_on="begin_s", right_on="end_s", by="vehicle_model")
    return found.sort_values("place")["rate"].to_numpy(np.float64)


def _linear(cases: pd.DataFrame, outlooks: pd.DataFrame) -> Floats:
    """Return the state of charge at the end by the pace so far. [%]"""
    since, soc_then = _begun(cases, outlooks)
    time, soc = cases["time_s"].to_numpy(np.float64), cases["soc_pct"].to_numpy(np.float64)
    left = np.maximum(cases["shift_end_s"].to_numpy(np.float64) - time, 0.0)
    passed = time - since
    pace = np.divide(soc_then - soc, passed, out=np.full(len(cases), np.nan), where=passed >= SETTLED)
    found: Floats = soc - pace * left
    return found


def _begun(cases: pd.DataFrame, outlooks: pd.DataFrame) -> tuple[Floats, Floats]:
    """Return when the pace began, [s], and the state of charge then, [%]: with the shift, or first after a charge."""
    begun = cases[["begin_s", "soc_begin_pct"]].to_numpy(np.float64, copy=True)
    asked = cases[[*KEY, "charged_s"]].assign(place=np.arange(len(cases))).dropna(subset="charged_s")
    told = keyed(outlooks)[[*KEY, "time_s", "soc_pct"]].sort_values("time_s", kind="stable")
    asked = asked.sort_values("charged_s", kind="stable")
    found = pd.merge_asof(asked, told, left_on="charged_s", right_on="time_s", by=KEY, direction="forward")
    begun[found["place"].to_numpy()] = found[["time_s", "soc_pct"]].to_numpy(np.float64)
    return begun[:, 0], begun[:, 1]
