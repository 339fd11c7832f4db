"""Evaluate forecasts where a plan has a charge: until the next charge, and over it to the end of the shift.

Both are evaluated like forecasts for the end of a shift (`socast.core.evaluate.soc.cases`). Until the next charge, the
part of a shift before each charge takes the place of the shift, and the last reading before the charge is the outcome.
The time of a charge is not planned. A forecast is therefore selected by the time ahead that it tells, and not by the
time until the charge, which would select forecasts by what followed. Over a planned charge, the outcome is that of the
shift, whether or not the car has charged.
"""

from typing import Final

import numpy as np
import pandas as pd

from socast.core.evaluate.soc.baselines import BASELINES, compute_baselines, compute_rate_baselines
from socast.core.evaluate.soc.cases import HOURS_AHEAD, SHIFT_KEY, normalise_keys, select_cases
from socast.core.evaluate.soc.regression import REGRESSION_COLUMNS

MOST_CHARGES: Final = 1000
"""Number of charges in a shift from which their numbers would no longer be unique."""
MOST_SHORT: Final = 0.5
"""Largest time by which the time ahead that a forecast tells may fall short of the one at which it is evaluated. [h]"""
TO_CHARGE_COLUMNS: Final = {
    "charge_s": "shift_end_s",
    "charge_soc_mean_pct": "soc_mean_pct",
    "charge_soc_p05_pct": "soc_p05_pct",
    "charge_soc_p95_pct": "soc_p95_pct",
    "charge_risk": "reserve_risk",
    "charge_km": "ahead_km",
}
"""Columns of forecasts until the next charge -> those of forecasts for the end of the shift that they replace."""


def split_at_charges(outlooks: pd.DataFrame, shifts: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the forecasts until the next charge, and the parts of shifts that a charge ended.

    Returns
    -------
    DataFrame
        Forecasts, whose columns for the end of the shift are those for the next charge.
    """
    made, ended = normalise_keys(outlooks).sort_values("time_s", kind="stable"), normalise_keys(shifts)
    charges = made.dropna(subset=["arrived_s", "arrival_soc_pct"]).drop_duplicates([*SHIFT_KEY, "arrived_s"])
    charges = charges[[*SHIFT_KEY, "arrived_s", "arrival_soc_pct"]]
    number = charges.groupby(SHIFT_KEY).cumcount().to_numpy()
    parts = charges.assign(part=charges["shift"] * MOST_CHARGES + number).merge(ended, on=SHIFT_KEY)
    before = parts.groupby(SHIFT_KEY)["arrived_s"].shift().fillna(parts["begin_s"])
    parts = parts.assign(
        shift=parts["part"],
        begin_s=before,
        end_s=parts["arrived_s"],
        soc_end_pct=parts["arrival_soc_pct"],
        soc_lowest_pct=parts["arrival_soc_pct"],
        charged_s=np.nan,
    )
    begun = charges.assign(part=number + 1).drop(columns="arrival_soc_pct")
    begun = begun.rename(columns={"arrived_s": "time_s"}).sort_values("time_s", kind="stable")
    made = pd.merge_asof(made, begun, on="time_s", by=SHIFT_KEY)
    made["shift"] = made["shift"] * MOST_CHARGES + made["part"].fillna(0.0).astype(np.int64)
    made = made.drop(columns=[*TO_CHARGE_COLUMNS.values(), "part"]).rename(columns=TO_CHARGE_COLUMNS)
    return made.assign(charge_planned=False), parts.drop(columns=["part", "arrived_s", "arrival_soc_pct"])


def find_wanted(outlooks: pd.DataFrame) -> pd.DataFrame:
    """Return the first forecast of each part of a shift that tells the charge to be at most each time ahead.

    Returns
    -------
    DataFrame
        `SHIFT_KEY`, `hours` and `wanted_s`, for each of `HOURS_AHEAD` but 0 that is passed within the part.
    """
    told = outlooks.dropna(subset=["shift_end_s", "soc_mean_pct"]).sort_values("time_s", kind="stable")
    ahead = (told["shift_end_s"] - told["time_s"]) / 3600.0
    found = []
    for hours in HOURS_AHEAD[1:]:
        first = told[ahead <= hours].drop_duplicates(SHIFT_KEY)
        near = first[ahead[first.index] > hours - MOST_SHORT]
        found.append(near[[*SHIFT_KEY, "time_s"]].rename(columns={"time_s": "wanted_s"}).assign(hours=hours))
    return pd.concat(found, ignore_index=True)


def select_over_charge(outlooks: pd.DataFrame, shifts: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the forecasts for the end of the shift over a planned charge, and the shifts, for `select_cases`."""
    known = outlooks["charge_planned"].to_numpy(bool)
    values = {name: outlooks[name].where(known) for name in ("soc_mean_pct", "soc_p05_pct", "soc_p95_pct")}
    return outlooks.assign(**values, charge_planned=False), shifts.assign(charged_s=np.nan)


def compute_over_charge_baselines(cases: pd.DataFrame, outlooks: pd.DataFrame, shifts: pd.DataFrame) -> pd.DataFrame:
    """Return the state of charge that baselines expect at the end of a shift with a planned charge.

    Returns
    -------
    (n, columns) DataFrame
        The columns of `socast.core.evaluate.soc.baselines.compute_baselines`: consumption by kilometre from the planned
        charge on; NaN of baselines that know no charge. [%]
    """
    told = normalise_keys(outlooks)[[*SHIFT_KEY, "time_s", "charge_to_pct", "charge_km"]]
    told = told.drop_duplicates([*SHIFT_KEY, "time_s"])
    matched = cases[[*SHIFT_KEY, "time_s"]].merge(told, on=[*SHIFT_KEY, "time_s"], how="left")
    km = cases["ahead_km"].to_numpy(np.float64) - matched["charge_km"].fillna(0.0).to_numpy(np.float64)
    charged = cases.assign(soc_pct=matched["charge_to_pct"].to_numpy(np.float64), ahead_km=km)
    unknown = dict.fromkeys((*BASELINES, *REGRESSION_COLUMNS), np.full(len(cases), np.nan))
    return pd.DataFrame(unknown | compute_rate_baselines(charged, shifts))


def select_charge_cases(
    outlooks: pd.DataFrame, shifts: pd.DataFrame, plans: pd.DataFrame | None = None
) -> dict[str, pd.DataFrame]:
    """Return the forecasts around planned charges that are evaluated, with their baselines.

    Returns
    -------
    dict of str to DataFrame
        `to the charge` and `over the charge`, those of them that have forecasts: cases as in
        `socast.core.evaluate.soc.cases.ForecastCases`, with a column for each baseline.
    """
    if not len(outlooks) or not outlooks["charge_planned"].any():
        return {}
    parts = split_at_charges(outlooks, shifts)
    until = select_cases(*parts, find_wanted(parts[0])).cases
    over = select_cases(*select_over_charge(outlooks, shifts)).cases
    selected = {}
    if len(until):
        expected = compute_baselines(until, *parts, plans).assign(**compute_rate_baselines(until, shifts))
        selected["to the charge"] = pd.concat([until, expected], axis=1)
    if len(over):
        expected = compute_over_charge_baselines(over, outlooks, shifts)
        selected["over the charge"] = pd.concat([over, expected], axis=1)
    return selected
