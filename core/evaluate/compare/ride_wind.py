"""Compute the wind that meets a car along a ride, from the wind and the course of each window."""

from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats

LEAST_DISPLACEMENT_DEG: Final = 3e-4
"""Displacement below which a window has no course, about 30 m. [degree of latitude]"""
COLUMNS: Final = (
    *("wind_speed_kmh", "wind_from_deg"),
    *("latitude_start_deg", "longitude_start_deg", "latitude_end_deg", "longitude_end_deg"),
)


def compute_window_headwind(windows: pd.DataFrame) -> Floats:
    """Return the component of the wind against the course of each window, negative from behind.

    Returns
    -------
    (n,) float
        NaN where the wind, a position or the course is unknown. [km/h]

    Examples
    --------
    A car that drives north in a wind of 20 km/h from the north, and then back:

    >>> drive = pd.DataFrame({
    ...     "wind_speed_kmh": [20.0, 20.0], "wind_from_deg": [0.0, 0.0],
    ...     "latitude_start_deg": [45.0, 45.01], "longitude_start_deg": [0.0, 0.0],
    ...     "latitude_end_deg": [45.01, 45.0], "longitude_end_deg": [0.0, 0.0],
    ... })
    >>> compute_window_headwind(drive).tolist()
    [20.0, -20.0]
    """
    speed, wind_from, south, west, north, east = (windows[name].to_numpy(np.float64) for name in COLUMNS)
    up = north - south
    right = (east - west) * np.cos(np.radians(0.5 * (north + south)))
    apart = np.hypot(up, right)
    along = np.cos(np.radians(wind_from)) * up + np.sin(np.radians(wind_from)) * right
    return np.divide(speed * along, apart, out=np.full(len(speed), np.nan), where=apart > LEAST_DISPLACEMENT_DEG)
