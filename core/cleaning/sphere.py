"""Distances of fixes on the sphere, compiled."""

from math import cos, pi, sqrt
from typing import Any

from socast.core.columns import EARTH_RADIUS
from socast.core.compiled_cache import njit


@njit(cache=False)
def wrap_angle(angle: float) -> float:
    """Return a difference of two angles wrapped to -π to π. [rad]"""
    return angle - 2.0 * pi if angle > pi else angle + 2.0 * pi if angle < -pi else angle


@njit(cache=False)
def find_way(latitude: float, longitude: float, row: Any) -> float:
    """Return the distance from a fix to that of a row, by its sine and cosine; see `compute_chord`. [m]"""
    north = row.raw_latitude - latitude
    between = row.cos_latitude + 0.5 * north * row.sin_latitude  # the cosine half-way
    east = wrap_angle(row.raw_longitude - longitude) * between
    return float(EARTH_RADIUS * sqrt(north * north + east * east))


@njit(cache=False)
def compute_chord(latitude: float, longitude: float, other_latitude: float, other_longitude: float) -> float:
    """Return the distance of two fixes on a sphere; valid for some kilometres. [m]"""
    north = other_latitude - latitude
    east = wrap_angle(other_longitude - longitude)
    east *= cos(0.5 * (latitude + other_latitude))
    return EARTH_RADIUS * sqrt(north * north + east * east)
