"""Read and write files of data sheets of cars."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from socast.core.errors import CatalogueError, read_input
from socast.core.vehicles import VehicleModel, read_data_sheets

LARGEST_FILE: Final = 1 << 20
"""Largest file of data sheets. [B]"""


def load_vehicle_file(file: Path) -> Mapping[str, VehicleModel]:
    """Return the vehicle models of a file of data sheets."""
    try:
        text = read_input(file, LARGEST_FILE).decode("utf-8-sig")
    except OSError as error:
        raise CatalogueError(
            f"{file} cannot be read: {error.strerror}; write one with `socast vehicles new {file}`"
        ) from error
    except UnicodeDecodeError as error:
        raise CatalogueError(f"{file} is not UTF-8 from byte {error.start} on; save it as UTF-8") from error
    return read_data_sheets(text, str(file))


def make_data_sheet(
    key: str, mass_kg: float, capacity_kwh: float, drag_area_m2: float | None, rated_kwh_per_100km: float | None
) -> str:
    """Return a file with the data sheet of one car, and comments on what it may hold.

    Units: rated_kwh_per_100km [kWh/100 km].
    """
    drag = f"drag_area_m2 = {drag_area_m2:g}" if drag_area_m2 is not None else "# drag_area_m2 = 0.65"
    rated = f"{rated_kwh_per_100km / 100:g}" if rated_kwh_per_100km is not None else None
    return f"""\
# Cars of one's own. The name of a table is the key that vehicle messages and maps name. What is not given is assumed
# as usual in the vehicle catalogue; a fit corrects it from rides.

[{key}]
mass_kg = {mass_kg:g}                # kerb mass: ready to drive, battery included, nobody aboard
nominal_capacity_kwh = {capacity_kwh:g}    # rated energy of the battery when new
{drag}          # drag coefficient times frontal area; or both: drag_coefficient and frontal_area_m2
{f"rated_kwh_per_km = {rated}" if rated else "# rated_kwh_per_km = 0.165"}      # official consumption
# usable_capacity_kwh = {0.95 * capacity_kwh:g}      # what 100 to 0 % of displayed charge yields when new
# rolling_resistance = 0.009    # warm tyres on dry asphalt
# accessory_scale = 1.0         # climate and accessory power over that of a compact car with a resistance heater
# name = "..."                  # name for people
"""
