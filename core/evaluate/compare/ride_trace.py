"""Trace one ride window by window: measured energy, predicted energy, and where the two diverge.

After each window a model predicts the energy of the ride so far (`accumulate_windows`); the last of these values is its
prediction of the ride. The increment of each window is compared with the energy that the window measured.

The divergence is the span of windows that holds the most error beyond its share of the time. With errors e_k and
durations t_k of the windows, and totals E and T of the ride, it is the span of the largest sum of
sign(E) (e_k - E t_k / T). A steady error has no such span.
"""

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.errors import ModelError
from socast.core.evaluate.compare import ride_wind
from socast.core.evaluate.compare.records import Divergence, RideTrace, TracedModel, TracedRide, TraceWindows
from socast.core.evaluate.ride_filter import RIDE_NAME_COLUMNS
from socast.core.models import LinearModel
from socast.core.models.features import EFFECT_PREFIX
from socast.core.totals.tables import HISTOGRAM

LEAST_SHARE: Final = 0.5
"""Share of the ride's error that a span must hold to count as a divergence."""
MOST_TIME_SHARE: Final = 0.5
"""Largest share of the ride's time that a divergence may take."""
LEAST_WINDOWS: Final = 2
"""Windows that a trace needs."""
LEAST_SLOPE: Final = 0.5
"""Slope below which a road is called level. [%]"""
SUM_TOLERANCE: Final = (0.01, 0.02)
"""Absolute and relative difference above which a sum of windows is reported as different from the ride. [kWh], [1]"""
WINDOW_COLUMNS: Final = ("ride_key", "window", "duration_s", "distance_km", "energy_vi_kwh", "energy_soc_kwh")
"""Columns of the window table that a trace needs, in addition to those that models read."""
CONDITIONS: Final = (
    *("ambient_c", "gained_m", "lost_m", "stops", "wind_speed_kmh"),
    *("latitude_start_deg", "longitude_start_deg", "latitude_end_deg", "longitude_end_deg"),
)
"""Columns of the windows that a trace shows beside the energies."""
SUMS: Final = frozenset(
    {
        "duration_s",
        "distance_km",
        "gained_m",
        "lost_m",
        "gained_causal_m",
        "lost_causal_m",
        "stops",
        "samples",
        *HISTOGRAM,
    }
)
"""Columns that are summed over windows, in addition to the energies of effects."""
MEANS: Final = ("ambient_c", "precipitation_mm_h", "wind_speed_kmh")
"""Columns that are averaged over time."""
LAST: Final = frozenset(
    {
        "end_s",
        "soc_end_pct",
        "parked_s",
        "time_since_charge_s",
        "odometer_km",
        "occupants",
        "latitude_end_deg",
        "longitude_end_deg",
    }
)
"""Columns that hold the value of the last sample; all columns not listed are constant along a ride."""


