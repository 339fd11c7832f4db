"""Forecasts of the charge, and the shifts that they were made of, with the names and units that people read."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from core.batch import Floats, Ints
from core.columns import ZERO_CELSIUS
from core.forecast.engine import Rows
from core.totals.accumulator import Totals
from core.totals.context import RunContext
from core.totals.tables import text


class Told(NamedTuple):
    """Forecasts that were made: of which lane and kind of car, when [s], and what was told."""

    lane: Ints
    kind: Ints
    time: Floats
    rows: Rows

    @classmethod
    def of(cls, running: Totals, rows: Rows) -> "Told":
        """Return what was told at running totals."""
        return cls(running.lane, running.at_last("kind").astype(np.int64), running.at_last("time"), rows)


def outlook_table(parts: Sequence[Told], context: RunContext) -> pd.DataFrame:
    """Return a row a forecast of the charge at a shift's end.

    Columns: `vehicle_id`, `vehicle_model`, `time_s`, `shift` (its ordinal), `shift_begin_s`, `shift_end_s` (as planned,
    or as the car's shifts go), `planned`, `soc_pct` (filtered), `soc_mean_pct`, `soc_p05_pct`, `soc_p95_pct` (at the
    end; NaN where not known), `reserve_soc_pct`, `reserve_risk`, `ahead_km`, `ambient_c`, `soc_begin_pct`, `shift_km`.
    """
    names, cars = context.vehicle_ids, context.cars
    lane = np.concatenate([part.lane for part in parts]) if parts else np.zeros(0, np.int64)
    kind = np.concatenate([part.kind for part in parts]) if parts else np.zeros(0, np.int64)
    time = np.concatenate([part.time for part in parts]) if parts else np.zeros(0)
    rows = Rows.joined([part.rows for part in parts])
    return pd.DataFrame(
        {
            "vehicle_id": text([names[i] for i in lane.tolist()]),
            "vehicle_model": text([cars.name(i) for i in kind.tolist()]),
            "time_s": time,
            "shift": rows.at("shift").astype(np.int64),
            "shift_begin_s": rows.at("begin"),
            "shift_end_s": rows.at("end"),
            "planned": rows.at("kind") == 0.0,
            "soc_pct": 100.0 * rows.at("soc"),
            "soc_mean_pct": 100.0 * rows.at("mean"),
            "soc_p05_pct": 100.0 * rows.at("p05"),
            "soc_p95_pct": 100.0 * rows.at("p95"),
            "reserve_soc_pct": 100.0 * rows.at("reserve"),
            "reserve_risk": rows.at("risk"),
            "ahead_km": rows.at("ahead_km"),
            "ambient_c": rows.at("ambient"),
            "soc_begin_pct": 100.0 * rows.at("begin_soc"),
            "shift_km": rows.at("distance") / 1000.0,
        }
    )


def shift_table(shifts: NDArray[np.void], context: RunContext) -> pd.DataFrame:
    """Return a row a shift that has ended.

    Columns: `vehicle_id`, `vehicle_model`, `shift`, `begin_s`, `end_s` (of its last sample), `soc_begin_pct`,
    `soc_end_pct`, `soc_lowest_pct` (as reported, while it did not charge), `distance_km`, `ride_km`, `charged_s` (last
    time at which it charged after it had set out, NaN for never), `ambient_c`, `capacity_kwh` (nominal usable).
    """
    names, cars = context.vehicle_ids, context.cars
    lane = shifts["lane"].astype(np.int64)
    kinds = cars.of_lane[lane]
    hours = shifts["hours"]
    warm = np.divide(shifts["warmth"], hours, out=np.full(len(hours), np.nan), where=hours > 0.0)
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
            "ambient_c": warm - ZERO_CELSIUS,
            "capacity_kwh": cars.capacity[kinds],
        }
    )
