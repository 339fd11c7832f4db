"""Which forecasts of the state of charge at a shift's end are judged, and what became of each.

A shift that has ended gives one forecast for each time ahead: the newest that was made by then. Nothing that a forecast
rests on is from after it, as the pipeline learns while it goes, so no days are set apart.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

HOURS: Final = (0, 1, 2, 4, 6)
"""Times before a shift's end, by its last sample. [h]"""
NEAR: Final = 600.0
"""The newest forecast may be so old; where it is older the car was silent. [s]"""
CUT: Final = 900.0
"""A shift that the recording leaves so long before its planned end has not ended. [s]"""
DAY: Final = 86_400.0

KEY: Final = ["vehicle_id", "shift"]
"""What names a shift."""
CUT_SHORT: Final = "the recording ends before the shift"
SILENT: Final = "no forecast near"
CHARGED: Final = "charged before the end"
UNREPORTED: Final = "state of charge at the end not reported"
WARM_UP: Final = "no interval yet"
REASONS: Final = (CUT_SHORT, SILENT, CHARGED, UNREPORTED, WARM_UP)
"""Why a forecast is not judged; the first that applies is counted."""
OF_SHIFTS: Final = [
    *KEY,
    "vehicle_model",
    "begin_s",
    "end_s",
    "soc_end_pct",
    "soc_lowest_pct",
    "charged_s",
    "capacity_kwh",
]
"""Columns of the shifts that judging needs; the outside temperature is the shift's mean, `ambient_c`."""
OF_OUTLOOKS: Final = [
    *KEY,
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
]
"""The same of the forecasts."""


@dataclass(frozen=True)
class Judged:
    """Forecasts that are judged.

    Parameters
    ----------
    cases : DataFrame
        A row a forecast: `OF_SHIFTS` and `ambient_c` of its shift, `OF_OUTLOOKS` of its own, `hours` before the end,
        and `cluster`, int from 0, the same for all of a car on a day.
    left_out : dict of str to int
        Forecasts that are not, by reason.
    shifts : int
        That ended.
    warm_up : int
        Of these, the shifts left out as nothing was learned yet at any of the times.
    """

    cases: pd.DataFrame
    left_out: dict[str, int]
    shifts: int
    warm_up: int


def judged(outlooks: pd.DataFrame, shifts: pd.DataFrame) -> Judged:
    """Return the forecasts that are judged.

    Parameters
    ----------
    outlooks : DataFrame
        Forecasts as a pipeline made them, `OF_OUTLOOKS` at least.
    shifts : DataFrame
        Shifts that have ended, `OF_SHIFTS` and `ambient_c`.
    """
    made, ended = keyed(outlooks), keyed(shifts)[[*OF_SHIFTS, "ambient_c"]]
    made = made[OF_OUTLOOKS].sort_values("time_s", kind="stable")
    asked = pd.concat([ended.assign(hours=hours) for hours in HOURS], ignore_index=True)
    asked["asked_s"] = asked["end_s"] - 3600.0 * asked["hours"]
    asked = asked[asked["asked_s"] >= asked["begin_s"]].sort_values("asked_s", kind="stable")
    cases = pd.merge_asof(asked, made, left_on="asked_s", right_on="time_s", by=KEY)
    cases = cases.sort_values([*KEY, "hours"], ignore_index=True)
    why = _reasons(cases, made)
    day = np.floor(cases["begin_s"] / DAY)
    cases["cluster"] = cases.assign(day=day).groupby(["vehicle_id", "day"], sort=False).ngroup()
    kept = cases[why == ""].reset_index(drop=True)
    names = [f"{vehicle} {shift}" for vehicle, shift in zip(cases["vehicle_id"], cases["shift"], strict=True)]
    unlearned = set(np.array(names)[why == WARM_UP]) - set(np.array(names)[why == ""])
    left_out = {reason: int(np.sum(why == reason)) for reason in REASONS if np.any(why == reason)}
    return Judged(kept, left_out, len(ended), len(unlearned))


def _reasons(cases: pd.DataFrame, made: pd.DataFrame) -> NDArray[np.str_]:
    """Return why each forecast is not judged, empty where it is; `made` are all forecasts, by time."""
    planned = made[made["planned"].astype(bool)].groupby(KEY, sort=False)["shift_end_s"].last()
    end = cases[KEY].join(planned, on=KEY)["shift_end_s"] - cases["end_s"]
    cut = (end > CUT) & (made["time_s"].max() - cases["end_s"] < NEAR)
    unknown = cases[["soc_mean_pct", "soc_p05_pct", "soc_p95_pct"]].isna().any(axis=1)
    holds = {
        CUT_SHORT: cut,
        SILENT: ~(cases["asked_s"] - cases["time_s"] <= NEAR),
        CHARGED: cases["charged_s"] >= cases["time_s"],
        UNREPORTED: cases["soc_end_pct"].isna(),
        WARM_UP: unknown,
    }
    return np.select([holds[reason].to_numpy(bool) for reason in REASONS], list(REASONS), "")


def keyed(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose keys have the same types wherever it came from."""
    return table.astype({"vehicle_id": "str", "shift": np.int64})
