"""Read the vehicle catalogue, and hold the cars of the fleet.

Other packages import the names that this package exports.
"""

from socast.core.vehicles.catalogue import (
    ACCESSORIES,
    OCCUPANT_MASS,
    AccessoryCurve,
    VehicleModel,
    add_vehicles,
    load_catalogue,
    read_catalogue,
)
from socast.core.vehicles.data_sheet import is_drag_area_assumed, list_assumed, read_data_sheets

__all__ = [
    "ACCESSORIES",
    "OCCUPANT_MASS",
    "AccessoryCurve",
    "VehicleModel",
    "add_vehicles",
    "is_drag_area_assumed",
    "list_assumed",
    "load_catalogue",
    "read_catalogue",
    "read_data_sheets",
]
