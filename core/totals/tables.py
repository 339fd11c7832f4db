"""Build the ride table and the window table: totals with the names and units that people read.

The same function derives the physical columns of both tables from `socast.core.totals.accumulator.Totals`. The ride
table has every term of the paper's Table 1. `model_columns` builds only the columns that a model reads (`effect_*` and
the parameters of the car), for forecasts.
"""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.cleaning.quality import CAUSES
from socast.core.columns import JOULES_PER_KWH, KMH, SECONDS_PER_DAY, SPEED_BINS, WINDOW_COLUMNS, ZERO_CELSIUS
from socast.core.totals.accumulator import AMOUNTS, Totals
from socast.core.totals.context import RunContext
from socast.core.totals.distance_witnesses import find_contradicted_distance
from socast.core.totals.measured_energy import (
    SOURCES,
    MeasuredEnergy,
    compute_soc_energy_noise,
    find_lost_time,
    find_usable_capacity,
    list_energy_faults,
    measure_by_power,
    measure_by_soc,
    measure_energy,
)
from socast.core.vehicles.fleet import Cars

CUT: Final = 0.1
"""Largest share of its duration that a ride fit for training may lack at its beginning and end. [1]"""
MOST_REJECTED: Final = 0.5
"""Largest share of its duration for which the speed of a ride fit for training may be rejected or missing. [1]

Beyond one half, more of the speed profile is inferred than measured.
"""
MOST_BRIDGED: Final = 0.5
"""Largest share of its distance that may be bridged in a ride fit for training. [1]"""
MOST_UNMEASURED: Final = 0.03
"""Largest time of bridged driving that no sample covers, over the duration of a ride fit for training. [1]

The work of a bridge counts in full, and the meters saw only the time that the logger recorded."""
MOST_MISTIMED: Final = 0.02
"""Largest time by which steps of a ride fit for training turned out to be wrong, over its duration. [1]"""
WINTER: Final = ((12, 15), (3, 15))
"""First and last (month, day) of the season with mandatory winter tyres, after Table 1 of the paper."""

HISTOGRAM: Final = tuple(column.name for column in WINDOW_COLUMNS if column.name.startswith("speed_"))
"""Columns of the distance driven in each speed bin; the last one holds all faster driving."""


def model_columns(totals: Totals, context: RunContext, needs: Sequence[str] = ()) -> dict[str, Any]:
    """Return the columns that a model reads, of rides that have ended or are in progress.

    Parameters
    ----------
    needs : sequence of str
        Columns of the ride table that the model reads in addition to energies of effects and parameters of cars.

    Returns
    -------
    dict of str to (n,) array
        Energies of the effects [kWh per unit of coefficient] and parameters of the cars. If `needs` names any other
        column, the result also holds all other columns of the ride table that are known during a ride.
    """
    first, cars = len(AMOUNTS), context.cars
    effects = enumerate(context.effects)
    columns = {f"effect_{name}": totals.amounts[:, first + i] / JOULES_PER_KWH for i, name in effects}
    kinds = totals.kinds
    columns |= cars.parameters_of(kinds)._asdict()
    if all(name in columns for name in needs):
        return columns
    winter = is_winter(totals.at_first("time"))
    texts: dict[str, Any] = {
        "winter": winter,
        "summer": 1 - winter,
        "vehicle_model": np.array([cars.name(kind) for kind in kinds.tolist()], dtype=object),
    }
    if "vehicle_id" in needs:
        texts["vehicle_id"] = np.array([context.vehicle_ids[lane] for lane in totals.lane.tolist()], dtype=object)
    return columns | _physical(totals, measure_energy(totals, cars), cars) | texts


def has_unsettled_clock(totals: Totals) -> NDArray[np.bool_]:
    """Return whether the clock was not yet understood, or alternated, in each ride or idle period."""
    return np.asarray(totals.amount("mistimed") > MOST_MISTIMED * totals.amount("duration"))


