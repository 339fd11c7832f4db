"""Find the lanes of vehicles and the codes of their rides by the bytes of their names, without an object per name."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import NO_RIDE, Floats, Ints, Lanes, grown
from socast.core.compiled_cache import njit
from socast.core.wire.messages import IDENTITY

NAME: Final = 64
"""Size of the names of vehicles, and of the names of rides that are remembered. [B]"""
PENDING: Final = -2.0
"""Ride code of a sample whose ride has another name than that of the sample before it of its car."""


class Texts(NamedTuple):
    """Hold n texts as places in a text in UTF-8, which several may share.

    Parameters
    ----------
    places : (n,) int
        Begin of each text.
    sizes : (n,) int
        Size of each text; of one that is longer than any name only as much as shows this. [B]
    is_known : (n,) bool
        Whether there is such a text.
    """

    places: NDArray[np.int32]
    sizes: NDArray[np.int32]
    text: NDArray[np.uint8]
    is_known: NDArray[np.bool_]

    def get(self, number: int) -> str:
        """Return a text."""
        place = self.places[number]
        return self.text[place : place + self.sizes[number]].tobytes().decode(errors="replace")


class NameLookup:
    """Remember the names of vehicles, and the ride of the newest sample of each.

    Attributes
    ----------
    cars, rides : (lanes, NAME) uint8
        Names of the vehicles, and of the ride of the newest sample of each, filled up with zeros.
    ride_sizes : (lanes,) int
        Sizes of the names of the rides; -1 where none is remembered. [B]
    ride_codes : (lanes,) float
        Codes of these rides.
    """

    def __init__(self, lanes: Lanes) -> None:
        self._lanes = lanes
        self.forget()

    def forget(self) -> None:
        """Forget the names of vehicles and rides, because lanes have moved."""
        self._known = 0
        self.cars = np.zeros((0, NAME), np.uint8)
        self._places = np.full(2, -1, np.int64)  # lanes by the hash of their names, with linear probing
        self.rides = np.zeros((0, NAME), np.uint8)
        self.ride_sizes, self.ride_codes = np.zeros(0, np.int64), np.zeros(0)

    def forget_rides(self) -> None:
        """Forget the names of rides, because their codes may be given to others."""
        self.ride_sizes[:] = -1

    def find_lanes(self, names: Texts) -> Ints:
        """Return the lane of each name of a vehicle, -1 for a vehicle that is not known."""
        self.update()
        lanes = np.full(len(names.is_known), -1, np.int64)
        _find_lanes(*names, self._places, self.cars, lanes)
        return lanes

    def find_rides(self, names: Texts, lanes: Ints, codes: Floats) -> None:
        """Write the code of each ride: `PENDING` for another one than that of the sample before it of its car."""
        self.update()
        _find_rides(*names, lanes, self.rides, self.ride_sizes, self.ride_codes, codes)

    def remember_ride(self, lane: int, name: str, code: float) -> None:
        """Remember the ride of the newest sample of a vehicle, so that the next samples of the ride have its code."""
        text = name.encode()
        if len(text) <= NAME:
            self.rides[lane, : len(text)] = np.frombuffer(text, np.uint8)
            self.ride_sizes[lane], self.ride_codes[lane] = len(text), code

    def update(self) -> None:
        """Learn the names of the vehicles that are new."""
        known, count = self._known, len(self._lanes)
        if known == count:
            return
        self.cars, self.rides = grown(self.cars, count), grown(self.rides, count)
        self.ride_sizes, self.ride_codes = grown(self.ride_sizes, count, -1), grown(self.ride_codes, count)
        fresh = [name.encode() if IDENTITY.fullmatch(name) else b"" for name in self._lanes.names[known:count]]
        self.cars[known:count] = np.array(fresh, f"S{NAME}").view(np.uint8).reshape(-1, NAME)
        self._known = count
        if 2 * count > len(self._places):  # as many places again stay empty
            self._places = np.full(4 << count.bit_length(), -1, np.int64)
            known = 0
        _place_lanes(self.cars, known, count, self._places)


@njit(error_model="numpy", inline="always")
def is_ride_of(text: Any, at: int, rides: Any, lane: int, size: int) -> bool:
    """Return whether a name is that of the ride of the last sample of a vehicle."""
    for k in range(size):  # noqa: SIM110 - numba has no all() of a generator
        if text[at + k] != rides[lane, k]:
            return False
    return True


@njit(error_model="numpy")
def _find_place(text: Any, begin: int, size: int, places: Any, names: Any) -> Any:
    """Return the place of the vehicle of a name among lanes by their hash, or the empty place where it belongs."""
    mixed = np.uint64(size)
    for k in range(begin, begin + size):
        mixed = (mixed ^ np.uint64(text[k])) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    place = np.int64(mixed & np.uint64(len(places) - 1))
    while places[place] >= 0:
        lane, k = places[place], 0
        while k < size and names[lane, k] == text[begin + k]:
            k += 1
        if k == size and (size == NAME or names[lane, size] == 0):
            break
        place = (place + 1) & (len(places) - 1)
    return place


@njit(cache=True, error_model="numpy")
def _place_lanes(names: Any, first: int, last: int, places: Any) -> None:
    """Put lanes at the places of their names."""
    for lane in range(first, last):
        size = 0
        while size < NAME and names[lane, size] != 0:
            size += 1
        places[_find_place(names[lane], 0, size, places, names)] = lane


@njit(cache=True, error_model="numpy")
def _find_lanes(starts: Any, sizes: Any, text: Any, is_known: Any, places: Any, names: Any, lanes: Any) -> None:
    """Write the lane of each name that is known."""
    for i in range(len(lanes)):
        start, size = int(starts[i]), int(sizes[i])
        if is_known[i] and 0 < size <= NAME:
            lanes[i] = places[_find_place(text, start, size, places, names)]


@njit(cache=True, error_model="numpy")
def _find_rides(
    starts: Any,
    sizes: Any,
    text: Any,
    is_known: Any,
    lanes: Any,
    rides: Any,
    ride_sizes: Any,
    ride_codes: Any,
    codes: Any,
) -> None:
    """Write the code of the ride of each row."""
    for i in range(len(lanes)):
        lane, start, size = lanes[i], int(starts[i]), int(sizes[i])
        codes[i] = NO_RIDE
        if lane >= 0 and is_known[i]:
            is_same = size == ride_sizes[lane] and is_ride_of(text, start, rides, lane, size)
            codes[i] = ride_codes[lane] if is_same else PENDING
