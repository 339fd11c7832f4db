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
"""Number of messages that are remembered, per vehicle; an hour of samples every 3 s is 1,200."""
LEAST: Final = 1 << 14
"""Number of messages that are remembered of a small fleet."""

Hashes = NDArray[np.uint64]
_raw_list = msgspec.json.Decoder(list[msgspec.Raw])


class DuplicateFilter:
    """Remember the latest messages of a fleet, and drop those that come again.

    The memory is one queue for the whole fleet. It holds `PER_VEHICLE` messages for each known vehicle, and at least
    `LEAST`. A message takes 16 to 32 bytes.

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
        self._count = 0
        self._allot(LEAST, np.empty(0, np.uint64))

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
        if (wanted := self._count + len(hashes)) > len(self._queue):  # it grows only as far as it is used
            most = max(LEAST, PER_VEHICLE * len(self._lanes))
            if most > len(self._queue):
                self._allot(min(most, 2 * wanted), self._in_order())
        new = np.empty(len(hashes), np.bool_)
        self._count = _remember(hashes, self._queue, self._table, self._count, new)
        self.dropped += len(hashes) - int(np.count_nonzero(new))
        return new

    def dump(self) -> Any:
        """Return the hashes of the remembered messages as bytes, the oldest first."""
        return self._in_order().astype("<u8").tobytes()

    def load(self, state: Any) -> None:
        """Replace the remembered messages by those that `dump` returned."""
        hashes = np.frombuffer(state, "<u8").astype(np.uint64)
        self._allot(max(LEAST, len(hashes)), hashes)

    def _allot(self, size: int, hashes: Hashes) -> None:
        """Make room for a number of hashes, and remember those given, the oldest first."""
        self._queue = np.zeros(size, np.uint64)
        self._table = np.zeros(1 << (5 * size // 4).bit_length(), np.uint64)
        self._count = _remember(hashes, self._queue, self._table, 0, np.empty(len(hashes), np.bool_))

    def _in_order(self) -> Hashes:
        """Return the remembered hashes, the oldest first."""
        at = self._count % len(self._queue)
        return self._queue[:at] if self._count < len(self._queue) else np.roll(self._queue, -at)


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
def _remember(hashes: Any, queue: Any, table: Any, count: int, new: Any) -> int:
    """Remember hashes in a queue and in a table with linear probing; return how many were remembered so far.

    An entry of zero is empty. `new` receives which of the hashes were not remembered before. The oldest hash makes
    room.
    """
    mask = np.uint64(len(table) - 1)
    one, none = np.uint64(1), np.uint64(0)
    for i in range(len(hashes)):
        value = hashes[i] if hashes[i] != none else one
        at = value & mask
        while table[at] != none and table[at] != value:
            at = (at + one) & mask
        new[i] = table[at] == none
        if not new[i]:
            continue
        place = count % len(queue)
        if queue[place] != none:
            _forget(queue[place], table, mask)
            at = value & mask
            while table[at] != none:
                at = (at + one) & mask
        table[at] = queue[place] = value
        count += 1
    return count


@njit(cache=True)
def _forget(value: Any, table: Any, mask: Any) -> None:
    """Remove a value from the table, and move back the values after it that the gap would make unreachable.

    Knuth, The Art of Computer Programming, volume 3, section 6.4, algorithm R.
    """
    one, none = np.uint64(1), np.uint64(0)
    gap = value & mask
    while table[gap] != value:
        gap = (gap + one) & mask
    table[gap] = none
    at = (gap + one) & mask
    while table[at] != none:
        home = table[at] & mask
        if ((at - home) & mask) >= ((at - gap) & mask):
            table[gap] = table[at]
            table[at] = none
            gap = at
        at = (at + one) & mask