def unfit_reason(totals: Totals, context: RunContext) -> NDArray[np.object_]:
    """Return why each ride is unfit for training.

    Notes
    -----
    The rules for duration and distance follow section 3 of the paper. Beyond the paper, a ride is unfit if gaps at its
    beginning and end hide more than a tenth of its duration, if its energy cannot be measured, if voltage and current
    contradict a healthy state of charge, if its speed was rejected (or missing) for more than `MOST_REJECTED` of its
    duration, or if more than `MOST_BRIDGED` of its distance was bridged. The same holds where the car charged within
    the ride, where its clock was not yet understood, and where its meters did not see the time of a bridge.
    """
    cars, settings = context.cars, context.settings
    duration = totals.amount("duration")
    rejected = totals.share("speed_rejected")
    reason = np.full(len(duration), None, dtype=object)
    for why, applies in (  # later reasons overwrite earlier ones
        ("cut_by_gap", find_lost_time(totals) > CUT * duration),
        *list_energy_faults(totals, cars),
        ("speed_contradicted", find_contradicted_distance(totals)),
        ("charged", totals.at_last("since_charge") < 0.999 * duration - 1.0),
        ("bridge_unmeasured", totals.amount("unseen") > MOST_UNMEASURED * duration),
        ("clock_unsettled", has_unsettled_clock(totals)),
        ("too_little_distance", totals.amount("distance") < settings.least_distance),
        ("distance_bridged", totals.share("bridged", "distance") > MOST_BRIDGED),
        ("speed_missing", rejected + totals.share("speed_missing") > MOST_REJECTED),
        ("speed_rejected", rejected > MOST_REJECTED),
        ("too_short", duration < settings.shortest_ride),
        ("too_long", duration > settings.longest_ride),
    ):
        reason[applies] = why
    return reason


def is_winter(time: Floats) -> NDArray[np.int64]:
    """Return 1 from 15 December to 15 March, else 0.

    Parameters
    ----------
    time : (n,) float
        Unix time; an unknown time (NaN) gives 0. [s]

    Examples
    --------
    >>> is_winter(np.array([1705276800.0, 1719792000.0])).tolist()
    [1, 0]
    """
    known = np.isfinite(time)
    date = np.floor(np.where(known, time, 0.0) / SECONDS_PER_DAY).astype("datetime64[D]")
    month = date.astype("datetime64[M]")
    day = (month.astype(np.int64) % 12 + 1) * 100 + (date - month).astype(np.int64) + 1
    (first_month, first_day), (last_month, last_day) = WINTER
    winter = (day >= first_month * 100 + first_day) | (day <= last_month * 100 + last_day)
    return (winter & known).astype(np.int64)


def _physical(totals: Totals, measured: MeasuredEnergy, cars: Cars) -> dict[str, Floats]:
    """Return the columns that rides and windows share, without effects and parameters of cars."""
    energy_vi, energy_vi_sd = measure_by_power(totals, cars)
    energy_soc, energy_soc_sd = measure_by_soc(totals)
    capacity, capacity_sd = find_usable_capacity(totals)
    mean = partial(totals.share, otherwise=np.nan)
    speed = mean("distance")
    direction = np.degrees(np.arctan2(mean("wind_east"), mean("wind_north"))) % 360.0
    windy = (totals.amount("wind_north") != 0.0) | (totals.amount("wind_east") != 0.0)
    columns = {
        "start_s": totals.at_first("time"),
        "end_s": totals.at_last("time"),
        "duration_s": totals.amount("duration"),
        "standing_s": totals.amount("standing"),
        "distance_km": totals.amount("distance") * 1e-3,
        "average_speed_kmh": speed / KMH,
        "gained_m": totals.amount("gained"),
        "lost_m": totals.amount("lost"),
        "gained_causal_m": totals.amount("gained_causal"),
        "lost_causal_m": totals.amount("lost_causal"),
        "ambient_c": mean("ambient") - ZERO_CELSIUS,
        "wind_speed_kmh": mean("wind", "wind_known") / KMH,
        "wind_from_deg": np.where(windy, direction, np.nan),
        "precipitation_mm_h": mean("precipitation") * 3.6e6,
        "hvac_kwh": np.where(totals.amount("hvac_known") > 0.0, totals.amount("hvac") / JOULES_PER_KWH, np.nan),
        "stops": totals.amount("stops"),
        "unresolved_braking_kwh": totals.amount("unresolved_braking") / JOULES_PER_KWH,
        "samples": totals.amount("samples"),
        "rejected_speed_share": totals.share("speed_rejected"),
        "missing_speed_share": totals.share("speed_missing"),
        "bridged_distance_share": totals.share("bridged", "distance"),
        "soc_start_pct": totals.at_first("soc") * 100.0,
        "soc_end_pct": totals.at_last("soc") * 100.0,
        "battery_temperature_c": totals.at_first("battery_temperature") - ZERO_CELSIUS,
        "elapsed_s": totals.at_first("elapsed"),
        "parked_s": totals.at_last("parked"),
        "time_since_charge_s": totals.at_last("since_charge"),
        "odometer_km": totals.at_last("odometer") * 1e-3,
        "occupants": totals.at_last("occupants"),
        "latitude_start_deg": np.degrees(totals.at_first("latitude")),
        "longitude_start_deg": np.degrees(totals.at_first("longitude")),
        "latitude_end_deg": np.degrees(totals.at_last("latitude")),
        "longitude_end_deg": np.degrees(totals.at_last("longitude")),
        "energy_vi_kwh": energy_vi,
        "energy_vi_sd_kwh": energy_vi_sd,
        "energy_soc_kwh": energy_soc,
        "energy_soc_sd_kwh": energy_soc_sd,
        "energy_soc_noise_kwh": compute_soc_energy_noise(totals),
        "energy_kwh": measured.energy,
        "energy_sd_kwh": measured.sd,
        "usable_capacity_kwh": capacity,
        "usable_capacity_sd_kwh": capacity_sd,
    }
    histogram = totals.amounts[:, -SPEED_BINS:] * 1e-3
    return columns | {name: histogram[:, i] for i, name in enumerate(HISTOGRAM)}


