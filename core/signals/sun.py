"""Compute the elevation of the sun, from which darkness and daylight follow."""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY

J2000: Final = 946_728_000.0
"""Unix time of 1 January 2000, 12:00 UTC. [s]"""


def sine_of_elevation(time: Floats, latitude: Floats, longitude: Floats) -> Floats:
    """Return the sine of the sun's elevation above the horizon, without refraction.

    Returns
    -------
    (n,) float
        Sine of the elevation, NaN where the position is unknown. [1]

    Notes
    -----
    sin h = sin φ z + cos φ (x cos θ + y sin θ), with elevation h, latitude φ, unit vector (x, y, z) to the sun in the
    equatorial frame and local sidereal time θ. The error is at most 0.01° from 1950 to 2050, and at most 0.1° for
    some centuries before and after.

    References
    ----------
    Michalsky, The Astronomical Almanac's algorithm for approximate solar position, Solar Energy 40 (1988) 227-235,
    DOI 10.1016/0038-092X(88)90045-X.

    Examples
    --------
    The times are noon and midnight on the equator at an equinox, 20 March 2024.

    >>> times = 1_710_936_000.0 + np.array([450.0, 43_650.0])
    >>> sine_of_elevation(times, np.zeros(2), np.zeros(2)).round(3).tolist()
    [1.0, -1.0]
    """
    days = (time - J2000) / SECONDS_PER_DAY
    anomaly = np.radians(357.528 + 0.9856003 * days)
    sine = np.sin(anomaly)
    ecliptic = np.radians(280.460 + 0.9856474 * days + 1.915 * sine + 0.040 * sine * np.cos(anomaly))
    obliquity = np.radians(23.439)
    across = np.sin(ecliptic)
    sidereal = np.radians(280.46062 + 360.98564737 * days) + longitude
    towards = np.cos(ecliptic) * np.cos(sidereal) + np.cos(obliquity) * across * np.sin(sidereal)
    return np.sin(latitude) * (np.sin(obliquity) * across) + np.cos(latitude) * towards
