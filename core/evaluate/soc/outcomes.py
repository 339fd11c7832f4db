"""Replace outcomes that a faulty display reported, and count bounds that no outcome can reach.

Where a recording is simulated, the outcome of a shift is what a healthy display would show at its end. Elsewhere it is
what the car reported last.
"""

from typing import Final

import numpy as np
import pandas as pd

from socast.core.evaluate.soc.cases import normalise_keys
from socast.core.evaluate.soc.records import ImpossibleBounds

MOST_APART: Final = 3600.0
"""Largest difference between the begin of a shift and that of its display. [s]"""
TOLERANCE: Final = 0.05
"""By how much a bound may exceed the present charge, for rounding. [%]"""


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
