"""What a model may read of a ride, with units: every column here has a meaning on a ride in progress too.

Columns of the ride table are named as there. What holds the answer (`energy_*`, `soc_end_pct`, `hvac_kwh`) is no
feature. Derived columns are made of others when they are asked for, so that no table need hold them. So are scopes,
which are 1 for one vehicle (`vehicle=taxi-003`) or from a date on (`since=2018-06-01`), and 0 otherwise: with one in
its product a term holds there and nowhere else.
"""

from collections.abc import Iterator, Mapping
from datetime import UTC, date, datetime
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from core import effects
from core.batch import Floats, Table
from core.columns import ZERO_CELSIUS
from core.errors import ModelError
from core.models.derived_features import DERIVED_COLUMNS
from core.vehicles import AccessoryCurve

EFFECT_PREFIX: Final = "effect_"
ACCESSORIES_COLUMN: Final = "accessories_kwh"
"""Energy of climate control and all else on board by a model's own curve; needs a curve, unlike other columns."""
VEHICLE_SCOPE: Final = "vehicle="
"""How the name of a column begins that is 1 for one vehicle; its identity follows."""
SINCE_SCOPE: Final = "since="
"""How the name of a column begins that is 1 from a date on; the date follows, ISO, from midnight UTC on."""
ANSWERS: Final = ("energy_", "soc_end_pct", "hvac_kwh")
"""How the names of columns begin that hold what a model is to predict."""

_HISTOGRAM = {f"speed_{5 * i}_{5 * i + 5}_km": "km" for i in range(21)}

FEATURES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "distance_km": "km",
        "average_speed_kmh": "(km/h)",
        "gained_m": "m",
        "lost_m": "m",
        "duration_s": "s",
        "ambient_c": "K",
        "wind_speed_kmh": "(km/h)",
        "wind_from_deg": "degree",
        "precipitation_mm_h": "(mm/h)",
        "stops": "1",
        "soc_start_pct": "percent",
        "battery_temperature_c": "K",
        "elapsed_s": "s",
        "parked_s": "s",
        "time_since_charge_s": "s",
        "odometer_km": "km",
        "occupants": "1",
        "winter": "1",
        "summer": "1",
        "start_s": "s",
        "latitude_start_deg": "degree",
        "longitude_start_deg": "degree",
        "latitude_end_deg": "degree",
        "longitude_end_deg": "degree",
        "mass_kg": "kg",
        "rolling_resistance": "1",
        "drag_area_m2": "m^2",
        "nominal_capacity_kwh": "kWh",
        "accessory_scale": "1",
        **_HISTOGRAM,
    }
)
"""Unit of each column of the ride table that a term may read, beside `effect_*`; of temperatures, of a difference."""


ACCESSORY_NEEDS: Final = ("duration_s", "ambient_c", "accessory_scale")


def is_scope(column: str) -> bool:
    """Tell whether a column is 1 where a term holds, and 0 elsewhere."""
    return column.startswith((VEHICLE_SCOPE, SINCE_SCOPE))


def parse_since(column: str) -> float:
    """Return when a scope `since=DATE` begins, as a Unix time. [s]

    Raises
    ------
    ModelError
        Where that is no date.

    Examples
    --------
    >>> beginning("since=2018-06-01")
    1527811200.0
    """
    said = column.removeprefix(SINCE_SCOPE)
    try:
        day = date.fromisoformat(said)
    except ValueError as error:
        raise ModelError(f"scope {column!r}: {said!r} is no date ({error}): write since=YYYY-MM-DD") from error
    if day.isoformat() != said:
        raise ModelError(f"scope {column!r}: write the date as since={day.isoformat()}")
    return datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()


def list_raw_columns(column: str) -> tuple[str, ...]:
    """Return the columns of the ride table that a column is made of: itself, unless it is derived.

    Examples
    --------
    >>> needed("wind_from_east")
    ('wind_from_deg',)
    """
    if column == ACCESSORIES_COLUMN:
        return ACCESSORY_NEEDS
    if is_scope(column):
        return ("vehicle_id",) if column.startswith(VEHICLE_SCOPE) else ("start_s",)
    return DERIVED_COLUMNS[column].needs if column in DERIVED_COLUMNS else (column,)


