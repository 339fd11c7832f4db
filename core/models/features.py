"""Columns that a model may read of a ride, with units. Every column has a meaning during a ride, too.

Columns of the ride table have the same names as there. Columns that hold the answer (`energy_*`, `soc_end_pct`,
`hvac_kwh`) are not features. Derived columns are computed from others on access, so that no table needs to hold them.
So are scopes, which are 1 for one vehicle (`vehicle=taxi-003`) or from a date on (`since=2018-06-01`), and 0 otherwise.
A term with a scope in its product applies only there.
"""

from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, date, datetime
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core import effects
from socast.core.batch import Floats, Table
from socast.core.columns import ZERO_CELSIUS
from socast.core.errors import ModelError
from socast.core.models.derived_features import DERIVED_COLUMNS
from socast.core.vehicles import AccessoryCurve

EFFECT_PREFIX: Final = "effect_"
ACCESSORIES_COLUMN: Final = "accessories_kwh"
"""Energy of climate control and all else on board by a model's own curve. Unlike other columns, it needs a curve. [kWh]
"""
VEHICLE_SCOPE: Final = "vehicle="
"""Prefix of a column that is 1 for one vehicle; the vehicle's identity follows."""
SINCE_SCOPE: Final = "since="
"""Prefix of a column that is 1 from a date on; the ISO date follows, counted from midnight UTC."""
ANSWERS: Final = ("energy_", "soc_end_pct", "hvac_kwh")
"""Prefixes of the columns that hold what a model is to predict."""

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
"""Unit of each ride-table column that a term may read, besides `effect_*`; for temperatures, the unit of a difference.
"""


ACCESSORY_NEEDS: Final = ("duration_s", "ambient_c", "accessory_scale")
"""Columns from which the accessory energy is computed."""


def is_scope(column: str) -> bool:
    """Return whether a column is a scope: 1 where a term applies, and 0 elsewhere."""
    return column.startswith((VEHICLE_SCOPE, SINCE_SCOPE))


def list_scope(columns: Iterable[str]) -> list[str]:
    """Return the scope of a term: those of its columns that limit it, such as `vehicle=taxi-003`."""
    return [column for column in columns if is_scope(column)]


def parse_since(column: str) -> float:
    """Return the time from which a scope `since=DATE` is 1, as Unix time. [s]

    Raises
    ------
    ModelError
        Where the scope does not name a date.

    Examples
    --------
    >>> parse_since("since=2018-06-01")
    1527811200.0
    """
    text = column.removeprefix(SINCE_SCOPE)
    try:
        day = date.fromisoformat(text)
    except ValueError as error:
        raise ModelError(f"scope {column!r}: {text!r} is not a date ({error}): write since=YYYY-MM-DD") from error
    if day.isoformat() != text:
        raise ModelError(f"scope {column!r}: write the date as since={day.isoformat()}")
    return datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()


def list_raw_columns(column: str) -> tuple[str, ...]:
    """Return the columns of the ride table from which a column is computed: itself, unless it is derived.

    Examples
    --------
    >>> list_raw_columns("wind_from_east")
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
        Where no model may read the column: it is unknown, or holds the answer.
    EffectError
        Where it belongs to an unknown effect.
    """
    if column == ACCESSORIES_COLUMN:
        return "kWh"
    if column.startswith(EFFECT_PREFIX):
        declared = effects.get(column.removeprefix(EFFECT_PREFIX)).unit
        return "kWh" if declared == "1" else f"(kWh/({declared}))"
    if column.startswith(SINCE_SCOPE):
        parse_since(column)
        return "1"
    if column.startswith(VEHICLE_SCOPE):
        if not column.removeprefix(VEHICLE_SCOPE).strip():
            raise ModelError(f"scope {column!r} names no vehicle: write vehicle=ID, with an ID of the ride table")
        return "1"
    if column in DERIVED_COLUMNS:
        return DERIVED_COLUMNS[column].unit
    if column in FEATURES:
        return FEATURES[column]
    if column.startswith(ANSWERS):
        raise ModelError(f"column {column!r} holds what is to be predicted: remove it from the model")
    raise ModelError(f"column {column!r} is not one that a model can read: name an effect_* or a ride-table column")


def derive_coefficient_unit(columns: tuple[str, ...]) -> str:
    """Return the unit, as pint spells it, of the coefficient that makes a product of columns an energy in kWh.

    Examples
    --------
    >>> derive_coefficient_unit(("effect_aero_drag", "drag_area_m2"))
    '1'
    >>> derive_coefficient_unit(("effect_rolling", "odometer_km"))
    '1/km'
    >>> derive_coefficient_unit(()), derive_coefficient_unit(("average_speed_kmh", "lost_m"))
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
    """Provide columns of some rides to a fit: unknown values filled, derived columns computed on access.

    Parameters
    ----------
    table : mapping of str to (n,) array
        Columns of the ride table, or a `DataFrame`.
    fills : mapping of str to float
        Value that replaces unknown (NaN) values of a column, derived ones included; a column without an entry keeps
        NaN.
    curve : AccessoryCurve, optional
        Accessory power for `accessories_kwh`.
    rows : (m,) int, optional
        Rows to provide; all, where not given.
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
        """Return a column as (m,) float, NaN where it is unknown and has no fill."""
        column = self._made.get(name)
        if column is None:
            column = self._make(name)
            fill = self.fills.get(name)
            if fill is not None:
                column = np.where(np.isnan(column), fill, column)
            self._made[name] = column
        return column

    def _make(self, name: str) -> Floats:
        """Return a column of the table, or compute it from others."""
        if name == ACCESSORIES_COLUMN:
            if self.curve is None:
                raise ModelError(
                    f"{ACCESSORIES_COLUMN} needs an accessory curve, and this fit has none: fit the model again"
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
