"""List what drives cannot show because a signal is absent, or present in too few rides."""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.fit.ride_blocks import get_names, get_numbers

LEAST_KNOWN: Final = 0.5
"""Share of the rides in which a signal must be known."""


def _knows(column: str) -> Callable[[pd.DataFrame], NDArray[np.bool_]]:
    """Return a function that finds the rides in which a column is known."""

    def find(table: pd.DataFrame) -> NDArray[np.bool_]:
        return np.isfinite(get_numbers(table, column)) if column in table else np.zeros(len(table), np.bool_)

    return find


def _varies(column: str) -> Callable[[pd.DataFrame], NDArray[np.bool_]]:
    """Return a function that finds the rides in which a column is known, none where it is zero in all rides."""

    def find(table: pd.DataFrame) -> NDArray[np.bool_]:
        known = _knows(column)(table)
        return known & bool(get_numbers(table, column)[known].any()) if known.any() else known

    return find


def _knows_drivers(table: pd.DataFrame) -> NDArray[np.bool_]:
    """Return the rides whose driver is known."""
    return np.array([bool(name) for name in get_names(table, "driver_id")], dtype=np.bool_)


SIGNALS: Final[Mapping[str, Callable[[pd.DataFrame], NDArray[np.bool_]]]] = {
    "elevation": _varies("effect_climbing"),
    "wind": _knows("wind_speed_kmh"),
    "precipitation": _knows("precipitation_mm_h"),
    "humidity": _knows("effect_humidity"),
    "outside temperature": _knows("ambient_c"),
    "time parked": _knows("parked_s"),
    "occupants": _knows("occupants"),
    "battery temperature": _knows("battery_temperature_c"),
    "driver": _knows_drivers,
    "climate power": _knows("hvac_kwh"),
}
"""The rides of a table in which each signal is known."""


def count_absent_signals(rides: pd.DataFrame) -> dict[str, int]:
    """Return the signals that are unknown in most rides, each with the number of rides in which it is known."""
    known = {name: int(find(rides).sum()) for name, find in SIGNALS.items()}
    return {name: count for name, count in known.items() if count < LEAST_KNOWN * len(rides)}
