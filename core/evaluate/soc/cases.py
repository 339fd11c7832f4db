"""Select the forecasts of the state of charge at a shift's end that are evaluated, with their outcomes.

Each ended shift gives one forecast for each time ahead: the newest one made by then. The pipeline learns while it runs,
so a forecast uses nothing from after it, and no days need to be held out.

Where a recording is simulated, the outcome of a shift is what a healthy display would show at its end. Elsewhere it is
what the car reported last.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.evaluate.soc.records import ImpossibleBounds
from socast.core.fit.ride_blocks import assign_vehicle_days
from socast.core.forecast.plan_tracker import CUT_SHORT_MARGIN

MOST_APART: Final = 3600.0
"""Largest difference between the begin of a shift and that of its display. [s]"""
TOLERANCE: Final = 0.05
"""By how much a bound may exceed the present charge, for rounding. [%]"""
HOURS_AHEAD: Final = (0, 1, 2, 4, 6)
"""Times before a shift's end, measured from its last sample. [h]"""
MOST_FORECAST_AGE: Final = 600.0
"""Largest age of the newest forecast; where it is older the vehicle sent nothing. [s]"""

SHIFT_KEY: Final = ["vehicle_id", "shift"]
"""Columns that identify a shift."""
CUT_SHORT: Final = "the recording ends before the shift"
SILENT: Final = "no forecast near"
CHARGED: Final = "charged before the end"
UNREPORTED: Final = "state of charge at the end not reported"
WARM_UP: Final = "no interval yet"
REASONS: Final = (CUT_SHORT, SILENT, CHARGED, UNREPORTED, WARM_UP)
"""Reasons why a forecast is left out; the first that applies is counted."""
SHIFT_COLUMNS: Final = [
    *SHIFT_KEY,
    "vehicle_model",
    "begin_s",
    "end_s",
    "soc_end_pct",
    "soc_lowest_pct",
    "charged_s",
    "capacity_kwh",
]
"""Columns of shifts that the evaluation needs, besides `ambient_c`, the mean outside temperature of the shift."""
OUTLOOK_COLUMNS: Final = [
    *SHIFT_KEY,
    "time_s",
    "shift_end_s",
    "planned",
    "soc_pct",
    "soc_mean_pct",
    "soc_p05_pct",
    "soc_p95_pct",
    "reserve_soc_pct",
    "reserve_risk",
    "ahead_km",
    "soc_begin_pct",
    "charge_planned",
    "forecast_ambient_c",
]
"""Columns of forecasts that the evaluation needs, where `forecast_ambient_c` is their `ambient_c`."""


@dataclass(frozen=True)
class ForecastCases:
    """Hold the forecasts that are evaluated.

    Parameters
    ----------
    cases : (n, columns) DataFrame
        One row per forecast: `SHIFT_COLUMNS` and `ambient_c` of its shift, its own `OUTLOOK_COLUMNS`, `hours` before
        the end, and `cluster`, an int from 0 that the forecasts of one vehicle on one day share.
        `forecast_ambient_c`: outside temperature at the forecast. [°C] `novelty_k`: how far it is outside those that
        the fleet met on earlier days. [K] `seen`: number of shifts of the fleet that had ended. `fault`: fault of the
        display, empty without one.
    left_out : dict of str to int
        Number of forecasts left out, by reason.
    warm_up : int
        Number of these shifts without an interval at any time ahead, because too little had been learned.
    unlearned : (m, columns) DataFrame
        Forecasts that were left out because they had no interval yet.
    """

    cases: pd.DataFrame
    left_out: dict[str, int]
    shifts: int
    warm_up: int
    unlearned: pd.DataFrame


def select_cases(outlooks: pd.DataFrame, shifts: pd.DataFrame, wanted: pd.DataFrame | None = None) -> ForecastCases:
    """Return the forecasts that are evaluated.

    Parameters
    ----------
    wanted : DataFrame, optional
        `SHIFT_KEY`, `hours` and `wanted_s` of the forecasts to evaluate; by default all `HOURS_AHEAD` of each end.
    """
    made = normalise_keys(outlooks)
    ended = normalise_keys(shifts)
    ended = ended.assign(fault=ended.get("fault", ""))[[*SHIFT_COLUMNS, "ambient_c", "fault"]]
    made = made.rename(columns={"ambient_c": "forecast_ambient_c"})[OUTLOOK_COLUMNS].sort_values(
        "time_s", kind="stable"
    )
    if wanted is None:
        wanted = pd.concat([ended.assign(hours=hours) for hours in HOURS_AHEAD], ignore_index=True)
        wanted["wanted_s"] = wanted["end_s"] - 3600.0 * wanted["hours"]
    else:
        wanted = ended.merge(wanted, on=SHIFT_KEY)
    wanted = wanted[wanted["wanted_s"] >= wanted["begin_s"]].sort_values("wanted_s", kind="stable")
    cases = pd.merge_asof(wanted, made, left_on="wanted_s", right_on="time_s", by=SHIFT_KEY)
    cases = cases.sort_values([*SHIFT_KEY, "hours"], ignore_index=True)
    why = _reasons(cases, made)
    day = np.floor(cases["begin_s"] / SECONDS_PER_DAY)
    cases["novelty_k"] = compute_novelty(cases, made)
    cases["seen"] = np.searchsorted(np.sort(ended["end_s"].to_numpy(np.float64)), cases["time_s"].to_numpy(np.float64))
    cases["cluster"] = assign_vehicle_days(cases.assign(day=day), day="day")
    kept = cases[why == ""].reset_index(drop=True)
    names = [f"{vehicle} {shift}" for vehicle, shift in zip(cases["vehicle_id"], cases["shift"], strict=True)]
    unlearned = set(np.array(names)[why == WARM_UP]) - set(np.array(names)[why == ""])
    left_out = {reason: int(np.sum(why == reason)) for reason in REASONS if np.any(why == reason)}
    return ForecastCases(kept, left_out, len(ended), len(unlearned), cases[why == WARM_UP].reset_index(drop=True))


