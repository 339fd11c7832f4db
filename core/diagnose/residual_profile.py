"""Compute the mean residual along each feature of the windows, and for each car, driver and hour of the day."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.records import ResidualProfile
from socast.core.diagnose.selection import Selection
from socast.core.fit.ride_blocks import get_names, get_numbers
from socast.core.stats.bin_means import average_in_bins, split_at_quantiles

FEATURES: Final[tuple[tuple[str, str], ...]] = (
    ("ambient_c", "°C"),
    ("average_speed_kmh", "km/h"),
    ("precipitation_mm_h", "mm/h"),
    ("wind_speed_kmh", "km/h"),
    ("soc_start_pct", "%"),
    ("battery_temperature_c", "°C"),
    ("elapsed_s", "s"),
    ("parked_s", "s"),
    ("occupants", "1"),
    ("odometer_km", "km"),
    ("start_s", "s"),
)
"""Features of a window on which an error may depend, with their units."""
BINS: Final = 12
"""Largest number of bins along a feature."""
LEAST_WINDOWS: Final = 10
"""Least mean number of windows in a bin."""
MOST_NAMES: Final = 20
"""Largest number of cars or drivers: those with the most windows."""
HOURS: Final = 3
"""Length of a class of the hour of the day. [h]"""
WH: Final = 1000.0
"""Watt-hours in a kilowatt-hour. [Wh/kWh]"""


def profile_residual(selection: Selection) -> list[ResidualProfile]:
    """Return the mean residual power along each feature and by each category, without and with what is named."""
    base, seen = selection.base, selection.base.windows
    hours = get_numbers(seen.table, "duration_s") / 3600.0
    series = selection.compute_residual(selection.build_basis()), base.residual
    after, before = (WH * base.convert_to_energy(each) / hours for each in series)
    weight = base.weight * hours**2
    shown = []
    for name, unit in FEATURES:
        values = get_numbers(seen.table, name)
        rows = np.flatnonzero(np.isfinite(values))
        if len(rows) < BINS * LEAST_WINDOWS:
            continue
        place, bins = split_at_quantiles(values[rows], BINS)
        if bins < 2:
            continue
        x = np.bincount(place, values[rows], bins) / np.bincount(place, minlength=bins)
        means = _average(place, bins, rows, after, before, weight, seen.day)
        shown.append(ResidualProfile(feature=name, unit=unit, x=x.tolist(), **means))
    for name, labels in _list_categories(seen):
        names, place, count = np.unique(labels, return_inverse=True, return_counts=True)
        known = [i for i in np.argsort(-count, kind="stable").tolist() if names[i]][:MOST_NAMES]
        if len(known) < 2:
            continue
        kept = sorted(known)
        code = np.full(len(names), -1)
        code[kept] = np.arange(len(kept))
        rows = np.flatnonzero(code[place] >= 0)
        means = _average(code[place][rows], len(kept), rows, after, before, weight, seen.day)
        shown.append(ResidualProfile(feature=name, x=[str(names[i]) for i in kept], **means))
    return shown


def _average(
    place: Ints, bins: int, rows: Ints, after: Floats, before: Floats, weight: Floats, day: Ints
) -> dict[str, Any]:
    """Return the means in bins of some windows, with the interval of the residual that remains."""
    means = average_in_bins(place, bins, after[rows], weight[rows], day[rows])
    old = np.bincount(place, weight[rows] * before[rows], bins) / np.bincount(place, weight[rows], bins)
    return {
        "before_w": old.tolist(),
        "after_w": means.value.tolist(),
        "ci95_w": means.ci95.tolist(),
        "windows": means.windows.tolist(),
        "days": means.days.tolist(),
    }


def _list_categories(windows: Windows) -> list[tuple[str, NDArray[np.str_]]]:
    """Return the names of the categories, and of each window's class in them; empty where unknown."""
    table, of_ride = windows.table, windows.ride
    longitude = np.nan_to_num(get_numbers(table, "longitude_start_deg"))
    hour = (get_numbers(table, "start_s") / 3600.0 + longitude / 15.0) % 24.0
    first = (hour // HOURS * HOURS).astype(np.int64)
    return [
        ("vehicle_id", np.array(get_names(table, "vehicle_id"), dtype=np.str_)),
        ("driver_id", np.array(get_names(windows.rides, "driver_id"), dtype=np.str_)[of_ride]),
        ("hour", np.array([f"{at:02d} to {at + HOURS:02d} h" for at in first.tolist()], dtype=np.str_)),
    ]
