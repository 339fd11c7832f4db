"""Drop samples that were delivered before: a sample is its key and its bytes, by whatever way it comes.

A sample reaches a consumer again when the cache of its publisher is asked after a restart or an outage, when two
routers deliver it, and when recordings of one shift are merged. Sequence numbers of a transport would not tell these
apart, because a recording does not hold them. Every payload carries the time of its sender, so two messages with the
same key and the same bytes are the same message.

The filter remembers a 64-bit hash of each of the latest messages that were taken in. It does not remember messages
that cannot be decoded, and those of vehicles and stations beyond the limits, because strangers could fill the memory
with them. Such a message is refused and counted whenever it comes. Different messages have the same hash so rarely
that a fleet of 1,000 cars loses one message in 3,000 years.
"""

from collections.abc import Sequence
from contextlib import suppress
from itertools import compress
from math import inf
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from xxhash import xxh64_intdigest

from socast.core.batch import Lanes
from socast.core.compiled_cache import njit
from socast.core.files import UNREADABLE
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import PREFIX, BatchReader, select_rows
from socast.core.wire.decoder import Refused
from socast.core.wire.message_block import KeyValues, MessageBlock
from socast.core.wire.messages import BATCH, LONGEST_KEY, Message
from socast.core.wire.text_hash import hash_texts

PER_VEHICLE: Final = 1280
"""Number of messages that are remembered at least, per vehicle; an hour of samples every 3 s is 1,200."""
LEAST: Final = 1 << 14
"""Number of messages that are remembered at least of a small fleet."""

Hashes = NDArray[np.uint64]
_BRACE: Final = ord("{")
_WHOLE: Final[Sequence[Any]] = (b"",)
"""Stands for the sample of a message that is neither a list nor a batch."""
_raw_list = msgspec.json.Decoder(list[msgspec.Raw])


class _Part(NamedTuple):
    """Hold messages, the samples of each, and which of these samples were new."""

    messages: MessageBlock
    samples: list[Sequence[Any]] | None  # None if no message is a list or a batch
    hashes: Hashes
    is_new: NDArray[np.bool_]

    def select(self, mask: NDArray[np.bool_]) -> MessageBlock:
        """Return the messages with those samples that a mask names; the given block itself if it names all."""
        if mask.all():
            return self.messages
        if self.samples is None:
            return self.messages.take(mask)
        flags = mask.tolist()
        out: list[Message] = []
        at = 0
        for message, samples in zip(self.messages, self.samples, strict=True):
            named, at = flags[at : at + len(samples)], at + len(samples)
            if all(named):
                out.append(message)
            elif any(named):
                out.append(message._replace(payload=_select_samples(message.payload, samples, named)))
        return MessageBlock.of(out)


def _select_samples(payload: bytes, samples: Sequence[Any], named: list[bool]) -> bytes:
    """Return the payload of a list or a batch with some of its samples only."""
    if isinstance(samples, range):  # of the rows of a batch
        return select_rows(payload, named)
    return b"[" + b",".join(compress(samples, named)) + b"]"


