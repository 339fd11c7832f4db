"""Tables of the forecasts of the charge, and of the shifts that they were for, with names and units for people."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.conformal import BY_HISTORY, OVER_CHARGE
from socast.core.forecast.forecast_rows import ForecastRows
from socast.core.totals.accumulator import Totals
from socast.core.totals.context import RunContext
from socast.core.totals.tables import text


class PublishedForecasts(NamedTuple):
    """Hold the forecasts of n rows, with the lane, the kind of car and the time [s] of each."""

    lane: Ints
    kind: Ints
    time: Floats
    rows: ForecastRows

    @classmethod
    def create(cls, running: Totals, rows: ForecastRows) -> "PublishedForecasts":
        """Return the forecasts at running totals."""
        return cls(running.lane, running.at_last("kind").astype(np.int64), running.at_last("time"), rows)


def tabulate_outlooks(parts: Sequence[PublishedForecasts], context: RunContext) -> pd.DataFrame:
    """Return a table with one row per forecast of the charge at the end of a shift.

    Returns
    -------
    DataFrame
        Columns: `vehicle_id`, `vehicle_model`, `time_s`, `shift` (its ordinal), `shift_begin_s`, `shift_end_s` (as
        planned, or by the car's usual shifts), `planned`, `soc_pct` (filtered), `soc_mean_pct`, `soc_p05_pct`,
        `soc_p95_pct` (at the end; NaN where unknown), `reserve_soc_pct`, `reserve_risk`, `ahead_km`, `ambient_c`,
        `soc_begin_pct`, `shift_km`; `charge_s`, `charge_soc_mean_pct`, `charge_soc_p05_pct`, `charge_soc_p95_pct`,
        `charge_risk` and `charge_km` of the next planned charge, NaN without one; `charge_planned`, whether one is
        ahead or under way, and `charge_to_pct` up to which the last one is planned; `arrived_s` and `arrival_soc_pct`,
        begin of the last charge in the shift and reading before it.
    """
    names, cars = context.vehicle_ids, context.cars
    lane = np.concatenate([part.lane for part in parts]) if parts else np.zeros(0, np.int64)
    kind = np.concatenate([part.kind for part in parts]) if parts else np.zeros(0, np.int64)
    time = np.concatenate([part.time for part in parts]) if parts else np.zeros(0)
    rows = ForecastRows.join([part.rows for part in parts])
    return pd.DataFrame(
        {
            "vehicle_id": text([names[i] for i in lane.tolist()]),
            "vehicle_model": text([cars.name(i) for i in kind.tolist()]),
            "time_s": time,
            "shift": rows.shift.astype(np.int64),
            "shift_begin_s": rows.begin,
            "shift_end_s": rows.shift_end_s,
            "planned": rows.basis != BY_HISTORY,
            "soc_pct": 100.0 * rows.soc,
            "soc_mean_pct": 100.0 * rows.soc_end_of_shift,
            "soc_p05_pct": 100.0 * rows.soc_end_of_shift_p05,
            "soc_p95_pct": 100.0 * rows.soc_end_of_shift_p95,
            "reserve_soc_pct": 100.0 * rows.reserve,
            "reserve_risk": rows.reserve_risk,
            "ahead_km": rows.ride_km_ahead,
            "ambient_c": rows.ambient_c,
            "soc_begin_pct": 100.0 * rows.begin_soc,
            "shift_km": rows.distance / 1000.0,
            "charge_s": rows.charge_time,
            "charge_soc_mean_pct": 100.0 * rows.charge_soc,
            "charge_soc_p05_pct": 100.0 * rows.charge_soc_p05,
            "charge_soc_p95_pct": 100.0 * rows.charge_soc_p95,
            "charge_risk": rows.charge_risk,
            "charge_km": rows.charge_km,
            "charge_planned": rows.basis == OVER_CHARGE,
            "charge_to_pct": 100.0 * rows.charge_to,
            "arrived_s": rows.arrived,
            "arrival_soc_pct": 100.0 * rows.arrival_soc,
        }
    )


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
    names, cars = context.vehicle_ids, context.cars
    lane = shifts["lane"]
    kinds = cars.of_lane[lane]
    hours = shifts["hours"]
    ambient = np.divide(shifts["warmth"], hours, out=np.full(len(hours), np.nan), where=hours > 0.0)
    return pd.DataFrame(
        {
            "vehicle_id": text([names[i] for i in lane.tolist()]),
            "vehicle_model": text([cars.name(i) for i in kinds.tolist()]),
            "shift": shifts["shift"].astype(np.int64),
            "begin_s": shifts["begin"],
            "end_s": shifts["end"],
            "soc_begin_pct": 100.0 * shifts["begin_soc"],
            "soc_end_pct": 100.0 * shifts["last_soc"],
            "soc_lowest_pct": 100.0 * shifts["lowest_soc"],
            "distance_km": shifts["distance"] / 1000.0,
            "ride_km": shifts["ride_distance"] / 1000.0,
            "charged_s": shifts["charged"],
            "ambient_c": ambient - ZERO_CELSIUS,
            "capacity_kwh": cars.capacity[kinds],
        }
    )