def tabulate_windows(totals: Totals, context: RunContext) -> pd.DataFrame:
    """Return the window table, with one row per window."""
    kinds = totals.kinds
    measured = measure_energy(totals, context.cars)
    own = {
        "ride_key": text(_ride_keys(totals, context.vehicle_ids)),
        "window": totals.window,
        "vehicle_id": _named(totals.lane, context.vehicle_ids.__getitem__),
        "vehicle_model": _named(kinds, context.cars.name),
        "energy_source": _named(measured.source, SOURCES.__getitem__),
    }
    edges = {"power_start_w": totals.at_first("power"), "power_end_w": totals.at_last("power")}
    return pd.DataFrame(own | edges | _physical(totals, measured, context.cars) | model_columns(totals, context))


def tabulate_rides(
    totals: Totals,
    ride_names: Sequence[str | None],
    drivers: Sequence[str | None],
    context: RunContext,
) -> pd.DataFrame:
    """Return the ride table, with one row per ride and every term of the paper's Table 1.

    Parameters
    ----------
    ride_names : sequence of n (str or None)
        Names that the logger gave. A ride without a name gets the name of its vehicle and its ordinal.
    """
    measured = measure_energy(totals, context.cars)
    physical = _physical(totals, measured, context.cars)
    kinds = totals.kinds
    keys = _ride_keys(totals, context.vehicle_ids)
    start = physical["start_s"]
    winter = is_winter(start)
    reason = unfit_reason(totals, context)
    quality = {f"quality_{cause}": totals.quality[:, i].astype(np.int64) for i, cause in enumerate(CAUSES)}
    vehicle_ids = [context.vehicle_ids[lane] for lane in totals.lane.tolist()]
    own = {
        "ride_id": text([name or key for name, key in zip(ride_names, keys, strict=True)]),
        "ride_key": text(keys),
        "vehicle_id": text(vehicle_ids),
        "vehicle_model": _named(kinds, context.cars.name),
        "energy_source": _named(measured.source, SOURCES.__getitem__),
        "driver_id": text(drivers),
        "date": text([_date(time) for time in start]),
        "winter": winter,
        "summer": 1 - winter,
        "fit_for_training": np.array([why is None for why in reason], np.bool_),
        "unfit_reason": text(reason.tolist()),
    }
    return pd.DataFrame(own | physical | model_columns(totals, context) | quality)


def text(values: Sequence[str | None]) -> pd.Series:
    """Return a column of text that has the same type even if all values are unknown."""
    return pd.Series(list(values), dtype="str")


def _named(codes: NDArray[np.int64], name: Callable[[int], str | None]) -> pd.Series:
    """Return a column of the names of codes."""
    return text([name(code) for code in codes.tolist()])


def _ride_keys(totals: Totals, names: Sequence[str]) -> list[str]:
    """Return a key of each ride that is unique in a recording: the name of its vehicle and its ordinal there."""
    return [f"{names[lane]}#{ride}" for lane, ride in zip(totals.lane.tolist(), totals.ride.tolist(), strict=True)]


def _date(time: float) -> str:
    """Return the UTC date of a Unix time in ISO 8601 format."""
    return datetime.fromtimestamp(time, UTC).date().isoformat()