class DuplicateFilter:
    """Remember the latest messages of a fleet, and drop those that come again.

    The memory has two halves for the whole fleet. New messages go to the new half. When it is full, it becomes the old
    half, and what was the old half is forgotten. A half is full with `PER_VEHICLE` messages for each vehicle that was
    known when it began, and at least `LEAST`. The halves turn over between two messages, never within a list. The state
    does therefore not depend on how messages are cut into batches. A message takes 10 to 20 bytes.

    Parameters
    ----------
    limits : Limits
        A list or batch that exceeds them is one message, as it will be refused as a whole.
    batches : BatchReader, optional
        Reader of batches, where another component reads the same batches.

    Attributes
    ----------
    dropped : int
        Number of samples and other messages that came again since the start of the process. It is not part of the
        state, because the state must not depend on how often a message was delivered.
    """

    def __init__(
        self,
        lanes: Lanes,
        limits: Limits = Limits(),  # noqa: B008 - immutable
        batches: BatchReader | None = None,
    ) -> None:
        self.dropped = 0
        self._lanes, self._limits = lanes, limits
        self._batches = batches or BatchReader(limits.list_samples)
        self._seeds = _KeySeeds()
        self._seeds_of_keys = KeyValues(self._seeds.__getitem__, np.uint64)
        self._new, self._old = (_make_table(np.empty(0, np.uint64), LEAST) for _ in range(2))
        self._count, self._most = 0, LEAST
        self._part = _Part(MessageBlock.of([]), None, np.empty(0, np.uint64), np.empty(0, np.bool_))

    def select_new(self, messages: Sequence[Message]) -> tuple[MessageBlock, MessageBlock]:
        """Return the messages that were not taken in before, and remember them; return the others too.

        Messages are taken up to the one at which the halves may turn over. Call `forget` with those that are refused
        before you give the others.

        Returns
        -------
        MessageBlock
            New messages, with lists and batches reduced to the samples that are new; the given block itself if all are
            new.
        """
        self._turn_over_if_full()
        self._batches.forget()
        messages = MessageBlock.of(messages)
        block, hashes, samples = self._hash_messages(messages, self._most - self._count)
        self._part = _Part(block, samples, hashes, self._remember(hashes))
        return self._part.select(self._part.is_new), messages[len(block) :]

    def hash(self, messages: Sequence[Message]) -> tuple[Hashes, list[Sequence[Any]] | None]:
        """Return the hashes of the samples of messages, and the samples of each; None if each message is one.

        The samples of a batch are the numbers of its rows.
        """
        return self._hash_messages(MessageBlock.of(messages), None)[1:]

    def select_new_hashes(self, hashes: Hashes, message: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Remember samples by their hashes, and return which of them were not taken in before, as `select_new` does.

        They are taken up to the end of the message at which the halves turn over; call it again with the others.
        """
        self._turn_over_if_full()
        stop = self._most - self._count
        if stop < len(hashes):
            stop = int(np.searchsorted(message, message[stop - 1], side="right"))
        return self._remember(hashes[:stop])

    def _hash_messages(
        self, messages: MessageBlock, room: int | None
    ) -> tuple[MessageBlock, Hashes, list[Sequence[Any]] | None]:
        """Return messages up to the one that fills the room, the hashes of their samples, and the samples of each."""
        several = self._split_several(messages, inf if room is None else room)
        if room is not None:
            extra = sum(len(hashes) - 1 for _, hashes in several.values())
            messages = messages[: max(max(several, default=-1) + 1, room - extra)]
        if not several:
            return messages, self._hash_whole(messages), None
        sizes, is_whole = np.ones(len(messages), np.int64), np.ones(len(messages), np.bool_)
        sizes[list(several)], is_whole[list(several)] = [len(hashes) for _, hashes in several.values()], False
        ends, samples = np.cumsum(sizes), [_WHOLE] * len(messages)
        all_hashes = np.empty(int(ends[-1]), np.uint64)
        all_hashes[ends[is_whole] - 1] = self._hash_whole(messages.take(is_whole))
        for at, (of_message, hashes) in several.items():
            samples[at] = of_message
            all_hashes[ends[at] - len(hashes) : ends[at]] = hashes
        return messages, all_hashes, samples

    def _hash_whole(self, messages: MessageBlock) -> Hashes:
        """Return the hash of each message, whose payload is one sample."""
        hashes = np.empty(len(messages), np.uint64)
        columns, seeds = messages.columns, self._seeds_of_keys.get(messages)
        hash_texts(columns.text, columns.words, columns.starts, columns.sizes, seeds, hashes)
        return hashes

    def forget(self, refusals: Sequence[Refused]) -> MessageBlock:
        """Forget refused messages, and return those that were dropped because they repeated one of them."""
        part = self._part
        if not refusals:
            return part.messages[:0]
        hashes = np.concatenate([self._hash_refused(message, samples) for message, samples, _ in refusals])
        self._count -= _forget(hashes, self._new)
        repeated = ~part.is_new
        if repeated.any():
            repeated &= np.isin(part.hashes, hashes)
        if not (count := int(np.count_nonzero(repeated))):
            return part.messages[:0]
        self.dropped -= count
        return part.select(repeated)

    def _hash_refused(self, message: Message, samples: Sequence[Any] | None) -> Hashes:
        """Return the hashes of the refused samples of a message, of all without samples."""
        own, hashes = self._split_samples(message)
        if samples is None:
            return hashes
        return hashes[list(samples)] if isinstance(own, range) else self._hash_texts(message.key, samples)

    def _hash_texts(self, key: str, texts: Sequence[Any]) -> Hashes:
        """Return the hashes of samples in JSON, or of any payload."""
        seed = self._seeds[key]
        return np.array([xxh64_intdigest(text, seed) for text in texts], np.uint64)

    def _split_several(self, messages: MessageBlock, room: float) -> dict[int, tuple[Sequence[Any], Hashes]]:
        """Return the samples of lists and batches and their hashes, up to the one that fills the room."""
        several: dict[int, tuple[Sequence[Any], Hashes]] = {}
        extra = 0
        first = messages.get_first_bytes()
        if any(messages[at].payload.startswith(PREFIX) for at in np.flatnonzero(first == PREFIX[0]).tolist()):
            messages.make_objects()  # the decoder receives the same batches, and finds them read
        for at in np.flatnonzero(first != _BRACE).tolist():  # a sample begins with {
            if at + extra >= room:
                break
            message = messages[at]
            samples, hashes = self._split_samples(message)
            if len(samples) != 1 or samples[0] is not message.payload:
                several[at] = samples, hashes
                extra += len(samples) - 1
        return several

    def _split_samples(self, message: Message) -> tuple[Sequence[Any], Hashes]:
        """Return the samples of a list, the row numbers of a batch, or the payload, and a hash of each.

        A row of a batch is a sample of its car, whichever batch of whichever gateway it comes in.
        """
        key, payload, _ = message
        parts: Sequence[Any] = [payload]
        if len(payload) > self._limits.payload_bytes:
            pass
        elif payload.startswith(PREFIX) and key.endswith((f"/{BATCH}", "/telemetry")):
            if not isinstance(rows := self._batches.read(payload), str):
                return range(len(rows.is_usable)), rows.hash()
        elif payload.lstrip()[:1] == b"[" and key.endswith("/telemetry"):
            with suppress(*UNREADABLE):
                parts = _raw_list.decode(payload)
            parts = parts if 0 < len(parts) <= self._limits.list_samples else [payload]
        return parts, self._hash_texts(key, parts)

    def _remember(self, hashes: Hashes) -> NDArray[np.bool_]:
        """Remember hashes; return which of them were not remembered before."""
        is_new = np.empty(len(hashes), np.bool_)
        wanted = self._count + len(hashes)
        if 5 * wanted > 4 * len(self._new):  # it grows only as far as it is used
            self._new = _make_table(self._new[self._new != 0], 2 * wanted)
        count = _remember(hashes, self._new, self._old, is_new)
        self._count += count
        self.dropped += len(hashes) - count
        return is_new

    def _turn_over_if_full(self) -> None:
        """Begin a new half if the present one is full; an empty one has room for the vehicles that are known."""
        if self._count >= self._most:
            self._old, self._new = self._new, _make_table(np.empty(0, np.uint64), LEAST)
            self._count = 0
        if not self._count:
            self._most = max(LEAST, PER_VEHICLE * len(self._lanes))

    def dump(self) -> Any:
        """Return the room of the new half, and the hashes of both halves as bytes, each in ascending order."""
        self._turn_over_if_full()
        return [self._most, *(_list_hashes(half).astype("<u8").tobytes() for half in (self._new, self._old))]

    def load(self, state: Any) -> None:
        """Replace the remembered messages by those that `dump` returned."""
        self._most, *halves = state
        new, old = (np.frombuffer(half, "<u8").astype(np.uint64) for half in halves)
        self._new, self._old = _make_table(new, LEAST), _make_table(old, LEAST)
        self._count = int(np.count_nonzero(self._new))


def _make_table(hashes: Hashes, room: int) -> Hashes:
    """Return a table of hashes with room for a number of them; a place that is zero is empty."""
    table = np.zeros(1 << (5 * max(room, len(hashes)) // 4).bit_length(), np.uint64)
    _remember(hashes, table, np.zeros(1, np.uint64), np.empty(len(hashes), np.bool_))
    return table


def _list_hashes(table: Hashes) -> Hashes:
    """Return the hashes in a table in ascending order."""
    return np.sort(table[table != 0])


class _KeySeeds(dict[str, int]):
    """Map a key to the seed of the hashes of its payloads."""

    def __missing__(self, key: str) -> int:
        seed = xxh64_intdigest(key.encode(errors="surrogatepass"))
        if len(key) <= LONGEST_KEY:
            if len(self) >= 1 << 16:  # strangers may make up keys
                self.clear()
            self[key] = seed
        return seed


@njit(cache=True)
def _remember(hashes: Any, table: Any, other: Any, is_new: Any) -> int:
    """Remember those hashes in a table with linear probing that neither it nor another table holds.

    `is_new` receives which hashes were not remembered before. The function returns their number.
    """
    one, none, count = np.uint64(1), np.uint64(0), 0
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
    return count


@njit(cache=True)
def _forget(hashes: Any, table: Any) -> int:
    """Remove those hashes that a table with linear probing holds; return their number."""
    one, none, count = np.uint64(1), np.uint64(0), 0
    mask = np.uint64(len(table) - 1)
    for i in range(len(hashes)):
        value = hashes[i] if hashes[i] != none else one
        hole = value & mask
        while table[hole] != none and table[hole] != value:
            hole = (hole + one) & mask
        if table[hole] == none:
            continue
        count += 1
        at = (hole + one) & mask
        while table[at] != none:  # what was put behind it moves up, as far as its own place
            if ((at - table[at]) & mask) >= ((at - hole) & mask):
                table[hole] = table[at]
                hole = at
            at = (at + one) & mask
        table[hole] = none
    return count
