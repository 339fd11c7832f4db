"""Messages as columns: their payloads lie in one buffer, and most of them never become objects.

The reader of recordings makes a block of each chunk. What a transport delivers as objects becomes a block where the
pipeline takes it, so that live messages and recorded ones go the same way.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import compress, repeat
from typing import Any, Final, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Ints
from socast.core.compiled_cache import njit
from socast.core.wire.messages import Message

PADDING: Final = 32
"""Size of the buffer after the last payload, so that whole words can be read from any place of a payload. [B]"""

_LARGE: Final = 4096
"""Size above which a payload is rather a batch than a sample. [B]"""

Bytes = NDArray[np.uint8]


class MessageColumns(NamedTuple):
    """Hold n messages as columns.

    Parameters
    ----------
    key : (n,) int
        Number of each message's key in `keys`.
    text : (size,) uint8
        Buffer with the payloads, and at least `PADDING` bytes after the last one. It is read-only, as the kernels are
        compiled for that.
    starts, sizes : (n,) int
        Begin of each payload in the buffer, and its size. [B]
    receipts : (n,) uint64, optional
        Unix times of receipt, None where the messages are objects. [ns]
    """

    keys: Sequence[str]
    key: Ints
    text: Bytes
    starts: Ints
    sizes: Ints
    receipts: NDArray[np.uint64] | None = None

    @property
    def words(self) -> NDArray[np.uint64]:
        """Return the eight bytes from each place of the buffer on, as whole numbers."""
        return get_words(self.text)

    def select(self, which: Any) -> "MessageColumns":
        """Return some of the messages, in the same buffer."""
        receipts = None if self.receipts is None else self.receipts[which]
        return self._replace(key=self.key[which], starts=self.starts[which], sizes=self.sizes[which], receipts=receipts)


class MessageBlock(Sequence[Message]):
    """Hold n messages in their order; columns and `Message` objects are made only where they are asked for.

    Examples
    --------
    >>> block = MessageBlock.of([Message("fleet/a/telemetry", b"{}", 5), Message("fleet/b/ride", b"[]", 6)])
    >>> len(block), block[1].key, block[:1] == [Message("fleet/a/telemetry", b"{}", 5)]
    (2, 'fleet/b/ride', True)
    """

    def __init__(self, columns: MessageColumns | None, objects: list[Message] | None = None) -> None:
        self._columns, self.objects = columns, objects

    @classmethod
    def of(cls, messages: Sequence[Message]) -> "MessageBlock":
        """Return messages as a block; a block itself."""
        return messages if isinstance(messages, MessageBlock) else cls(None, list(messages))

    @classmethod
    def pack(cls, keys: Sequence[str], key: Sequence[int], payloads: list[bytes], receipt_ns: int) -> "MessageBlock":
        """Return n messages that were received at once."""
        columns = _join_payloads(keys, np.array(key, np.int64), payloads)
        return cls(columns._replace(receipts=np.full(len(payloads), receipt_ns, np.uint64)))

    @property
    def columns(self) -> MessageColumns:
        """Return the messages as columns."""
        if self._columns is None:
            self._columns = _make_columns(self.objects or [])
        return self._columns

    @classmethod
    def join(cls, parts: Iterable[Sequence[Message]]) -> "MessageBlock":
        """Return the messages of parts one after another; those of a single part are not copied."""
        blocks = [cls.of(part) for part in parts if len(part)]
        if len(blocks) <= 1:
            return blocks[0] if blocks else cls.of([])
        if not any(block.has_columns for block in blocks):
            return cls(None, [message for block in blocks for message in block.objects or ()])
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
    def receipt_ns(self) -> NDArray[np.uint64]:
        """Return the Unix times of receipt, (n,). [ns]"""
        if (receipts := self.columns.receipts) is None:
            receipts = np.array([message[2] for message in self.objects or ()], np.uint64)
        return receipts

    @property
    def size(self) -> int:
        """Return the size of all payloads. [B]"""
        if self._columns is None:
            return sum(len(message[1]) for message in self.objects or ())
        return int(self._columns.sizes.sum())

    @property
    def has_columns(self) -> bool:
        """Return whether columns have been made."""
        return self._columns is not None

    def is_sparse(self, size: int) -> bool:
        """Return whether payloads of this size [B] take a small part of their buffer, which other messages fill."""
        return self._columns is not None and len(self._columns.text) > 16 * (size + PADDING)

    def list_keys(self) -> set[str]:
        """Return the different keys of the messages."""
        if self._columns is None:
            return {message[0] for message in self.objects or ()}
        keys, key = self._columns[:2]
        return {keys[number] for number in set(key.tolist())}

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
        return MessageBlock(None if self._columns is None else self._columns.select(which), objects)

    def get_first_bytes(self) -> Bytes:
        """Return the first byte of each payload, 0 for an empty one."""
        if self._columns is None and self.objects and len(self.objects[0].payload) > _LARGE:  # they need not be copied
            return np.frombuffer(b"".join([message[1][:1] or b"\0" for message in self.objects]), np.uint8)
        columns = self.columns
        return np.where(columns.sizes > 0, columns.text[columns.starts], np.uint8(0))

    def __len__(self) -> int:
        return len(self.columns.starts) if self.objects is None else len(self.objects)

    @overload
    def __getitem__(self, at: int) -> Message: ...

    @overload
    def __getitem__(self, at: slice) -> "MessageBlock": ...

    def __getitem__(self, at: int | slice) -> "Message | MessageBlock":
        """Return a message, or a part of the messages that shares the buffer."""
        if isinstance(at, slice):
            columns = None if self._columns is None else self._columns.select(at)
            return MessageBlock(columns, None if self.objects is None else self.objects[at])
        if self.objects is not None:
            return self.objects[at]
        keys, key, text, starts, sizes, _ = self.columns
        payload = text[starts[at] : starts[at] + sizes[at]].tobytes()
        return Message(keys[key[at]], payload, int(self.receipt_ns[at]))

    def __iter__(self) -> Iterator[Message]:
        """Iterate over the messages as objects."""
        if self.objects is not None or not len(self):
            return iter(self.objects or ())
        keys, key, text, starts, sizes, _ = self.columns
        stops, first = starts + sizes, starts.min()
        part = text[first : stops.max()].tobytes()
        payloads = map(part.__getitem__, map(slice, (starts - first).tolist(), (stops - first).tolist()))
        fields = zip(map(keys.__getitem__, key.tolist()), payloads, self.receipt_ns.tolist(), strict=True)
        return map(tuple.__new__, repeat(Message), fields)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"MessageBlock.of({list(self)!r})"


class KeyValues:
    """Find a value for the key of each message, and keep those of the last table of keys.

    Blocks of one source share a table of keys, to which the source may append. The function is therefore called once
    for a key of a source, and not for each message.

    Parameters
    ----------
    unknown : object, optional
        Result that may change later: a key with this value is looked up again.

    Examples
    --------
    >>> block = MessageBlock.of([Message("fleet/a/telemetry", b"{}", 5), Message("fleet/b/ride", b"[]", 6)])
    >>> KeyValues(len, np.int64).get(block).tolist()
    [17, 12]
    """

    def __init__(self, find: Callable[[str], Any], dtype: Any, unknown: Any = None) -> None:
        self._find, self._dtype, self._unknown = find, dtype, unknown
        self.forget()

    def forget(self) -> None:
        """Forget all values."""
        self._keys: Sequence[str] = ()
        self._values = np.empty(0, self._dtype)

    def get(self, block: MessageBlock) -> NDArray[Any]:
        """Return the values of the keys of the n messages of a block, (n,)."""
        keys, key = block.columns[:2]
        known = len(self._values) if keys is self._keys else 0
        if len(keys) > known:
            new = keys[known:] if known else keys
            self._values = np.concatenate([self._values[:known], np.fromiter(map(self._find, new), self._dtype)])
        self._keys = keys
        values: NDArray[Any] = self._values[key]
        if self._unknown is not None and (is_unknown := values == self._unknown).any():
            again = np.unique(key[is_unknown])
            self._values[again] = [self._find(keys[number]) for number in again.tolist()]
            values = self._values[key]
        return values


def get_words(text: Bytes) -> NDArray[np.uint64]:
    """Return the eight bytes from each place of a buffer on, as whole numbers in the same memory."""
    return np.ndarray(len(text) - 7, "<u8", text, strides=(1,))


def _make_columns(messages: list[Message]) -> MessageColumns:
    """Return messages as columns, without their times of receipt."""
    keys = [message[0] for message in messages]  # to number equal ones would cost more than it saves
    return _join_payloads(keys, np.arange(len(keys)), [message[1] for message in messages])


def _join_payloads(keys: Sequence[str], key: Ints, payloads: list[bytes]) -> MessageColumns:
    """Return payloads in one buffer, with the numbers of their keys."""
    sizes = np.fromiter(map(len, payloads), np.int64, len(payloads))
    text = np.frombuffer(b"\0".join([*payloads, bytes(PADDING)]), np.uint8)
    return MessageColumns(keys, key, text, np.cumsum(sizes + 1) - sizes - 1, sizes)


def _copy_blocks(blocks: Sequence[MessageBlock]) -> MessageBlock:
    """Return the messages of blocks, one or more, with a buffer of their own."""
    parts = [block.columns for block in blocks]
    sizes = np.concatenate([part.sizes for part in parts])
    starts = np.cumsum(sizes) - sizes
    text = np.empty(int(sizes.sum()) + PADDING, np.uint8)
    words, at = get_words(text), 0
    for part in parts:
        copy_spans(part.words, part.starts, part.sizes, starts[at : at + len(part.sizes)], words)
        at += len(part.sizes)
    text.flags.writeable = False
    keys, key = parts[0].keys, [part.key for part in parts]
    if any(part.keys is not keys for part in parts):
        keys = [each for part in parts for each in part.keys]
        firsts = np.cumsum([0, *(len(part.keys) for part in parts[:-1])])
        key = [part.key + first for part, first in zip(parts, firsts, strict=True)]
    columns = MessageColumns(keys, np.concatenate(key), text, starts, sizes)
    if all(block.objects is not None for block in blocks):
        return MessageBlock(columns, [each for block in blocks for each in block])
    return MessageBlock(columns._replace(receipts=np.concatenate([block.receipt_ns for block in blocks])))


@njit(cache=True)
def copy_spans(words: Any, starts: Any, sizes: Any, places: Any, out: Any) -> None:
    """Copy spans of a buffer to ascending places of another one; each may write up to 7 bytes after its own."""
    for i in range(len(starts)):
        start, place = starts[i], places[i]
        for k in range(0, sizes[i], 8):
            out[place + k] = words[start + k]
