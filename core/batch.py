"""A batch of samples as columns, and the lanes that say whose row each is."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NO_RIDE = -1
"""Ride code of a sample without the name of a ride."""


class Stateful(Protocol):
    """Describe a component whose state outlives the process: it writes its state and restores it."""

    def dump(self) -> Any:
        """Return the state as values that MessagePack can hold."""

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""


class Table(Protocol):
    """Hold columns by name: a mapping of arrays, or a `DataFrame`."""

    def __getitem__(self, name: Any, /) -> Any:
        """Return a column."""

    def __contains__(self, name: Any, /) -> bool:
        """Return whether there is a column of that name."""

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the names of the columns."""

    def __len__(self) -> int:
        """Return the number of columns of a mapping, or of rows of a `DataFrame`."""


class Batch(NamedTuple):
    """Hold telemetry as equally long columns, sorted by arrival, in SI; NaN where unknown.

    One live sample is a batch of one. See `socast.core.columns.TELEMETRY` for units and ranges.

    Parameters
    ----------
    lane : (n,) int64. Whose row it is: an index into `Lanes`.
    ride : (n,) int64. Code of the ride's name, `NO_RIDE` without one.
    stamp, ..., charging : (n,) float64.
    """

    lane: Ints
    ride: Ints
    stamp: Floats
    seq: Floats
    latitude: Floats
    longitude: Floats
    elevation: Floats
    speed: Floats
    odometer: Floats
    soc: Floats
    voltage: Floats
    current: Floats
    battery_temperature: Floats
    ambient: Floats
    hvac: Floats
    occupants: Floats
    charging: Floats

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.lane)

    def rows(self, start: int, stop: int) -> "Batch":
        """Return a view of the rows from `start` up to, not including, `stop`."""
        return Batch(*(column[start:stop] for column in self))  # type: ignore[arg-type]


class Lanes:
    """Number the vehicles seen so far with small integers, which index every state array."""

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.names: list[str] = list(names)
        self._of = {name: lane for lane, name in enumerate(self.names)}

    def __len__(self) -> int:
        return len(self.names)

    def find(self, name: str) -> int | None:
        """Return the lane of a vehicle, None for one not seen before."""
        return self._of.get(name)

    def lane(self, name: str) -> int:
        """Return the lane of a vehicle, opening one for a vehicle not seen before."""
        lane = self._of.get(name)
        if lane is None:
            lane = self._of[name] = len(self.names)
            self.names.append(name)
        return lane

    def keep(self, lanes: Ints) -> None:
        """Keep the vehicles of some lanes only, in the given order."""
        self.load([self.names[lane] for lane in lanes.tolist()])

    def dump(self) -> list[str]:
        """Return the names of the vehicles in the order of their lanes."""
        return list(self.names)

    def load(self, state: Sequence[str]) -> None:
        """Replace all vehicles by those that `dump` returned."""
        self.names[:] = state
        self._of = {name: lane for lane, name in enumerate(self.names)}


class OfLanes(Protocol):
    """Describe a component with a state of each lane."""

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order: the state of the first one becomes that of lane 0."""


def replace_nan(values: Floats, number: float = 0.0) -> Floats:
    """Return values with a number in place of NaN, in a third of the time of `np.nan_to_num`."""
    return np.where(np.isnan(values), number, values)


def sum_weighted(values: Floats, weights: Floats) -> Floats:
    """Return the weighted sum of each row over the second axis.

    It adds one place after the other, so that a row has the same sum, to the bit, however many rows there are;
    `np.einsum` and products of matrices choose their order by the number of rows.

    Parameters
    ----------
    values : (n, k, ...) float
    weights : (n, k) float

    Examples
    --------
    >>> sum_weighted(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[1.0, 10.0], [0.0, 1.0]])).tolist()
    [21.0, 4.0]
    """
    shape = weights.shape[:1] + (1,) * (values.ndim - 2)
    out = np.zeros(values.shape[:1] + values.shape[2:])
    for place in range(weights.shape[1]):
        out += weights[:, place].reshape(shape) * values[:, place]
    return out


class RowsOfLanes:
    """Find the rows of each lane, in their order, without a comparison of all rows."""

    def __init__(self, lane: Ints) -> None:
        self._rows = np.argsort(lane, kind="stable")
        self._lanes = lane[self._rows]

    def find(self, lane: int) -> Ints:
        """Return the rows of a lane."""
        first, end = np.searchsorted(self._lanes, (lane, lane + 1))
        return self._rows[first:end]


def take_lanes(array: NDArray[Any], lanes: Ints) -> NDArray[Any]:
    """Return the rows of ascending lanes of an array that may be shorter than the number of lanes."""
    return array[lanes[: np.searchsorted(lanes, len(array))]]


def take_keys(values: dict[int, Any], lanes: Ints) -> dict[int, Any]:
    """Return a mapping from some of its lanes, by their new numbers."""
    number = {lane: new for new, lane in enumerate(lanes.tolist())}
    return {number[lane]: value for lane, value in values.items() if lane in number}


def grown(array: NDArray[Any], rows: int, fill: Any = 0) -> NDArray[Any]:
    """Return `array` itself if it has `rows` rows, else a filled copy whose number of rows is the next power of two.

    The size then depends on the rows alone, not on the steps in which they were added, and so does a snapshot.
    """
    if len(array) >= rows:
        return array
    larger = np.full((1 << (rows - 1).bit_length(), *array.shape[1:]), fill, dtype=array.dtype)
    larger[: len(array)] = array
    return larger
