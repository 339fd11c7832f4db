"""Record the plans of dispatch while recordings pass, for baselines and horizons that need more than kilometres.

The plans are read from their messages and not from the forecaster, so that what judges it does not depend on it.
"""

from math import nan
from typing import Any, Final

import msgspec
import pandas as pd

from socast.core.wire.messages import Message, address

PLAN_COLUMNS: Final = ("vehicle_id", "time_s", "plan_km", "plan_drive_s", "charge_ahead", "charge_to_pct")
"""Columns of recorded plans: kilometres and time of all rides, whether a charge is planned, and up to which charge."""


class _Leg(msgspec.Struct, gc=False):
    """A ride, or a charge."""

    distance_km: float | None = None
    duration_s: float | None = None
    charge_to_soc_pct: float | None = None


class _Plan(msgspec.Struct, gc=False):
    """What a plan tells of its legs."""

    time_s: float
    legs: list[_Leg]


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
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return
        charges = [leg.charge_to_soc_pct for leg in plan.legs if leg.charge_to_soc_pct is not None]
        rides = [leg for leg in plan.legs if leg.charge_to_soc_pct is None]
        km, seconds = (sum(getattr(leg, name) or 0.0 for leg in rides) for name in ("distance_km", "duration_s"))
        upto = max(charges, default=nan)
        self._rows.append((whose.identity, plan.time_s, float(km), float(seconds), bool(charges), upto))

    def table(self) -> pd.DataFrame:
        """Return one row per recorded plan, with `PLAN_COLUMNS`."""
        table = pd.DataFrame(self._rows, columns=list(PLAN_COLUMNS))
        kinds: dict[str, Any] = {"vehicle_id": "str", "charge_ahead": "bool"}
        return table.astype(dict.fromkeys(PLAN_COLUMNS, "float64") | kinds)
