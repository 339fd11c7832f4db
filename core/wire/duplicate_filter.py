"""Drop samples that were delivered before: a sample is its key and its bytes, by whatever way it comes.

A sample reaches a consumer again when the cache of its publisher is asked after a restart or an outage, when two
routers deliver it, and when recordings of one shift are merged. Sequence numbers of a transport would not tell these
apart, because a recording does not hold them. Every payload carries the time of its sender, so two messages with the
same key and the same bytes are the same message.

The filter remembers a 64-bit hash of each of the latest messages. Different messages have the same hash so rarely that
a fleet of 1,000 cars loses one message in 3,000 years.
"""

from collections.abc import Sequence
from typing import Any, Final

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray
from xxhash import xxh3_64_intdigest

from core.batch import Lanes
from core.wire.messages import LONGEST_KEY, Message

PER_VEHICLE: Final = 1280
"""Number of messages that are remembered at least, per vehicle; an hour of samples every 3 s is 1,200."""
LEAST: Final = 1 << 14
"""Number of messages that are remembered at least of a small fleet."""

Hashes = NDArray[np.uint64]
_raw_list = msgspec.json.Decoder(list[msgspec.Raw])


class DuplicateFilter:
    """Remember the latest messages of a fleet, and drop those that come again.

    The memory has two halves for the whole fleet. New messages go to the new half. When it holds `PER_VEHICLE` messages
    for each known vehicle, and at least `LEAST`, it becomes the old half, and what was the old half is forgotten. The
    state does therefore not depend on which of two messages came first. A message takes 10 to 20 bytes.

    Parameters
    ----------
    lanes : Lanes
        Vehicles of the fleet.

    Attributes
    ----------
    dropped : int
        Number of samples and other messages that came again since the start of the process. It is not part of the
        state, because the state must not depend on how often a message was delivered.
    """

    def __init__(self, lanes: Lanes) -> None:
        self.dropped = 0
        self._lanes = lanes
        self._seeds = _KeySeeds()
        self._new, self._old = (_make_table(np.empty(0, np.uint64), LEAST) for _ in range(2))
        self._count = 0

    def select_new(self, messages: Sequence[Message]) -> Sequence[Message]:
        """Return the messages that were not delivered before, and remember them.

        Parameters
        ----------
        messages : sequence of Message
            Messages in order of arrival.

        Returns
        -------
        sequence of Message
            The given sequence itself if all of its messages are new.
        """
        payloads = [message[1] for message in messages]
        if min(payloads, default=b"{") < b"{":  # a list begins with [, a sample with {
            return self._select_new_samples(messages)
        seeds = map(self._seeds.__getitem__, [message[0] for message in messages])
        new = self._remember(np.fromiter(map(xxh3_64_intdigest, payloads, seeds), np.uint64, len(payloads)))
        if new.all():
            return messages
        return [message for message, is_new in zip(messages, new.tolist(), strict=True) if is_new]

    def _select_new_samples(self, messages: Sequence[Message]) -> list[Message]:
        """Return the messages that are new, with lists of samples reduced to those that are new."""
        samples = [_split_list(key, payload) for key, payload, _ in messages]
        pairs = zip([self._seeds[message.key] for message in messages], samples, strict=True)
        hashes = [xxh3_64_intdigest(part, seed) for seed, parts in pairs for part in parts]
        new = iter(self._remember(np.array(hashes, np.uint64)))
        out: list[Message] = []
        for message, parts in zip(messages, samples, strict=True):
            left = [part for part, is_new in zip(parts, new, strict=False) if is_new]
            if len(left) == len(parts):
                out.append(message)
            elif left:
                out.append(message._replace(payload=b"[" + b",".join(left) + b"]"))
        return out

    def _remember(self, hashes: Hashes) -> NDArray[np.bool_]:
        """Remember hashes; return which of them were not remembered before."""
        is_new = np.empty(len(hashes), np.bool_)
        most, done = max(LEAST, PER_VEHICLE * len(self._lanes)), 0
        while done < len(hashes):
            if self._count >= most:
                self._old, self._new = self._new, _make_table(np.empty(0, np.uint64), LEAST)
                self._count = 0
            wanted = min(self._count + len(hashes) - done, most)
            if 5 * wanted > 4 * len(self._new):  # it grows only as far as it is used
                self._new = _make_table(self._new[self._new != 0], 2 * wanted)
            taken, self._count = _remember(hashes[done:], self._new, self._old, self._count, most, is_new[done:])
            done += taken
        self.dropped += len(hashes) - int(np.count_nonzero(is_new))
        return is_new

    def dump(self) -> Any:
        """Return the hashes of both halves of the memory as bytes, each in ascending order."""
        return [_list_hashes(half).astype("<u8").tobytes() for half in (self._new, self._old)]

    def load(self, state: Any) -> None:
        """Replace the remembered messages by those that `dump` returned."""
        new, old = (np.frombuffer(half, "<u8").astype(np.uint64) for half in state)
        self._new, self._old = _make_table(new, LEAST), _make_table(old, LEAST)
        self._count = int(np.count_nonzero(self._new))


def _make_table(hashes: Hashes, room: int) -> Hashes:
    """Return a table of hashes with room for a number of them; a place that is zero is empty."""
    table = np.zeros(1 << (5 * max(room, len(hashes)) // 4).bit_length(), np.uint64)
    _remember(hashes, table, np.zeros(1, np.uint64), 0, len(hashes) + 1, np.empty(len(hashes), np.bool_))
    return table


def _list_hashes(table: Hashes) -> Hashes:
    """Return the hashes in a table in ascending order."""
    return np.sort(table[table != 0])


def _split_list(key: str, payload: bytes) -> list[Any]:
    """Return the samples of a payload that is a list of telemetry, and any other payload itself."""
    if payload.lstrip()[:1] != b"[" or not key.endswith("/telemetry"):
        return [payload]
    try:
        return _raw_list.decode(payload) or [payload]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return [payload]


class _KeySeeds(dict[str, int]):
    """Map a key to the seed of the hashes of its payloads."""

    def __missing__(self, key: str) -> int:
        seed = xxh3_64_intdigest(key.encode(errors="surrogatepass"))
        if len(key) <= LONGEST_KEY:
            if len(self) >= 1 << 16:  # strangers may make up keys
                self.clear()
            self[key] = seed
        return seed


@njit(cache=True)
def _remember(hashes: Any, table: Any, other: Any, count: int, most: int, is_new: Any) -> tuple[int, int]:
    """Remember those hashes in a table with linear probing that neither it nor another table holds.

    `is_new` receives which hashes were not remembered before. The function stops when the table holds `most` hashes,
    and returns how many hashes it took, and how many the table holds.
    """
    one, none = np.uint64(1), np.uint64(0)
    mask, other_mask = np.uint64(len(table) - 1), np.uint64(len(other) - 1)
    for i in range(len(hashes)):
        value = hashes[i] if hashes[i] != none else one
        at = value & other_mask
        while other[at] != none and other[at] != value:
            at = (at + one) & other_mask
        is_new[i] = other[at] == none
        if not is_new[i]:
            continue
        at = value & mask
        while table[at] != none and table[at] != value:
            at = (at + one) & mask
        is_new[i] = table[at] == none
        if is_new[i]:
            table[at] = value
            count += 1
            if count == most:
                return i + 1, count
    return len(hashes), count
