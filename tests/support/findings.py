"""Findings of a diagnosis, for tests."""

from datetime import date
from typing import Any

from socast.core.diagnose.findings import FleetUse
from socast.core.wire.messages import Cause, Finding

USE = FleetUse(energy=300.0, distance=2000.0, months=2.0, last_day=date(2018, 11, 30))
"""What a fleet used, 0.15 kWh per km."""


def make_finding(**changes: Any) -> Finding:
    """Return a sure finding about one car."""
    fields: dict[str, Any] = {
        "who": "taxi-005", "effect": "tyre_pressure", "time_s": 1543622400.0, "status": "sure", "probability": 0.97,
        "causes": [Cause("tyre_pressure", 0.71), Cause("brake_drag", 0.24)], "first_seen": "2018-11-28",
        "sure_since": "2018-11-30", "since": "2018-11-14", "share": 0.041, "share_lower": 0.032, "share_upper": 0.05,
        "kwh_per_month": 12.1, "range_km_per_month": 80.7,
        "words": "taxi-005 uses 4.1 ± 0.9 % more", "commands": ["socast add tyre_pressure", "socast live"],
    }  # fmt: skip
    return Finding(**fields | changes)
