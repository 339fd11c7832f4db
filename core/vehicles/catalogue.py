"""Read the vehicle catalogue, apply the overrides in vehicle messages, and define the accessory power curve."""

import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import Any, Final

import msgspec
import numpy as np

from socast.core.batch import Floats
from socast.core.columns import ZERO_CELSIUS
from socast.core.errors import CatalogueError, suggest_names
from socast.core.settings import LIMITS
from socast.core.wire.messages import Vehicle

OCCUPANT_MASS: Final = 75.0
"""Mass of a person with hand luggage. [kg] Regulation (EU) No 1230/2012, Art. 2(4)(a), driver."""

BOUNDS: Final[Mapping[str, tuple[float, float]]] = MappingProxyType(
    {
        "mass_kg": (200.0, 7500.0),
        "drag_coefficient": (0.1, 1.2),
        "frontal_area_m2": (0.5, 9.0),
        "rolling_resistance": (0.003, 0.05),
        "nominal_capacity_kwh": (1.0, 400.0),
        "accessory_scale": (0.0, 5.0),
    }
)
"""Closed interval of plausible figures of a road vehicle, from a quadricycle to a delivery lorry."""

RATED: Final = (0.02, 1.0)
"""Closed interval of a plausible official consumption, where one is known. [kWh/km]"""

OVERRIDES: Final = ("nominal_capacity_kwh", "mass_kg", "drag_coefficient", "frontal_area_m2", "rolling_resistance")
"""Figures that a `Vehicle` message may override; a message with all of them needs no catalogue entry."""

UNKNOWN_MODEL: Final = "unknown_vehicle_model"
"""Reason: the catalogue lacks the key, and the overrides are incomplete."""
OUT_OF_RANGE: Final = "override_out_of_range"
"""Reason: an override is outside `BOUNDS`, or the period of the logger is outside the limits of that setting."""


@dataclass(frozen=True)
class VehicleModel:
    """Hold the figures that all cars of one model share.

    Parameters
    ----------
    key : str
        Key of the model in messages and tables.
    mass_kg : float
        Kerb mass: ready to drive, battery included, without occupants. [kg]
    drag_coefficient : float
        Coefficient of aerodynamic drag. [1]
    frontal_area_m2 : float
        Frontal area. [m^2]
    rolling_resistance : float
        Coefficient of warm tyres on dry asphalt. [1]
    nominal_capacity_kwh : float
        Rated energy of the new battery. [kWh]
    accessory_scale : float
        Climate and accessory power relative to `ACCESSORIES`. [1]
    usable_capacity_kwh : float, optional
        Energy of the new battery from 100 to 0 % of displayed charge, where it is known. [kWh]
    rated_kwh_per_km : float, optional
        Official consumption, where it is known; US labels include charging losses. [kWh/km]
    sources : mapping of str to str
        Source of each figure; it begins with `estimated` where the figure was not published or measured.
    """

    key: str
    name: str
    mass_kg: float
    drag_coefficient: float
    frontal_area_m2: float
    rolling_resistance: float
    nominal_capacity_kwh: float
    accessory_scale: float
    usable_capacity_kwh: float | None
    rated_kwh_per_km: float | None
    sources: Mapping[str, str] = field(hash=False)

    @property
    def drag_area_m2(self) -> float:
        """Drag coefficient times frontal area. [m^2]"""
        return self.drag_coefficient * self.frontal_area_m2