def get_unit(column: str) -> str:
    """Return the unit of a column, as pint spells it.

    Raises
    ------
    ModelError
        Where no model may read it: it is unknown, or it holds the answer.
    EffectError
        Where it is of an effect that is unknown.
    """
    if column == ACCESSORIES_COLUMN:
        return "kWh"
    if column.startswith(EFFECT_PREFIX):
        declared = effects.get(column.removeprefix(EFFECT_PREFIX)).unit
        return "kWh" if declared == "1" else f"(kWh/({declared}))"
    if is_scope(column):
        _check_scope(column)
        return "1"
    if column in DERIVED_COLUMNS:
        return DERIVED_COLUMNS[column].unit
    if column in FEATURES:
        return FEATURES[column]
    if column.startswith(ANSWERS):
        raise ModelError(f"column {column!r} holds what is to be predicted: take it out of the model")
    raise ModelError(f"column {column!r} is none that a model can read: name an effect_* or a column of the ride table")


def _check_scope(column: str) -> None:
    """Refuse a scope that names no date, or no vehicle."""
    if column.startswith(SINCE_SCOPE):
        parse_since(column)
    elif not column.removeprefix(VEHICLE_SCOPE).strip():
        raise ModelError(f"scope {column!r} names no vehicle: write vehicle=ID, with an ID of the ride table")


def derive_coefficient_unit(columns: tuple[str, ...]) -> str:
    """Return the unit of the coefficient of a product of columns that is an energy in kWh, as pint spells it.

    Examples
    --------
    >>> coefficient_unit(("effect_aero_drag", "drag_area_m2")), coefficient_unit(("effect_rolling", "odometer_km"))
    ('1', '1/km')
    >>> coefficient_unit(()), coefficient_unit(("average_speed_kmh", "lost_m"))
    ('kWh', 'kWh/(km/h)/m')
    """
    above, below = ["kWh"], []
    for column in columns:
        if column.startswith(EFFECT_PREFIX):
            above.append(effects.get(column.removeprefix(EFFECT_PREFIX)).unit)
            below.append("kWh")
        else:
            below.append(get_unit(column))
    for name in list(above):
        if name == "1" or name in below:
            above.remove(name)
            if name != "1":
                below.remove(name)
    return "/".join(["*".join(above) or "1", *(name for name in below if name != "1")])


class Columns(Mapping[str, Floats]):
    """Columns of some rides, as a fit sees them: unknown values filled, derived columns made when asked for.

    Parameters
    ----------
    table : mapping of str to (n,) array
        Columns of the ride table, or a `DataFrame`.
    fills : mapping of str to float
        What stands for an unknown (NaN) value of a column, derived ones included; a column that is not here stays NaN.
    curve : AccessoryCurve, optional
        Of `accessories_kwh`.
    rows : (m,) int, optional
        Which rows; all, where not given.
    """

    def __init__(
        self,
        table: Table,
        fills: Mapping[str, float] | None = None,
        curve: AccessoryCurve | None = None,
        rows: Any = None,
    ) -> None:
        self.table = table
        self.fills = fills or {}
        self.curve = curve
        self.rows = rows
        self._made: dict[str, Floats] = {}

    def __getitem__(self, name: str) -> Floats:
        """Return a column as (m,) float, NaN where it is unknown and no fill stands for it."""
        found = self._made.get(name)
        if found is None:
            found = self._make(name)
            fill = self.fills.get(name)
            if fill is not None:
                found = np.where(np.isnan(found), fill, found)
            self._made[name] = found
        return found

    def _make(self, name: str) -> Floats:
        """Return a column as the table has it, or made of others."""
        if name == ACCESSORIES_COLUMN:
            if self.curve is None:
                raise ModelError(
                    f"{ACCESSORIES_COLUMN} needs an accessory curve, and this fit has none: fit the model anew"
                )
            duration, ambient, scale = (self[needed] for needed in ACCESSORY_NEEDS)
            return duration * self.curve.power(ambient + ZERO_CELSIUS) * scale / 3.6e6
        if name.startswith(VEHICLE_SCOPE):
            return (self._raw("vehicle_id", object) == name.removeprefix(VEHICLE_SCOPE)).astype(np.float64)
        if name.startswith(SINCE_SCOPE):
            return (self["start_s"] >= parse_since(name)).astype(np.float64)
        if name in DERIVED_COLUMNS:
            return DERIVED_COLUMNS[name].make(*(self[needed] for needed in DERIVED_COLUMNS[name].needs))
        return self._raw(name, np.float64)

    def _raw(self, name: str, kind: type) -> NDArray[Any]:
        """Return a column of the table itself."""
        column: NDArray[Any] = np.ascontiguousarray(self.table[name], dtype=kind)
        return column if self.rows is None else column[self.rows]

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and all(column in self.table for column in list_raw_columns(name))

    def __iter__(self) -> Iterator[Any]:
        return iter(self.table)

    def __len__(self) -> int:
        return len(self.table)
