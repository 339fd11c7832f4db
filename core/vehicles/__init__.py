"""The vehicle catalogue and the cars of the fleet.

This package's own names are what other packages import.
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
