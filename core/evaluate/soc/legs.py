"""Evaluate forecasts of single legs up to the next charge.

Where a vehicle charges during its shift, the forecast of the shift's end cannot be evaluated, because it states the
outcome without a charge. The answer to a query (`socast.core.forecast.what_if`) states the charge at the end of each
leg, and legs that end before the charge can be evaluated. Queries are therefore made throughout the shift
(`socast.core.evaluate.soc.query_times`), and each leg is compared with the ride that it became.
"""

from collections.abc import Callable, Iterator
from itertools import takewhile
from math import inf
from typing import Any, Final

import numpy as np
import pandas as pd

from socast.core.columns import SECONDS_PER_DAY
from socast.core.errors import AskError
from socast.core.evaluate.soc.cases import normalise_keys
from socast.core.evaluate.soc.query_times import QUERY_INTERVAL
from socast.core.fit.ride_blocks import assign_vehicle_days
from socast.core.forecast.plan_tracker import SHORTEST_RIDE
from socast.core.wire.messages import Outlook

LEAST_INTERVAL: Final = QUERY_INTERVAL / 2.0
"""Time of a vehicle that must pass between two recorded answers, as late samples may call for a query twice. [s]"""
MINUTES: Final = (30, 60, 120, 240)
"""Edges of the bands of the time from a query to the leg's end; the first and last band are open. [min]"""
LEG_COLUMNS: Final = [
    "vehicle_id",
    "time_s",
    "leg",
    "ahead_km",
    "soc_pct",
    "soc_mean_pct",
    "soc_p05_pct",
    "soc_p95_pct",
]
"""Columns of each recorded leg: time, position from 0, kilometres up to its end, charge then, and the forecast."""

RIDE_COLUMNS: Final = {"end_s": "ride_end_s", "soc_end_pct": "soc_end_pct", "time_since_charge_s": "since_charge_s"}
"""Columns of rides that the evaluation needs -> their names here."""
LEG_SHIFT_COLUMNS: Final = ["shift", "vehicle_model", "begin_s", "end_s", "charged_s", "capacity_kwh"]
"""Columns of shifts that the evaluation needs."""


class LegRecorder:
    """Query a pipeline while it runs and record the answers."""

    def __init__(self, ask: Callable[[str], Outlook]) -> None:
        self._ask = ask
        self._last: dict[str, float] = {}
        self._rows: list[tuple[Any, ...]] = []

    def query(self, vehicle_id: str) -> None:
        """Query a vehicle and record the legs of the answer that have a forecast of the charge."""
        try:
            answer = self._ask(vehicle_id)
        except AskError:  # none of its samples could be used so far
            return
        if answer.time_s >= self._last.get(vehicle_id, -inf) + LEAST_INTERVAL:
            self._last[vehicle_id] = answer.time_s
            self._rows += _rows(vehicle_id, answer)

    def table(self) -> pd.DataFrame:
        """Return one row per recorded leg, with `LEG_COLUMNS`."""
        numbers: dict[str, Any] = dict.fromkeys(LEG_COLUMNS[1:], np.float64)
        return pd.DataFrame(self._rows, columns=LEG_COLUMNS).astype(numbers | {"leg": np.int64, "vehicle_id": "str"})


def _rows(vehicle: str, answer: Outlook) -> Iterator[tuple[Any, ...]]:
    """Return the forecast of each leg before the next planned charge."""
    km = 0.0
    for place, leg in enumerate(takewhile(lambda each: not each.is_charge(), answer.legs)):
        km += leg.distance_km
        if leg.soc_pct is not None:
            forecast = leg.soc_pct.mean, leg.soc_pct.p05, leg.soc_pct.p95
            yield vehicle, answer.time_s, place, km, answer.soc_pct, *forecast


def match_legs_to_rides(legs: pd.DataFrame, rides: pd.DataFrame, shifts: pd.DataFrame) -> pd.DataFrame:
    """Return the legs that are evaluated, each with the ride that it became.

    The first leg becomes the next ride to end after the query, the second leg the ride after that, and so on. False
    starts do not count as rides. A leg belongs to the shift in which it was queried. Rides of another shift, and rides
    after a charge, are left out.

    Returns
    -------
    DataFrame
        `LEG_COLUMNS`, the values of `RIDE_COLUMNS` of the ride and `LEG_SHIFT_COLUMNS` of the shift; `minutes` from the
        query to the ride's end; whether the vehicle `charges` later in the shift; and `cluster`, the vehicle-day.
    """
    driven = rides[rides["distance_km"] >= SHORTEST_RIDE].astype({"vehicle_id": "str"})
    driven = driven.rename(columns=RIDE_COLUMNS)[["vehicle_id", *RIDE_COLUMNS.values()]]
    driven = driven.sort_values("ride_end_s", kind="stable", ignore_index=True)
    driven["place"] = driven.groupby("vehicle_id").cumcount()
    before = driven[["vehicle_id", "ride_end_s", "place"]]
    cases = legs.sort_values("time_s", kind="stable")
    cases = pd.merge_asof(cases, before, left_on="time_s", right_on="ride_end_s", by="vehicle_id")
    cases["place"] = cases["place"].fillna(-1.0).astype(np.int64) + 1 + cases["leg"]
    cases = cases.drop(columns="ride_end_s").merge(driven, on=["vehicle_id", "place"])
    in_order = normalise_keys(shifts)[["vehicle_id", *LEG_SHIFT_COLUMNS]].sort_values("begin_s", kind="stable")
    cases = cases.sort_values("time_s", kind="stable")
    cases = pd.merge_asof(cases, in_order, left_on="time_s", right_on="begin_s", by="vehicle_id")
    charged = cases["ride_end_s"] - cases["since_charge_s"] > cases["time_s"]
    cases = cases[(cases["ride_end_s"] <= cases["end_s"]) & ~charged & cases["soc_end_pct"].notna()]
    day = np.floor(cases["begin_s"] / SECONDS_PER_DAY)
    return (
        cases.astype({"shift": np.int64})
        .assign(
            minutes=(cases["ride_end_s"] - cases["time_s"]) / 60.0,
            charges=cases["charged_s"] > cases["ride_end_s"],
            cluster=assign_vehicle_days(cases.assign(day=day), day="day"),
        )
        .reset_index(drop=True)
    )
