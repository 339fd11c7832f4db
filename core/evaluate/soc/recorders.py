"""Record queries and plans while recordings pass, and match the legs of the answers to the rides that they became.

Where a vehicle charges during its shift, the forecast of the shift's end cannot be evaluated, because it states the
outcome without a charge. The answer to a query (`socast.core.forecast.what_if`) states the charge at the end of each
leg, and legs that end before the charge can be evaluated. Queries are therefore made throughout the shift, and each leg
is compared with the ride that it became.

The messages before which a vehicle is queried follow from the event times in the messages alone. The day is divided
into slots of `QUERY_INTERVAL`. A vehicle is queried when its first sample of another slot is about to be taken, so that
the answer rests on all messages before that sample, and on no other. A list or batch of samples is taken as a whole,
and counts by the first sample of each vehicle in it. How a source divides messages into lists changes nothing.

Plans are read from their messages and not from the forecaster, so that what judges it does not depend on it.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import takewhile
from math import floor, inf, isfinite, isnan, nan
from typing import Any, Final

import msgspec
import numpy as np
import pandas as pd

from socast.core.columns import SECONDS_PER_DAY
from socast.core.errors import AskError
from socast.core.evaluate.soc.cases import normalise_keys
from socast.core.files import UNREADABLE
from socast.core.fit.ride_blocks import assign_vehicle_days
from socast.core.forecast.plan_tracker import SHORTEST_RIDE
from socast.core.wire.arrow_batch import PREFIX
from socast.core.wire.messages import BATCH, Leg, Message, Outlook, address
from socast.core.wire.sample_reader import read_samples

PLAN_COLUMNS: Final = ("vehicle_id", "time_s", "plan_km", "plan_drive_s", "charge_ahead", "charge_to_pct")
"""Columns of recorded plans: kilometres and time of all rides, whether a charge is planned, and up to which charge."""
QUERY_INTERVAL: Final = 1800.0
"""Length of a slot. [s]"""
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


class _Plan(msgspec.Struct, gc=False):
    """What a plan tells of its legs."""

    time_s: float
    legs: list[Leg]


class PlanRecorder:
    """Record what plans tell.

    Examples
    --------
    >>> recorder = PlanRecorder()
    >>> plan = b'{"time_s": 9, "legs": [{"distance_km": 3, "duration_s": 600}, {"charge_to_soc_pct": 80}]}'
    >>> recorder.record(Message("fleet/taxi-7/plan", plan, 0))
    >>> recorder.table()[["plan_km", "plan_drive_s", "charge_ahead"]].values.tolist()
    [[3.0, 600.0, True]]
    """

    def __init__(self) -> None:
        self._rows: list[tuple[Any, ...]] = []
        self._decoder = msgspec.json.Decoder(_Plan)

    def record(self, message: Message) -> None:
        """Record a message if it is a plan that can be read."""
        if not message.key.endswith("/plan") or (whose := address(message.key)) is None:
            return
        try:
            plan = self._decoder.decode(message.payload)
        except UNREADABLE:
            return
        charges = [leg.charge_to_soc_pct for leg in plan.legs if leg.charge_to_soc_pct is not None]
        rides = [leg for leg in plan.legs if leg.charge_to_soc_pct is None]
        km = sum(leg.distance_km or 0.0 for leg in rides)
        seconds = sum(leg.duration_s for leg in rides if not isnan(leg.duration_s))
        self._rows.append((whose.identity, plan.time_s, km, seconds, bool(charges), max(charges, default=nan)))

    def table(self) -> pd.DataFrame:
        """Return one row per recorded plan, with `PLAN_COLUMNS`."""
        table = pd.DataFrame(self._rows, columns=list(PLAN_COLUMNS))
        kinds: dict[str, Any] = {"vehicle_id": "str", "charge_ahead": "bool"}
        return table.astype(dict.fromkeys(PLAN_COLUMNS, "float64") | kinds)


class _SampleTime(msgspec.Struct, gc=False):
    """The time of a sample, whose other fields are not decoded."""

    time_s: float


class QueryTimes:
    """Cut lists of messages where a vehicle is to be queried.

    Examples
    --------
    >>> times = QueryTimes()
    >>> sample = lambda time: Message("fleet/taxi-7/telemetry", b'{"time_s": %d}' % time, 0)
    >>> [(len(part), due) for part, due in times.cut([sample(1790), sample(1797), sample(1803)])]
    [(2, 'taxi-7'), (1, None)]
    """

    def __init__(self) -> None:
        self._slots: dict[str, int] = {}
        self._decoder = msgspec.json.Decoder(_SampleTime | list[_SampleTime])

    def cut(self, messages: Sequence[Message]) -> Iterator[tuple[Sequence[Message], str | None]]:
        """Yield the messages in parts, each with the vehicle that is due after it; the last part has none."""
        start = 0
        for place, message in enumerate(messages):
            for vehicle_id, slot in self._find_slots(message):
                before = self._slots.get(vehicle_id)
                if slot is None or slot == before:
                    continue
                self._slots[vehicle_id] = slot
                if before is not None:
                    yield messages[start:place], vehicle_id
                    start = place
        yield messages[start:], None

    def _find_slots(self, message: Message) -> Iterable[tuple[str, int | None]]:
        """Return the vehicles of a message and the slots of their first samples in it."""
        whose = address(message.key)
        if whose is None or whose.kind not in {"telemetry", BATCH}:
            return ()
        if not message.payload.startswith(PREFIX):
            return ((whose.identity, self._find_slot(message.payload)),) if whose.kind != BATCH else ()
        first: dict[str, int | None] = {}
        for vehicle_ids, _, columns in read_samples([message], Counter()):
            for vehicle_id, time in zip(vehicle_ids, columns.time.tolist(), strict=True):
                first.setdefault(vehicle_id, floor(time / QUERY_INTERVAL))
        return first.items()

    def _find_slot(self, payload: bytes) -> int | None:
        """Return the slot of a sample, or of the first of several; None where a payload tells no time."""
        try:
            sample = self._decoder.decode(payload)
        except UNREADABLE:
            return None
        if isinstance(sample, list):
            if not sample:
                return None
            sample = sample[0]
        return floor(sample.time_s / QUERY_INTERVAL) if isfinite(sample.time_s) else None


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
