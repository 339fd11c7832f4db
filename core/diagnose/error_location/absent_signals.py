"""List what drives cannot tell because a signal is absent."""

from collections.abc import Callable
from typing import Final

import numpy as np
import pandas as pd

from core.fit.ride_blocks import get_names, get_numbers

LEAST_KNOWN: Final = 0.5
"""Share of the windows or rides in which a signal must be known."""


def _knows(column: str) -> Callable[[pd.DataFrame], bool]:
    return lambda table: column in table and float(np.isfinite(get_numbers(table, column)).mean()) >= LEAST_KNOWN


def _varies(column: str) -> Callable[[pd.DataFrame], bool]:
    return lambda table: _knows(column)(table) and bool(np.nan_to_num(get_numbers(table, column)).any())


def _knows_drivers(table: pd.DataFrame) -> bool:
    names = get_names(table, "driver_id")
    return sum(map(bool, names)) >= LEAST_KNOWN * len(names)


SIGNALS: Final[dict[str, Callable[[pd.DataFrame], bool]]] = {
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
"""Whether a ride table holds each signal."""


def list_absent_signals(rides: pd.DataFrame) -> tuple[str, ...]:
    """Return the signals that are unknown in most rides.

    Parameters
    ----------
    rides : DataFrame
        Ride table.

    Returns
    -------
    tuple of str
        Keys of `SIGNALS`.
    """
    return tuple(name for name, is_known in SIGNALS.items() if not is_known(rides))
