"""A ride so far: its columns after each of its windows, as a forecast in mid-ride has them."""

from typing import Final

import numpy as np
import pandas as pd

from core.batch import Floats
from core.models.features import EFFECT_PREFIX
from core.totals.tables import HISTOGRAM

SUMS: Final = frozenset({"duration_s", "distance_km", "gained_m", "lost_m", "stops", "samples", *HISTOGRAM})
"""Columns that add up over windows, beside the effects' energies."""
MEANS: Final = ("ambient_c", "precipitation_mm_h", "wind_speed_kmh")
"""Columns that are means over time."""
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
"""Columns that are of the last sample; what is left is the same all along a ride."""


def accumulate_windows(ride: pd.DataFrame, windows: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of a ride at its beginning and after each of its windows.

    Parameters
    ----------
    ride : DataFrame
        One row of the ride table.
    windows : DataFrame
        Its n windows, in their order.

    Returns
    -------
    DataFrame
        n + 1 rows, the first one of nothing driven yet; columns of the ride table that a model may read. The means of
        the first row are those of the first window.
    """
    n = len(windows)
    made: dict[str, object] = {name: np.full(n + 1, ride[name].iloc[0]) for name in ride.columns if not _changes(name)}
    for name in windows.columns:
        if _adds_up(name):
            made[str(name)] = _added(windows[name].to_numpy(np.float64))
        elif name in LAST:
            made[str(name)] = _kept(windows[name].to_numpy(np.float64))
    weight = windows["duration_s"].to_numpy(np.float64)
    for name in (name for name in MEANS if name in windows):
        made[name] = _averaged(windows[name].to_numpy(np.float64), weight)
    if {"wind_from_deg", "wind_speed_kmh"} <= set(windows.columns):
        made["wind_from_deg"] = _direction(windows, weight)
    distance, duration = _added(windows["distance_km"].to_numpy(np.float64)), _added(weight)
    made["average_speed_kmh"] = _kept(3600.0 * _over(distance[1:], duration[1:]))
    return pd.DataFrame(made)


def _adds_up(name: str) -> bool:
    """Tell whether a column adds up over windows."""
    return name in SUMS or name.startswith(EFFECT_PREFIX)


def _changes(name: str) -> bool:
    """Tell whether a column changes along a ride, so that only its windows tell what it is."""
    return _adds_up(name) or name in LAST or name in {*MEANS, "wind_from_deg", "average_speed_kmh"}


def _added(values: Floats) -> Floats:
    """Return running sums, from 0."""
    return np.concatenate([[0.0], np.cumsum(values)])


def _kept(values: Floats) -> Floats:
    """Return values, the first one twice."""
    return np.concatenate([values[:1], values])


def _averaged(values: Floats, weight: Floats) -> Floats:
    """Return running means of what is known."""
    known = ~np.isnan(values)
    sums = np.cumsum(np.where(known, values, 0.0) * weight)
    return _kept(_over(sums, np.cumsum(weight * known)))


def _direction(windows: pd.DataFrame, weight: Floats) -> Floats:
    """Return the running direction of the mean wind. [degree]"""
    angle = np.radians(windows["wind_from_deg"].to_numpy(np.float64))
    speed = windows["wind_speed_kmh"].to_numpy(np.float64)
    north, east = (_averaged(speed * turned, weight) for turned in (np.cos(angle), np.sin(angle)))
    return np.degrees(np.arctan2(east, north)) % 360.0


def _over(above: Floats, below: Floats) -> Floats:
    """Return a quotient, NaN where it has none."""
    return np.divide(above, below, out=np.full(len(above), np.nan), where=below > 0.0)
