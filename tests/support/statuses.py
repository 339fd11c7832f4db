"""The status of a car between rides, whose forecast knows only what is given."""

from typing import Any

from socast.core.forecast.status import VehicleStatus
from socast.core.wire.messages import Forecast, QualityCounts


def make_status(vehicle_id: str = "taxi-1", time_s: float = 1.7e9, **known: Any) -> VehicleStatus:
    """Return a status with these fields of the forecast."""
    fields: dict[str, Any] = {name: None for name in Forecast.__struct_fields__ if name != "next_charge"}
    given = {"vehicle_id": vehicle_id, "time_s": time_s, "model": "m/1", "quality": QualityCounts(0, 0, 0, 0, 0)}
    ride = {"ride_distance_km": 0.0, "ride_duration_s": 0.0}
    return VehicleStatus(Forecast(**fields | given | ride | known), "kia-soul-ev-2015", 64.0)
