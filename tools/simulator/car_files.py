"""Keep the messages of each car in a file until all are merged, so that memory does not grow with the fleet.

A file holds groups of rows, each compressed on its own. The rows are those of the car's messages in the order in which
it sends them, with the place of each in the order of receipt. Merging reads a few groups of every car at a time.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from socast.core.batch import Ints
from socast.core.wire.messages import Message

KINDS: Final = ("telemetry", "vehicle", "ride", "plan")
"""Kinds of the messages of a car; a row holds the position."""
GROUP_ROWS: Final = 64
"""Number of messages of a group."""
GROUPS_AT_A_TIME: Final = 2048
"""Number of groups that are merged at a time, besides one of each car."""
_LEVEL: Final = 1
_ROW: Final = np.dtype([("at", "<i8"), ("receipt_ns", "<i8"), ("size", "<u4"), ("kind", "u1")])
_GROUP: Final = np.dtype([("first", "<i8"), ("offset", "<i8"), ("size", "<i8"), ("rows", "<i8")])

Groups = NDArray[np.void]


class ShiftTruth(NamedTuple):
    """Hold the truth of a shift, and the place of its last message in the order of receipt. [Unix ns]"""

    last: int
    rides: list[dict[str, Any]]
    displays: list[dict[str, Any]]


class CarFile(NamedTuple):
    """Describe the messages of a car in a file.

    Parameters
    ----------
    groups : (n,) void
        Place of the first message, offset in the file [B], size [B] and number of messages of each group.
    faults : Counter of str
        Number of faults of the logger, by kind.
    """

    name: str
    path: Path
    groups: Groups
    shifts: list[ShiftTruth]
    faults: Counter[str]


class CarWriter:
    """Write the messages of a car to a file.

    Attributes
    ----------
    last : int
        Place of the last message. [Unix ns]
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._compress = zstandard.ZstdCompressor(level=_LEVEL).compress
        self._groups: list[tuple[int, int, int, int]] = []
        self.last = 0

    def write(self, messages: Sequence[Message]) -> None:
        """Append messages; one that was received before the last one takes its place."""
        rows = np.empty(len(messages), _ROW)
        keys, payloads, received = zip(*messages, strict=True)
        rows["receipt_ns"] = received
        rows["at"] = np.maximum.accumulate(np.maximum(rows["receipt_ns"], self.last))
        rows["size"] = list(map(len, payloads))
        kind = {key: KINDS.index(key.rpartition("/")[2]) for key in set(keys)}
        rows["kind"] = list(map(kind.__getitem__, keys))
        for first in range(0, len(rows), GROUP_ROWS):
            part = rows[first : first + GROUP_ROWS]
            packed = self._compress(part.tobytes() + b"".join(payloads[first : first + GROUP_ROWS]))
            self._groups.append((int(part["at"][0]), self._file.tell(), len(packed), len(part)))
            self._file.write(packed)
        self.last = int(rows["at"][-1])

    def close(self) -> Groups:
        """Close the file and return its groups."""
        self._file.close()
        return np.array(self._groups, _GROUP)


class _CarReader:
    """Read the messages of a car in their order."""

    def __init__(self, car: CarFile) -> None:
        self._car, self._next = car, 0
        self._keys = [f"fleet/{car.name}/{kind}" for kind in KINDS]
        self._decompress = zstandard.ZstdDecompressor().decompress
        self._at: Ints = np.empty(0, np.int64)
        self._messages: list[Message] = []

    def take(self, limit: float) -> tuple[Ints, list[Message]]:
        """Return the messages whose places are before a limit, and these places."""
        groups = self._car.groups
        stop = int(np.searchsorted(groups["first"], limit))
        if stop > self._next:
            with self._car.path.open("rb") as file:
                parts = [self._read(file, group) for group in groups[self._next : stop]]
            self._at = np.concatenate([self._at, *(at for at, _ in parts)])
            self._messages += [message for _, messages in parts for message in messages]
            self._next = stop
        count = int(np.searchsorted(self._at, limit))
        taken = self._at[:count], self._messages[:count]
        self._at, self._messages = self._at[count:], self._messages[count:]
        return taken

    def _read(self, file: Any, group: Any) -> tuple[Ints, list[Message]]:
        """Return the messages of a group and their places."""
        file.seek(int(group["offset"]))
        data = self._decompress(file.read(int(group["size"])))
        rows = np.frombuffer(data, _ROW, int(group["rows"]))
        ends = rows.nbytes + np.cumsum(rows["size"], dtype=np.int64)
        payloads = [data[begin:end] for begin, end in pairwise([rows.nbytes, *ends.tolist()])]
        keys = map(self._keys.__getitem__, rows["kind"].tolist())
        return rows["at"], list(map(Message, keys, payloads, rows["receipt_ns"].tolist()))


def merge_cars(cars: Sequence[CarFile]) -> Iterator[list[Message]]:
    """Yield the messages of all cars in order of receipt; those of one time in the order of the cars."""
    readers = [_CarReader(car) for car in cars]
    for limit in plan_merge(cars):
        parts = [reader.take(limit) for reader in readers]
        at = np.concatenate([places for places, _ in parts])
        messages = [message for _, of_car in parts for message in of_car]
        yield [messages[i] for i in np.argsort(at, kind="stable").tolist()]


def plan_merge(cars: Sequence[CarFile]) -> list[float]:
    """Return the places up to which messages are merged at a time; the last one is infinite. [Unix ns]"""
    first = np.sort(np.concatenate([car.groups["first"] for car in cars]))
    return [*np.unique(first[GROUPS_AT_A_TIME::GROUPS_AT_A_TIME]).tolist(), np.inf]


def order_shifts(cars: Iterable[CarFile]) -> Iterator[ShiftTruth]:
    """Yield the truth of all shifts: the first ones by car, each later one as the messages before it end."""
    keyed = [
        (0 if number == 0 else car.shifts[number - 1].last, number > 0, place, shift)
        for place, car in enumerate(cars)
        for number, shift in enumerate(car.shifts)
    ]
    for _, _, _, shift in sorted(keyed, key=lambda each: each[:3]):
        yield shift