def _reasons(cases: pd.DataFrame, made: pd.DataFrame) -> NDArray[np.str_]:
    """Return why each forecast is left out, empty where it is evaluated; `made` holds all forecasts, sorted by time."""
    planned = made[made["planned"].astype(bool)].groupby(SHIFT_KEY, sort=False)["shift_end_s"].last()
    end = cases[SHIFT_KEY].join(planned, on=SHIFT_KEY)["shift_end_s"] - cases["end_s"]
    cut = (end > CUT_SHORT_MARGIN) & (made["time_s"].max() - cases["end_s"] < MOST_FORECAST_AGE)
    unknown = cases[["soc_mean_pct", "soc_p05_pct", "soc_p95_pct"]].isna().any(axis=1)
    holds = {
        CUT_SHORT: cut,
        SILENT: ~(cases["wanted_s"] - cases["time_s"] <= MOST_FORECAST_AGE),
        CHARGED: (cases["charged_s"] >= cases["time_s"]) | (cases["charge_planned"] == True),  # noqa: E712 (may be NaN)
        UNREPORTED: cases["soc_end_pct"].isna(),
        WARM_UP: unknown,
    }
    return np.select([holds[reason].to_numpy(bool) for reason in REASONS], list(REASONS), "")


def compute_novelty(cases: pd.DataFrame, outlooks: pd.DataFrame) -> Floats:
    """Return how far the temperature of each case is outside those that the fleet met before the day of its shift.

    Returns
    -------
    (n,) float
        0 inside; NaN where nothing was met before. [K]
    """
    met = outlooks.dropna(subset=["forecast_ambient_c"])
    by_day = met.groupby(np.floor(met["time_s"] / SECONDS_PER_DAY))["forecast_ambient_c"].agg(["min", "max"])
    place = np.searchsorted(by_day.index.to_numpy(np.float64), np.floor(cases["begin_s"] / SECONDS_PER_DAY)) - 1
    coldest, warmest = (
        np.concatenate([column.to_numpy(np.float64), [np.nan]])[place]
        for column in (by_day["min"].cummin(), by_day["max"].cummax())
    )
    now = cases["forecast_ambient_c"].to_numpy(np.float64)
    return np.where(np.isfinite(now), np.maximum(np.maximum(coldest - now, now - warmest), 0.0), np.nan)


def normalise_keys(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose keys have the same types wherever it came from."""
    return table.astype({"vehicle_id": "str", "shift": np.int64})


def replace_outcomes(shifts: pd.DataFrame, displays: pd.DataFrame) -> pd.DataFrame:
    """Return shifts whose charge at the end and lowest charge are those of healthy displays.

    Parameters
    ----------
    displays : DataFrame
        One row per simulated shift: `vehicle_id`, `begin_s`, the time `step_s` between values [s], the sequence
        `shown_pct` of what a healthy display shows [%], and its `fault`, None without one.
    """
    ended = normalise_keys(shifts).assign(place=np.arange(len(shifts))).sort_values("begin_s", kind="stable")
    known = displays.astype({"vehicle_id": "str"}).sort_values("begin_s", kind="stable")
    known = known.assign(shown_from_s=known["begin_s"])
    matched = pd.merge_asof(ended, known, on="begin_s", by="vehicle_id", direction="nearest")
    matched = matched.sort_values("place", ignore_index=True)  # fmt: skip
    end, lowest = (matched[name].to_numpy(np.float64, copy=True) for name in ("soc_end_pct", "soc_lowest_pct"))
    known_of = (matched["begin_s"] - matched["shown_from_s"]).abs() <= MOST_APART
    for row in np.flatnonzero(known_of).tolist():
        shift = matched.iloc[row]
        shown = np.asarray(shift["shown_pct"], dtype=np.float64)
        last = int((shift["end_s"] - shift["shown_from_s"]) / shift["step_s"])
        shown = shown[: min(max(last, 1), len(shown))]
        if len(shown):
            end[row], lowest[row] = shown[-1], shown.min()
    fault = matched["fault"].where(known_of).fillna("").astype(str)
    return shifts.assign(soc_end_pct=end, soc_lowest_pct=lowest, fault=fault.to_numpy())


def count_impossible_bounds(outlooks: pd.DataFrame, plans: pd.DataFrame | None = None) -> ImpossibleBounds:
    """Return how many forecasts without a charge ahead have an upper bound above the present charge."""
    made = normalise_keys(outlooks).dropna(subset=["soc_pct", "soc_p95_pct"]).sort_values("time_s", kind="stable")
    charge_ahead = np.zeros(len(made), bool)
    if plans is not None and len(plans):
        told = plans[["vehicle_id", "time_s", "charge_ahead"]].sort_values("time_s", kind="stable")
        matched = pd.merge_asof(made[["vehicle_id", "time_s"]], told, on="time_s", by="vehicle_id")
        charge_ahead = (matched["charge_ahead"] == True).to_numpy(bool)  # noqa: E712 (unknown is not True)
    excess = (made["soc_p95_pct"] - made["soc_pct"]).to_numpy(np.float64)[~charge_ahead]
    return ImpossibleBounds(n=len(excess), above=int(np.sum(excess > TOLERANCE)), largest=excess.max(initial=0.0))
