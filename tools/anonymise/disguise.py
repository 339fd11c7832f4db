"""What is secret about an anonymised recording: its map, its shift of time, and the salt of its names.

The map moves the area along its parallel by whole hours of solar time, and turns it. All times are shifted back by the
same hours, and by whole weeks that are about whole years. The sun, the season and the weekday of the place therefore
stay. A map that hides the latitude too would change the sun, and so what lights and daylight explain.
"""

import hashlib
from collections.abc import Sequence
from random import Random
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats

Vectors = NDArray[np.float64]
INVALID: Final = 999.0
"""Coordinate that replaces one that is not on Earth, in degrees."""

_PER_DEGREE: Final = 1e9  # positions are rounded to 0.1 mm, so that distances stay
WEEK_S: Final = 7 * 86400
"""A week. [s]"""
YEAR_DAYS: Final = 365.2422
"""Mean length of the seasons. [d]"""
SEASON_DAYS: Final = 0.5
"""Largest deviation of a shift from whole years. [d]"""
MOST_YEARS: Final = 40.0
"""Largest shift. [a]"""
SPAN_S: Final = 631_152_000.0, 2_840_140_800.0
"""Times between which recordings are moved: 1990 and 2060. [Unix s]"""
EPOCHS_S: Final = 0.0, 315_964_800.0, 946_684_800.0
"""Times that clocks show which were never set: the beginning of 1970, of GPS and of 2000. [Unix s]"""
RUNNING_S: Final = 400 * 86400.0
"""Time for which such a clock may have run. [s]"""
FINE_S: Final = 2.0**53 * 1e-6
"""Times up to here are rounded to microseconds; floats of later ones are coarser. [Unix s]"""
FARTHEST_DEG: Final = 175.0
"""Largest longitude to which an area moves, because computations with longitudes fail beside 180. [deg]"""
HASH_BYTES: Final = 6
"""Length of a hashed name; two of 100,000 names are equal in 2 of 100,000 recordings. [B]"""


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


class Disguise(NamedTuple):
    """Hold what turns a recording into an anonymised one. It is never written.

    Parameters
    ----------
    shift_s : int
        Shift of all times. [s]
    """

    salt: bytes
    shift_s: int
    places: SphereMap

    def rename(self, kind: str, name: str) -> str:
        """Return the pseudonym of a name.

        Parameters
        ----------
        kind : str
            What has the name, such as `car`. The same name of another kind has another pseudonym.
        """
        digest = hashlib.blake2b(f"{kind}/{name}".encode(), digest_size=HASH_BYTES, key=self.salt)
        return f"{kind}-{digest.hexdigest()}"

    def shift(self, time_s: float) -> float:
        """Return a time in the anonymised recording. [Unix s]

        A time of a clock that was never set stays: moved, it would give the shift away.
        """
        is_set = not any(0.0 <= time_s - epoch_s <= RUNNING_S for epoch_s in EPOCHS_S)
        moved = time_s + self.shift_s
        if not is_set:
            return time_s
        return round(moved * 1e6) / 1e6 if abs(moved) < FINE_S else moved

    def shift_all(self, times_s: Floats) -> Floats:
        """Return times in the anonymised recording, to the bit those of `shift`. [Unix s]"""
        moved = times_s + self.shift_s
        is_fine = np.abs(moved) < FINE_S
        moved = np.where(is_fine, np.rint(np.where(is_fine, moved, 0.0) * 1e6) / 1e6, moved)
        ages_s = [times_s - epoch_s for epoch_s in EPOCHS_S]
        is_unset = np.any([(age_s >= 0.0) & (age_s <= RUNNING_S) for age_s in ages_s], axis=0)
        return np.where(is_unset, times_s, moved)

    def turn(self, direction_deg: float) -> float:
        """Return a compass direction in the anonymised recording; one outside 0 to 360 stays. [deg]"""
        if not 0.0 <= direction_deg <= 360.0:
            return direction_deg
        return round((direction_deg + self.places.turn_deg) % 360.0, 6)


def make_disguise(
    random: Random, begin_s: float, end_s: float, centre: tuple[float, float] | None, busy: Sequence[bool]
) -> Disguise:
    """Return a random disguise.

    Parameters
    ----------
    centre : tuple of (float, float), optional
        Latitude and longitude of the area, None if no position is known. [deg]
    busy : sequence of bool
        Whether any car sends in each of the 24 hours of the day, UTC. Of the shifts, those are preferred that take no
        sample to another day than before, because cars are judged day by day.
    """
    weeks = random.choice(list_shifts(begin_s, end_s))
    latitude, longitude = centre or (0.0, 0.0)
    to = {hours: (longitude - 15.0 * hours + 180.0) % 360.0 - 180.0 for hours in range(-12, 12) if hours}
    to = {hours: there for hours, there in to.items() if abs(there) <= FARTHEST_DEG}
    hours = random.choice([hours for hours in to if keeps_days(hours, busy)] or list(to))
    places = make_sphere_map((latitude, longitude), (latitude, to[hours]), random.uniform(0.0, 360.0))
    return Disguise(random.randbytes(32), weeks * WEEK_S + hours * 3600, places)


def keeps_days(hours: int, busy: Sequence[bool]) -> bool:
    """Return whether samples of the same day, UTC, are of the same day after a shift by hours.

    Units: hours [h].

    Examples
    --------
    >>> day_time = [8 <= hour < 18 for hour in range(24)]
    >>> [hours for hours in range(-12, 12) if not keeps_days(hours, day_time)]
    [-12, -11, -10, -9, 7, 8, 9, 10, 11]
    """
    midnight = -hours % 24
    return not any(busy[:midnight]) or not any(busy[midnight:])


def list_shifts(begin_s: float, end_s: float) -> list[int]:
    """Return the shifts in whole weeks that are about whole years, and that keep a recording within `SPAN_S`.

    Examples
    --------
    >>> shifts = list_shifts(1.7e9, 1.7e9)
    >>> len(shifts), shifts[:3]
    (9, [-1461, -887, -574])
    """
    most = round(MOST_YEARS * YEAR_DAYS / 7.0)
    near = [
        weeks
        for weeks in range(-most, most + 1)
        if weeks and abs(7.0 * weeks - YEAR_DAYS * round(7.0 * weeks / YEAR_DAYS)) <= SEASON_DAYS
    ]
    inside = [weeks for weeks in near if SPAN_S[0] <= begin_s + weeks * WEEK_S and end_s + weeks * WEEK_S <= SPAN_S[1]]
    return inside or near
