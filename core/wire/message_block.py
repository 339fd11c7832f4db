"""Messages as columns: their payloads lie in one buffer, and most of them never become objects.

The reader of recordings makes a block of each chunk. What a transport delivers as objects becomes a block where the
pipeline takes it, so that live messages and recorded ones go the same way.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import compress, repeat
from typing import Any, Final, overload

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.batch import Ints
from core.wire.messages import Message

PADDING: Final = 32
"""Size of the buffer after the last payload, so that whole words can be read from any place of a payload. [B]"""

Bytes = NDArray[np.uint8]


class MessageBlock(Sequence[Message]):
    """Hold n messages in their order; `Message` objects are made only of those that are asked for.

    Parameters
    ----------
    keys : sequence of str
        Keys, which other blocks may share.
    key : (n,) int
        Number of each message's key in `keys`.
    text : (size,) uint8
        Buffer with the payloads, and at least `PADDING` bytes after the last one.
    starts, sizes : (n,) int
        Begin of each payload in the buffer, and its size. [B]
    receipts : (n,) uint64, optional
        Unix times of receipt. [ns]
    objects : list of n Message, optional
        The messages, where they are objects already; times of receipt may then be left out.

    Examples
    --------
    >>> block = MessageBlock.of([Message("fleet/a/telemetry", b"{}", 5), Message("fleet/b/ride", b"[]", 6)])
    >>> len(block), block[1].key, block[:1] == [Message("fleet/a/telemetry", b"{}", 5)]
    (2, 'fleet/b/ride', True)
    """

    def __init__(
        self,
        keys: Sequence[str],
        key: Ints,
        text: Bytes,
        starts: Ints,
        sizes: Ints,
        *,
        receipts: NDArray[np.uint64] | None = None,
        objects: list[Message] | None = None,
    ) -> None:
        self.keys, self.key, self.text, self.starts, self.sizes = keys, key, text, starts, sizes
        self._receipts, self.objects = receipts, objects

    @classmethod
    def of(cls, messages: Sequence[Message]) -> "MessageBlock":
        """Return messages as a block; a block itself."""
        if isinstance(messages, MessageBlock):
            return messages
        payloads = [message[1] for message in messages]
        sizes = np.fromiter(map(len, payloads), np.int64, len(payloads))
        text = np.frombuffer(b"\0".join(payloads) + bytes(PADDING), np.uint8)
        numbers: dict[str, int] = {}
        key = np.array([numbers.setdefault(message[0], len(numbers)) for message in messages], np.int64)
        return cls(list(numbers), key, text, np.cumsum(sizes + 1) - sizes - 1, sizes, objects=list(messages))

    @classmethod
    def join(cls, parts: Iterable[Sequence[Message]]) -> "MessageBlock":
        """Return the messages of parts one after another; those of a single part are not copied."""
        blocks = [cls.of(part) for part in parts if len(part)]
        if len(blocks) <= 1:
            return blocks[0] if blocks else cls.of([])
        return _copy_blocks(blocks)

    def compact(self) -> "MessageBlock":
        """Return the messages with a buffer of their own, so that they do not keep the memory of others."""
        return _copy_blocks([self])

    def make_objects(self) -> list[Message]:
        """Return the messages as objects, which are then kept."""
        if self.objects is None:
            self.objects = list(self)
        return self.objects

    @property
    def words(self) -> NDArray[np.uint64]:
        """Return the eight bytes from each place of the buffer on, as whole numbers."""
        return np.ndarray(len(self.text) - 7, "<u8", self.text, strides=(1,))

    @property
    def receipt_ns(self) -> NDArray[np.uint64]:
        """Return the Unix times of receipt, (n,). [ns]"""
        if self._receipts is None:
            self._receipts = np.array([message[2] for message in self.objects or ()], np.uint64)
        return self._receipts

    @property
    def size(self) -> int:
        """Return the size of all payloads. [B]"""
        return int(self.sizes.sum())

    def sort(self) -> "MessageBlock":
        """Return the messages in order of receipt; those with equal times keep their order."""
        times = self.receipt_ns
        if (times[1:] >= times[:-1]).all():
            return self
        return self.take(np.argsort(times, kind="stable"))

    def take(self, which: NDArray[Any]) -> "MessageBlock":
        """Return some of the messages, by their numbers or by a mask."""
        objects = self.objects
        if objects is not None:
            are_flags = which.dtype == np.bool_
            objects = list(compress(objects, which.tolist()) if are_flags else map(objects.__getitem__, which.tolist()))
        return self._select(which, objects)

    def _select(self, which: Any, objects: list[Message] | None) -> "MessageBlock":
        """Return a part of the columns, with its objects."""
        receipts = None if self._receipts is None else self._receipts[which]
        columns = self.key[which], self.text, self.starts[which], self.sizes[which]
        return MessageBlock(self.keys, *columns, receipts=receipts, objects=objects)

    def find_of_keys(self, find: Callable[[str], Any], dtype: Any) -> NDArray[Any]:
        """Return what a function returns for the key of each message; it is called once for a key.

        Parameters
        ----------
        find : callable
            Function of a key.
        dtype : dtype
            Type of its results.
        """
        is_used = np.zeros(len(self.keys), np.bool_)
        is_used[self.key] = True
        used = np.flatnonzero(is_used)
        found = np.empty(len(self.keys), dtype)
        found[used] = np.fromiter(map(find, [self.keys[number] for number in used.tolist()]), dtype, len(used))
        return found[self.key]

    def get_first_bytes(self) -> Bytes:
        """Return the first byte of each payload, 0 for an empty one."""
        return np.where(self.sizes > 0, self.text[self.starts], np.uint8(0))

    def __len__(self) -> int:
        return len(self.starts)

    @overload
    def __getitem__(self, at: int) -> Message: ...

    @overload
    def __getitem__(self, at: slice) -> "MessageBlock": ...

    def __getitem__(self, at: int | slice) -> "Message | MessageBlock":
        """Return a message, or a part of the messages that shares the buffer."""
        objects = self.objects
        if isinstance(at, slice):
            return self._select(at, None if objects is None else objects[at])
        if objects is not None:
            return objects[at]
        start = self.starts[at]
        payload = self.text[start : start + self.sizes[at]].tobytes()
        return Message(self.keys[self.key[at]], payload, int(self.receipt_ns[at]))

    def __iter__(self) -> Iterator[Message]:
        """Iterate over the messages as objects."""
        if self.objects is not None or not len(self):
            return iter(self.objects or ())
        stops = self.starts + self.sizes
        first = self.starts.min()
        text = self.text[first : stops.max()].tobytes()
        payloads = map(text.__getitem__, map(slice, (self.starts - first).tolist(), (stops - first).tolist()))
        fields = zip(map(self.keys.__getitem__, self.key.tolist()), payloads, self.receipt_ns.tolist(), strict=True)
        return map(tuple.__new__, repeat(Message), fields)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"MessageBlock.of({list(self)!r})"


def _copy_blocks(blocks: Sequence[MessageBlock]) -> MessageBlock:
    """Return the messages of blocks, one or more, with a buffer of their own."""
    sizes = np.concatenate([block.sizes for block in blocks])
    stops = np.cumsum(sizes)
    starts = stops - sizes
    text = np.zeros(int(sizes.sum()) + PADDING, np.uint8)
    keys: Sequence[str] = blocks[0].keys
    key = [block.key for block in blocks]
    if any(block.keys is not keys for block in blocks):
        keys = [each for block in blocks for each in block.keys]
        firsts = np.cumsum([0, *(len(block.keys) for block in blocks[:-1])])
        key = [block.key + first for block, first in zip(blocks, firsts, strict=True)]
    at = 0
    for block in blocks:
        _copy_payloads(block.text, block.starts, block.sizes, starts[at : at + len(block)], text)
        at += len(block)
    text.flags.writeable = False  # as of all blocks, for which the kernels are compiled
    columns = keys, np.concatenate(key), text, starts, sizes
    if all(block.objects is not None for block in blocks):
        return MessageBlock(*columns, objects=[each for block in blocks for each in block])
    return MessageBlock(*columns, receipts=np.concatenate([block.receipt_ns for block in blocks]))


@njit(cache=True)
def _copy_payloads(text: Any, starts: Any, sizes: Any, places: Any, out: Any) -> None:
    """Copy payloads to places of another buffer."""
    for i in range(len(starts)):
        start, place = starts[i], places[i]
        for k in range(sizes[i]):
            out[place + k] = text[start + k]
