"""Answers of a consumer, for tests that need no forecast of their own."""

from typing import Any

import msgspec

from socast.core.errors import AskError
from socast.core.wire.messages import Interval, Leg, LegOutlook, Outlook, Plan
from socast.core.wire.plan_checks import find_refusal

NOW = 1_705_320_000.0
"""Time of the newest sample of every car. [s]"""
PLANNED = Plan("taxi-7", NOW, NOW + 7200.0, 20.0, [Leg(10.0, 1200.0), Leg(20.0, 1800.0)])

OUTLOOK = Outlook(
    vehicle_id="taxi-7",
    time_s=NOW,
    model="hybrid/2",
    soc_pct=72.04,
    soc_sd_pct=0.4,
    usable_capacity_kwh=38.2,
    usable_capacity_sd_kwh=0.6,
    consumption_scale=1.04,
    asked=LegOutlook(18.0, 1500.0, Interval(3.1, 2.7, 3.6), Interval(61.2, 57.0, 65.0)),
    legs=[LegOutlook(leg.distance_km, leg.duration_s, Interval(2.0, 1.5, 2.5), None) for leg in PLANNED.legs],
    shift_end_s=PLANNED.shift_end_s,
    soc_end_of_shift_pct=Interval(31.0, 24.0, 38.0),
    reserve_soc_pct=20.0,
    reserve_risk=0.02,
    why_not=None,
)


def outlook(**changed: Any) -> Outlook:
    """Return an outlook with some of its fields changed."""
    return msgspec.structs.replace(OUTLOOK, **changed)


class Fleet:
    """Answer queries about `taxi-7`, and raise for `taxi-0`."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, Leg | None, Plan | None]] = []

    def ask(self, vehicle_id: str, leg: Leg | None, plan: Plan | None) -> Outlook:
        """Return the outlook of a query."""
        self.asked.append((vehicle_id, leg, plan))
        if vehicle_id == "taxi-0":
            raise ZeroDivisionError
        if vehicle_id != "taxi-7":
            raise AskError(f"{vehicle_id} is not known; ask of a car that has sent a sample", "unknown_vehicle")
        if plan is not None and (refused := find_refusal(plan, NOW)):
            raise AskError(refused.message, refused.cause)
        legs = (plan or PLANNED).legs
        return outlook(
            asked=LegOutlook(leg.distance_km, leg.duration_s, None, None) if leg else None,
            legs=[LegOutlook(each.distance_km, each.duration_s, None, None) for each in legs],
        )
