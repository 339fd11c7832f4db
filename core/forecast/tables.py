"""Tables of the forecasts of the charge, and of the shifts that they were for, with names and units for people."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Ints
from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.conformal import BY_HISTORY, OVER_CHARGE
from socast.core.forecast.forecast_rows import Rows, join_rows
from socast.core.totals.context import RunContext
from socast.core.totals.tables import text

_OUTLOOKS: Final = {
    "time_s": "time",
    "shift": "shift",
    "shift_begin_s": "begin",
    "shift_end_s": "shift_end_s",
    "planned": "basis",
    "soc_pct": "soc",
    "soc_mean_pct": "soc_end_of_shift",
    "soc_p05_pct": "soc_end_of_shift_p05",
    "soc_p95_pct": "soc_end_of_shift_p95",
    "reserve_soc_pct": "reserve",
    "reserve_risk": "reserve_risk",
    "ahead_km": "ride_km_ahead",
    "ambient_c": "ambient_c",
    "soc_begin_pct": "begin_soc",
    "shift_km": "distance",
    "charge_s": "charge_time",
    "charge_soc_mean_pct": "charge_soc",
    "charge_soc_p05_pct": "charge_soc_p05",
    "charge_soc_p95_pct": "charge_soc_p95",
    "charge_risk": "charge_risk",
    "charge_km": "charge_km",
    "charge_planned": "basis",
    "charge_to_pct": "charge_to",
    "arrived_s": "arrived",
    "arrival_soc_pct": "arrival_soc",
}
"""Column of the table of forecasts -> column of `FORECAST_ROW`."""
_SHIFTS: Final = {
    "shift": "shift",
    "begin_s": "begin",
    "end_s": "end",
    "soc_begin_pct": "begin_soc",
    "soc_end_pct": "last_soc",
    "soc_lowest_pct": "lowest_soc",
    "distance_km": "distance",
    "ride_km": "ride_distance",
    "charged_s": "charged",
}
"""Column of the table of shifts -> field of `CLOSED_SHIFT`."""


def tabulate_outlooks(parts: Sequence[Rows], context: RunContext) -> pd.DataFrame:
    """Return a table with one row per forecast of the charge at the end of a shift.

    Returns
    -------
    DataFrame
        Columns: `vehicle_id`, `vehicle_model`, `time_s`, `shift` (its ordinal), `shift_begin_s`, `shift_end_s` (as
        planned, or as expected of earlier shifts), `planned`, `soc_pct` (filtered), `soc_mean_pct`, `soc_p05_pct`,
        `soc_p95_pct` (at the end; NaN where unknown), `reserve_soc_pct`, `reserve_risk`, `ahead_km`, `ambient_c`,
        `soc_begin_pct`, `shift_km`; `charge_s`, `charge_soc_mean_pct`, `charge_soc_p05_pct`, `charge_soc_p95_pct`,
        `charge_risk` and `charge_km` of the next planned charge, NaN without one; `charge_planned`, whether one is
        ahead or under way, and `charge_to_pct` up to which the last one is planned; `arrived_s` and `arrival_soc_pct`,
        begin of the last charge in the shift and reading before it.
    """
    rows = join_rows(parts)
    of_basis = {"planned": rows["basis"] != BY_HISTORY, "charge_planned": rows["basis"] == OVER_CHARGE}
    return pd.DataFrame(_list_columns(rows, rows["kind"], _OUTLOOKS, context) | of_basis)


def tabulate_shifts(shifts: NDArray[np.void], context: RunContext) -> pd.DataFrame:
    """Return a table with one row per shift that has ended.

    Returns
    -------
    DataFrame
        Columns: `vehicle_id`, `vehicle_model`, `shift`, `begin_s`, `end_s` (of its last sample), `soc_begin_pct`,
        `soc_end_pct`, `soc_lowest_pct` (as reported, while it did not charge), `distance_km`, `ride_km`, `charged_s`
        (last time at which it charged after its departure, NaN for never), `ambient_c`, `capacity_kwh` (nominal
        usable).
    """
    kinds, hours = context.cars.of_lane[shifts["lane"]], shifts["hours"]
    ambient = np.divide(shifts["warmth"], hours, out=np.full(len(hours), np.nan), where=hours > 0.0)
    return pd.DataFrame(
        _list_columns(shifts, kinds, _SHIFTS, context)
        | {"ambient_c": ambient - ZERO_CELSIUS, "capacity_kwh": context.cars.capacity[kinds]}
    )


def _list_columns(rows: NDArray[np.void], kinds: Ints, columns: dict[str, str], context: RunContext) -> dict[str, Any]:
    """Return the columns of a table: what cars they are, and fields of rows in per cent and kilometres."""
    table: dict[str, Any] = {
        "vehicle_id": text([context.vehicle_ids[lane] for lane in rows["lane"].tolist()]),
        "vehicle_model": text([context.cars.name(kind) for kind in kinds.tolist()]),
    }
    for column, field in columns.items():
        values = 100.0 * rows[field] if column.endswith("_pct") else rows[field]
        table[column] = values / 1000.0 if field.endswith("distance") else values
    return table | {"shift": rows["shift"].astype(np.int64)}