def find_ride(rides: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return the ride of a name or an identifier, as a table of one row."""
    columns = [column for column in RIDE_NAME_COLUMNS if column in rides]
    if rides.empty or not columns:
        raise ModelError(f"ride {name!r} is not among {len(rides):,} rides: give tables or recordings that hold it")
    for column in columns:
        named = rides[rides[column].astype(str) == name]
        if len(named) == 1:
            return named.reset_index(drop=True)
        if len(named) > 1:
            keys = ", ".join(named[columns[0]].astype(str)[:5])
            raise ModelError(
                f"ride {name!r}: {len(named)} rides are named so: give the ride_key of one, such as {keys}"
            )
    known = pd.unique(pd.concat([rides[column].astype(str) for column in columns], ignore_index=True))
    close = get_close_matches(name, known.tolist(), n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}?" if close else f"names are such as {', '.join(known[:3])}"
    raise ModelError(f"ride {name!r} is not among {len(rides):,} rides: {hint}")


def trace_ride(ride: pd.DataFrame, windows: pd.DataFrame, models: Mapping[str, LinearModel]) -> RideTrace:
    """Return the measured energy of a ride and the predictions of models, window by window."""
    key = str(ride["ride_key"].iloc[0]) if "ride_key" in ride else ""
    if missing := [name for name in WINDOW_COLUMNS if name not in windows]:
        raise ModelError(f"column {missing[0]!r} is missing in the window table: make it again with `socast tables`")
    of_ride = windows[windows["ride_key"].astype(str) == key].sort_values("window", kind="stable", ignore_index=True)
    if not np.isfinite(ride["energy_kwh"].iloc[0]):
        raise ModelError(f"ride {key}: it has no measured energy to compare with: choose another ride")
    if len(of_ride) < LEAST_WINDOWS:
        raise ModelError(
            f"ride {key}: it has {len(of_ride)} windows, and a trace takes {LEAST_WINDOWS}: choose a longer ride"
        )
    notes: list[str] = []
    measured = _measure_windows(ride, of_ride, notes)
    columns = accumulate_windows(ride, of_ride)
    made = _describe_windows(of_ride, measured)
    traces = {label: _trace_model(label, model, ride, columns, of_ride, made, notes) for label, model in models.items()}
    windows_of_ride = {name: values.tolist() for name, values in made.items()}
    known = {name: ride[name].iloc[0] for name in TracedRide.__struct_fields__ if name in ride}
    described = TracedRide(**{name: value for name, value in known.items() if not pd.isna(value)})
    return RideTrace(ride=described, windows=TraceWindows(**windows_of_ride), models=traces, notes=notes)


def _measure_windows(ride: pd.DataFrame, of_ride: pd.DataFrame, notes: list[str]) -> Floats:
    """Return the measured energy of each window, from the ride's instrument and scaled to the ride's total.

    Windows without a measurement take the mean power of the others; the remainder to the ride's total is spread over
    time.
    """
    total = float(ride["energy_kwh"].iloc[0])
    by_power = "energy_vi_kwh" in ride and np.isclose(total, ride["energy_vi_kwh"].iloc[0])
    energy = of_ride["energy_vi_kwh" if by_power else "energy_soc_kwh"].to_numpy(np.float64)
    duration = of_ride["duration_s"].to_numpy(np.float64)
    if not by_power:
        notes.append("measured by the state of charge: in steps, so that a window's energy is coarse")
    known = np.isfinite(energy)
    if not known.any():
        raise ModelError("none of the windows of this ride has a measured energy: choose another ride")
    if not known.all():
        notes.append(f"{np.count_nonzero(~known)} of {len(known)} windows were not measured, and take the mean power")
        energy = np.where(known, energy, duration * (energy[known].sum() / duration[known].sum()))
    added = float(energy.sum())
    if _differ(added, total):
        notes.append(f"the windows add up to {added:.3f} kWh, and the ride's own figure is {total:.3f} kWh")
    return energy + (total - added) * duration / duration.sum()


def _differ(one: float, other: float) -> bool:
    """Return whether two energies differ by more than `SUM_TOLERANCE`."""
    absolute, relative = SUM_TOLERANCE
    return abs(one - other) > absolute + relative * abs(other)


def _describe_windows(of_ride: pd.DataFrame, measured: Floats) -> dict[str, Floats]:
    """Return time, position, measured energy and conditions of each window."""
    duration, distance = of_ride["duration_s"].to_numpy(np.float64), of_ride["distance_km"].to_numpy(np.float64)
    made = {
        "end_min": np.cumsum(duration) / 60.0,
        "end_km": np.cumsum(distance),
        "duration_s": duration,
        "distance_km": distance,
        "measured_kwh": measured,
    }
    for name in CONDITIONS:
        if name in of_ride:
            made[name] = of_ride[name].to_numpy(np.float64)
    if set(ride_wind.COLUMNS) <= set(of_ride):
        made["headwind_kmh"] = ride_wind.compute_window_headwind(of_ride)
    return made


def _trace_model(
    label: str,
    model: LinearModel,
    ride: pd.DataFrame,
    columns: pd.DataFrame,
    of_ride: pd.DataFrame,
    made: Mapping[str, Floats],
    notes: list[str],
) -> TracedModel:
    """Return the prediction of one model along a ride."""
    predicted, running = float(model.predict_energy(ride)[0]), model.predict_energy(columns)
    if not np.isfinite(predicted):
        car = ride["vehicle_model"].iloc[0]
        raise ModelError(f"model {label} has no prediction of this ride, of a {car}: give a model with a fit for it")
    if not np.isfinite(running).all() or _differ(float(running[-1]), predicted):
        raise ModelError(
            f"model {label} cannot be traced: its windows add up to {running[-1]:.3f} kWh, and it "
            f"predicts {predicted:.3f} kWh for the ride; make the tables again with `socast tables`"
        )
    of_ride = of_ride.assign(**{str(name): ride[name].iloc[0] for name in ride.columns if name not in of_ride})
    alone = float(model.predict_energy(of_ride).sum())
    if not np.isfinite(alone) or _differ(alone, predicted):
        notes.append(
            f"{label} is not a sum over windows: each window shows what it adds to the prediction of the ride so far; "
            f"{running[0]:+.3f} kWh are predicted before the first window"
        )
    added, said_by = np.diff(running), model.predict_parts(columns)
    error = added - made["measured_kwh"]
    place = locate_divergence(error, made, predicted - float(made["measured_kwh"].sum()))
    return TracedModel(
        predicted_kwh=predicted,
        error_kwh=predicted - float(ride["energy_kwh"].iloc[0]),
        start_kwh=float(running[0]),
        energy_kwh=added.tolist(),
        terms={name: np.diff(energy).tolist() for name, energy in said_by.items()},
        start_terms={name: float(energy[0]) for name, energy in said_by.items()},
        place=place,
        words=describe_divergence(place, error, made, float(running[0]), ride),
    )


def locate_divergence(error: Floats, made: Mapping[str, Floats], total: float) -> Divergence | None:
    """Return the span of windows that holds the most of a ride's error beyond its share of the time, None for none.

    Units: error [kWh], total [kWh].

    Examples
    --------
    >>> windows = {"duration_s": np.full(5, 60.0), "distance_km": np.ones(5)}
    >>> span = locate_divergence(np.array([0.0, 0.0, 0.3, 0.2, 0.0]), windows, 0.5)
    >>> span.first, span.last, span.minute, span.share
    (2, 3, 2.0, 1.0)
    """
    duration, distance = made["duration_s"], made["distance_km"]
    steady = total * duration / duration.sum()
    excess = np.concatenate([[0.0], np.cumsum(np.sign(total) * (error - steady))])
    lowest = np.minimum.accumulate(excess)
    last = int(np.argmax(excess - lowest))
    first = int(np.argmin(excess[: last + 1]))
    if total == 0.0 or last <= first:
        return None
    rows = slice(first, last)
    share, of_time = float(error[rows].sum()) / total, float(duration[rows].sum() / duration.sum())
    if share < LEAST_SHARE or of_time > MOST_TIME_SHARE:
        return None
    kilometres, seconds = float(distance[rows].sum()), float(duration[rows].sum())
    ambient, slope = None, None
    if "ambient_c" in made:
        ambient = float(np.average(made["ambient_c"][rows], weights=duration[rows]))
    if {"gained_m", "lost_m"} <= set(made) and kilometres > 0.0:
        slope = float(np.sum(made["gained_m"][rows] - made["lost_m"][rows])) / (10.0 * kilometres)
    return Divergence(
        first=first,
        last=last - 1,
        minute=float(duration[:first].sum()) / 60.0,
        km=float(distance[:first].sum()),
        minutes=seconds / 60.0,
        kilometres=kilometres,
        error_kwh=float(error[rows].sum()),
        share=share,
        share_of_time=of_time,
        speed_kmh=3600.0 * kilometres / seconds,
        ambient_c=ambient,
        uphill_pct=slope,
    )


def describe_divergence(
    place: Divergence | None, error: Floats, made: Mapping[str, Floats], start: float, ride: pd.DataFrame
) -> str:
    """Return a sentence on where prediction and measurement diverge, and whether the error exceeds the uncertainty.

    Units: error [kWh], start [kWh].
    """
    total = start + float(error.sum())
    side = "too much" if total > 0.0 else "too little"
    if place is None:
        minutes = float(made["end_min"][-1])
        sentence = f"{abs(total):.3f} kWh {side}, spread over {minutes:.1f} min: no part of the ride stands out"
    else:
        where = f"{place.kilometres:.1f} km and {place.minutes:.1f} min after it, {_describe_conditions(place)}"
        sentence = f"diverges from the measurement at {place.minute:.1f} min, {place.km:.1f} km: "
        if place.share > 1.0:
            sentence += (
                f"it predicts {abs(place.error_kwh):.3f} kWh {side} in the {where}; "
                f"the rest of the ride compensates {abs(place.error_kwh) - abs(total):.3f} kWh"
            )
        else:
            sentence += f"{abs(place.error_kwh):.3f} of {abs(total):.3f} kWh {side} come in the {where}"
    if abs(start) > LEAST_SHARE * abs(total) and start * total > 0.0:
        sentence += f"; {abs(start):.3f} kWh of it are predicted before the start"
    sd = float(ride["energy_sd_kwh"].iloc[0]) if "energy_sd_kwh" in ride else np.nan
    if abs(total) < 2.0 * sd:
        sentence += f"; this is within twice the standard uncertainty of the measurement, {sd:.3f} kWh"
    return sentence


def _describe_conditions(place: Divergence) -> str:
    """Return the conditions of a span, in words."""
    conditions = [f"{place.speed_kmh:.0f} km/h"]
    if place.ambient_c is not None:
        conditions.insert(0, f"at {place.ambient_c:.0f} °C".replace("-", "\N{MINUS SIGN}"))
    slope = place.uphill_pct or 0.0
    if abs(slope) >= LEAST_SLOPE:
        conditions.append(f"{abs(slope):.0f} % {'uphill' if slope > 0.0 else 'downhill'}")
    return ", ".join(conditions)


def accumulate_windows(ride: pd.DataFrame, windows: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of a ride at its beginning and after each of its windows, as a forecast in mid-ride has them.

    Returns
    -------
    (n + 1, columns) DataFrame
        Columns of the ride table that a model may read. In the first row nothing has been driven; its means are those
        of the first window.
    """
    n = len(windows)
    changing = LAST | {*MEANS, "wind_from_deg", "average_speed_kmh"}
    constant = [name for name in ride.columns if name not in changing and not _adds_up(name)]
    made: dict[str, object] = {name: np.full(n + 1, ride[name].iloc[0]) for name in constant}
    for name in windows.columns:
        if _adds_up(name):
            made[str(name)] = _accumulate(windows[name].to_numpy(np.float64))
        elif name in LAST:
            made[str(name)] = _repeat_first(windows[name].to_numpy(np.float64))
    weight = windows["duration_s"].to_numpy(np.float64)
    for name in (name for name in MEANS if name in windows):
        made[name] = _average(windows[name].to_numpy(np.float64), weight)
    if {"wind_from_deg", "wind_speed_kmh"} <= set(windows.columns):
        made["wind_from_deg"] = _compute_direction(windows, weight)
    distance, duration = _accumulate(windows["distance_km"].to_numpy(np.float64)), _accumulate(weight)
    made["average_speed_kmh"] = _repeat_first(3600.0 * _divide(distance[1:], duration[1:]))
    return pd.DataFrame(made)


def _adds_up(name: str) -> bool:
    """Return whether a column is summed over windows."""
    return name in SUMS or name.startswith(EFFECT_PREFIX)


def _accumulate(values: Floats) -> Floats:
    """Return running sums, from 0."""
    return np.concatenate([[0.0], np.cumsum(values)])


def _repeat_first(values: Floats) -> Floats:
    """Return values with the first one repeated."""
    return np.concatenate([values[:1], values])


def _average(values: Floats, weight: Floats) -> Floats:
    """Return running means of the known values."""
    known = ~np.isnan(values)
    sums = np.cumsum(np.where(known, values, 0.0) * weight)
    return _repeat_first(_divide(sums, np.cumsum(weight * known)))


def _compute_direction(windows: pd.DataFrame, weight: Floats) -> Floats:
    """Return the running direction of the mean wind. [degree]"""
    angle = np.radians(windows["wind_from_deg"].to_numpy(np.float64))
    speed = windows["wind_speed_kmh"].to_numpy(np.float64)
    north, east = (_average(speed * turned, weight) for turned in (np.cos(angle), np.sin(angle)))
    return np.degrees(np.arctan2(east, north)) % 360.0


def _divide(above: Floats, below: Floats) -> Floats:
    """Return a quotient; NaN where the divisor is not positive."""
    return np.divide(above, below, out=np.full(len(above), np.nan), where=below > 0.0)
