"""Read the vehicle catalogue, and hold the cars of the fleet.

Other packages import the names that this package exports.
"""

from core.vehicles.catalogue import (
    ACCESSORIES,
    OCCUPANT_MASS,
    AccessoryCurve,
    VehicleModel,
    load_catalogue,
    read_catalogue,
)

__all__ = ["ACCESSORIES", "OCCUPANT_MASS", "AccessoryCurve", "VehicleModel", "load_catalogue", "read_catalogue"]
