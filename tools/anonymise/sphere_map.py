"""A rigid map of the Earth's surface: a rotation of the sphere, which keeps distances and angles."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Vectors = NDArray[np.float64]
INVALID: Final = 999.0
"""Coordinate that replaces one that is not on Earth, in degrees."""

_PER_DEGREE: Final = 1e9  # positions are rounded to 0.1 mm, so that distances stay


class SphereMap(NamedTuple):
    """Rotate positions.

    Parameters
    ----------
    matrix : (3, 3) float
        Rotation of unit vectors from the centre of the Earth.
    turn_deg : float
        Angle by which headings near the centre of the area turn, clockwise. [deg]
    """

    matrix: Vectors
    turn_deg: float

    def move(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Return the place to which a position moves.

        A position that is not on Earth stays off it, without what it had of a valid coordinate. The position (0, 0),
        which receivers without a fix report, stays: moved, it would give the map away.
        """
        valid = abs(latitude_deg) <= 90.0, abs(longitude_deg) <= 180.0
        if not all(valid):
            return tuple(0.0 if is_valid else INVALID for is_valid in valid)  # type: ignore[return-value]
        if latitude_deg == 0.0 == longitude_deg:
            return latitude_deg, longitude_deg
        latitude, longitude = (float(degrees) for degrees in self._rotate(latitude_deg, longitude_deg))
        return round(latitude * _PER_DEGREE) / _PER_DEGREE, round(longitude * _PER_DEGREE) / _PER_DEGREE

    def move_all(self, latitude_deg: Vectors, longitude_deg: Vectors) -> tuple[Vectors, Vectors]:
        """Return the places to which positions move, to the bit those of `move`."""
        is_valid = np.abs(latitude_deg) <= 90.0, np.abs(longitude_deg) <= 180.0
        is_on_earth = is_valid[0] & is_valid[1]
        moved = self._rotate(np.where(is_on_earth, latitude_deg, 0.0), np.where(is_on_earth, longitude_deg, 0.0))
        stays = (latitude_deg == 0.0) & (longitude_deg == 0.0)
        latitude, longitude = (
            np.where(
                is_on_earth,
                np.where(stays, 0.0, np.rint(degrees * _PER_DEGREE) / _PER_DEGREE),
                np.where(valid, 0.0, INVALID),
            )
            for degrees, valid in zip(moved, is_valid, strict=True)
        )
        return latitude, longitude

    def _rotate(self, latitude_deg: Any, longitude_deg: Any) -> tuple[Any, Any]:
        """Return one or several positions rotated; written out, so that both give the same bits."""
        latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
        radius = np.cos(latitude)
        before = radius * np.cos(longitude), radius * np.sin(longitude), np.sin(latitude)
        x, y, z = (a * before[0] + b * before[1] + c * before[2] for a, b, c in self.matrix.tolist())
        return np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, x))


def make_sphere_map(centre: tuple[float, float], to: tuple[float, float], turn_deg: float) -> SphereMap:
    """Return the rotation that moves a centre to another place, and turns the area around it.

    Units: centre [deg], to [deg].

    Examples
    --------
    A car in Montreal that drives north then drives east, 15 degrees of longitude farther west.

    >>> moved = make_sphere_map((45.5, -73.5), (45.5, -88.5), 90.0)
    >>> [round(degrees, 3) for degrees in (*moved.move(45.5, -73.5), *moved.move(45.6, -73.5))]
    [45.5, -88.5, 45.5, -88.357]
    """
    before, after = _make_frame(*centre), _make_frame(*to)
    angle = np.radians(turn_deg)
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return SphereMap(after @ turn @ before.T, turn_deg)


def find_centre(latitude_deg: Vectors, longitude_deg: Vectors) -> tuple[float, float]:
    """Return the centre of positions, which single wild ones do not move.

    Examples
    --------
    >>> places = np.array([45.0, 45.0, 45.0, -80.0]), np.array([-73.0, -73.0, -73.0, 0.0])
    >>> [round(degrees, 3) for degrees in find_centre(*places)]
    [45.0, -73.0]
    """
    vectors = to_vector(latitude_deg, longitude_deg)
    x, y, z = np.median(vectors, axis=-1).tolist()
    return float(np.degrees(np.arctan2(z, np.hypot(x, y)))), float(np.degrees(np.arctan2(y, x)))


def to_vector(latitude_deg: float | Vectors, longitude_deg: float | Vectors) -> Vectors:
    """Return unit vectors from the centre of the Earth, (3,) or (3, n)."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    return np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])


def _make_frame(latitude_deg: float, longitude_deg: float) -> Vectors:
    """Return east, north and up at a place as the columns of a matrix."""
    longitude = np.radians(longitude_deg)
    up = to_vector(latitude_deg, longitude_deg)
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    return np.stack([east, np.cross(up, east), up], axis=1)