class AccessoryCurve(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Define accessory power as a function of the outside temperature, in five segments.

    The power is `heating` below `heating_full` and falls linearly to `standby` at `heating_off`. It stays at `standby`,
    without heating or cooling, up to `cooling_on`. It then rises linearly to `cooling` at `cooling_full` and above.

    Parameters
    ----------
    heating_full, heating_off, cooling_on, cooling_full : float
        Temperatures between the segments, ascending. [K]
    heating, standby, cooling : float
        Power in the first, third and fifth segment. [W]

    References
    ----------
    "Predicting Electric Vehicle Consumption: A Hybrid Physical-Empirical Model", section 4.2 and Figure 1.
    """

    heating_full: float
    heating_off: float
    cooling_on: float
    cooling_full: float
    heating: float
    standby: float
    cooling: float

    def power(self, ambient: Floats) -> Floats:
        """Return the accessory power at an outside temperature.

        Returns
        -------
        (n,) float
            Accessory power, NaN where the temperature is NaN. [W]
        """
        heat = np.clip((self.heating_off - ambient) / (self.heating_off - self.heating_full), 0.0, 1.0)
        cool = np.clip((ambient - self.cooling_on) / (self.cooling_full - self.cooling_on), 0.0, 1.0)
        return self.standby + (self.heating - self.standby) * heat + (self.cooling - self.standby) * cool


ACCESSORIES: Final = AccessoryCurve(
    heating_full=ZERO_CELSIUS - 20.0,
    heating_off=ZERO_CELSIUS + 12.0,
    cooling_on=ZERO_CELSIUS + 21.0,
    cooling_full=ZERO_CELSIUS + 35.0,
    heating=4000.0,
    standby=300.0,
    cooling=1500.0,
)
"""Accessory power of the reference car: a compact car with a resistance heater, on short drives.

The slopes follow the mean heater and air-conditioning power per drive of the Nissan Leaf 455 in the Vehicle Energy
Dataset: 3.3 kW at -13 °C, 2.8 kW at -8 °C, 1.7 kW at -2 °C, 0.9 kW at 3 °C, 0.3 kW at 7 °C, 0.1 kW from 13 to 18 °C,
0.4 kW at 27 °C and 0.9 kW at 32 °C (Oh, LeBlanc and Peng 2019, arXiv:1905.02081). `standby` is an estimate that covers
control units, pumps, lights and radio. Both ends are extrapolated beyond the drives. The 4 kW of full heating are
less than the 5 kW of that heater (Argonne National Laboratory, Leaf testing).
"""


_OWN: Final[dict[str, VehicleModel]] = {}
"""Vehicle models that were added to those of the product."""


def load_catalogue() -> Mapping[str, VehicleModel]:
    """Return the vehicle models that the product includes, and those that were added.

    Examples
    --------
    >>> load_catalogue()["nissan-leaf-2013"].nominal_capacity_kwh
    24.0
    """
    return MappingProxyType({**_read_shipped(), **_OWN}) if _OWN else _read_shipped()


def add_vehicles(vehicles: Mapping[str, VehicleModel]) -> None:
    """Add vehicle models of one's own to the catalogue of this process."""
    _OWN.update(vehicles)


@cache
def _read_shipped() -> Mapping[str, VehicleModel]:
    """Read the included catalogue once per process."""
    return read_catalogue(resources.files("socast.core.vehicles").joinpath("vehicles.toml").read_text(encoding="utf-8"))


def read_catalogue(text: str) -> Mapping[str, VehicleModel]:
    """Read a vehicle catalogue from TOML.

    Parameters
    ----------
    text : str
        TOML with one table per vehicle model; the name of the table is the key of the model.
    """
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise CatalogueError(f"vehicle catalogue: not TOML: {error}") from error
    return MappingProxyType({key: read_entry(key, table) for key, table in tables.items()})


def vehicle_model(message: Vehicle) -> VehicleModel | str:
    """Return the vehicle model that a message describes: the catalogue entry with the overrides of the message.

    Returns
    -------
    VehicleModel or str
        Vehicle model. If the energy of the car cannot be predicted, the reason as a word to count: `UNKNOWN_MODEL` or
        `OUT_OF_RANGE`.

    Examples
    --------
    >>> vehicle_model(Vehicle("taxi-7", 0.0, "kia-soul-ev-2015", mass_kg=1600.0)).mass_kg
    1600.0
    >>> vehicle_model(Vehicle("taxi-8", 0.0, "horse"))
    'unknown_vehicle_model'
    """
    overrides = {name: getattr(message, name) for name in OVERRIDES if getattr(message, name) is not None}
    if any(not BOUNDS[name][0] <= value <= BOUNDS[name][1] for name, value in overrides.items()):
        return OUT_OF_RANGE
    if message.period_s and not LIMITS["period"][0] <= message.period_s <= LIMITS["period"][1]:
        return OUT_OF_RANGE
    known = load_catalogue().get(message.model)
    if known is None and len(overrides) < len(OVERRIDES):
        return UNKNOWN_MODEL
    sources = dict.fromkeys(overrides, "the car's own vehicle message")
    if known is None:
        sources["accessory_scale"] = "estimated: that of the reference car"
        return VehicleModel(
            key=message.model,
            name=message.model,
            accessory_scale=1.0,
            usable_capacity_kwh=None,
            rated_kwh_per_km=None,
            sources=sources,
            **overrides,
        )
    if not overrides:
        return known
    usable = known.usable_capacity_kwh
    if usable is not None and "nominal_capacity_kwh" in overrides:
        usable *= overrides["nominal_capacity_kwh"] / known.nominal_capacity_kwh
    return replace(known, usable_capacity_kwh=usable, sources={**known.sources, **sources}, **overrides)


def read_entry(key: str, table: Any, also: Collection[str] = ()) -> VehicleModel:
    """Check a table of the catalogue, and return it as a vehicle model."""
    if not isinstance(table, dict):
        raise CatalogueError(f"vehicle catalogue: {key!r} is no table: write [{key}] and its figures below")
    known = {f.name for f in fields(VehicleModel)} - {"key"}
    if unknown := sorted(table.keys() - known):
        remedy = suggest_names(unknown[0], sorted({*also, *known}))
        raise CatalogueError(f"vehicle {key}: {unknown[0]!r} is no figure of a vehicle; {remedy}")
    sources = table.get("sources")
    if not isinstance(sources, dict):
        raise CatalogueError(f"vehicle {key}: it has no sources: say in [{key}.sources] where each figure comes from")
    figures: dict[str, float] = {}
    for name, (low, high) in BOUNDS.items():
        figures[name] = _read_figure(key, table, name, low, high)
        if not str(sources.get(name, "")).strip():
            raise CatalogueError(
                f"vehicle {key}: {name} has no source: say in [{key}.sources] where {figures[name]:g} comes from"
            )
    usable = None
    if "usable_capacity_kwh" in table:
        usable = _read_figure(key, table, "usable_capacity_kwh", 1.0, figures["nominal_capacity_kwh"])
    rated = _read_figure(key, table, "rated_kwh_per_km", *RATED) if "rated_kwh_per_km" in table else None
    title = table.get("name")
    if not isinstance(title, str) or not title.strip():
        raise CatalogueError(f'vehicle {key}: it has no name: add name = "..."')
    return VehicleModel(
        key=key, name=title, usable_capacity_kwh=usable, rated_kwh_per_km=rated, sources=dict(sources), **figures
    )


def _read_figure(key: str, table: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """Return a figure of a table, checked to be a number within its bounds."""
    value = table.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool):
        problem = "is missing" if value is None else f"is {value!r}, no number"
        raise CatalogueError(f"vehicle {key}: {name} {problem}: give one from {low:g} to {high:g}")
    if not low <= value <= high:
        raise CatalogueError(f"vehicle {key}: {name} {value:g} is outside {low:g} to {high:g}: correct it")
    return float(value)
