"""Find the messages of a chunk in one compiled loop, which takes nanoseconds per message."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Ints
from socast.core.compiled_cache import njit
from socast.core.wire.message_block import PADDING, Bytes, get_words
from socast.stream.mcap_format import CHANNEL, MESSAGE, MESSAGE_HEAD, RECORD, SCHEMA

_HEAD: Final = MESSAGE_HEAD.size
_RECORD_HEAD: Final = RECORD.size
_CHANNEL_AT: Final = _RECORD_HEAD
_TIME_AT: Final = _RECORD_HEAD + 6  # after channel and sequence


class ChunkRecords(NamedTuple):
    """Locate the records of a chunk up to the first damaged one.

    Parameters
    ----------
    data : bytes
        The chunk, with `PADDING` bytes after it.
    starts, sizes : (n,) int
        Begin and size of the payload of each message. [B]
    channel : (n,) int
        Channel of each message.
    receipts : (n,) uint64
        Log time of each message. [Unix ns]
    descriptions : (m, 2) int
        Begin of each schema and channel [B], and number of messages before it.
    is_damaged : bool
        Whether a record reaches beyond the chunk, or is no record.
    """

    data: bytes
    text: Bytes
    starts: Ints
    sizes: Ints
    channel: Ints
    receipts: NDArray[np.uint64]
    descriptions: Ints
    is_damaged: bool

    def get_description(self, at: int) -> tuple[int, bytes]:
        """Return the opcode and the body of the schema or channel that begins at a place."""
        opcode, length = RECORD.unpack_from(self.data, at)
        at += RECORD.size
        return opcode, self.data[at : at + length]


_NONE: Final = np.empty(0, np.int64)
NO_RECORDS: Final = ChunkRecords(
    bytes(PADDING),
    np.zeros(PADDING, np.uint8),
    _NONE,
    _NONE,
    _NONE,
    _NONE.astype(np.uint64),
    np.empty((0, 2), np.int64),
    False,
)
"""Records of a chunk that could not be read."""


def scan_chunk(data: bytes) -> ChunkRecords:
    """Return the places of messages and descriptions in a chunk."""
    end, data = len(data), data + bytes(PADDING)
    text = np.frombuffer(data, np.uint8)
    most = end // _HEAD
    starts, sizes, channel = np.empty((3, most), np.int64)
    receipts = np.empty(most, np.uint64)
    descriptions = np.empty((end // _RECORD_HEAD, 2), np.int64)
    stop, count, described = _scan(text, get_words(text), end, starts, sizes, channel, receipts, descriptions)
    starts, sizes, channel = (column[:count].copy() for column in (starts, sizes, channel))
    return ChunkRecords(
        data, text, starts, sizes, channel, receipts[:count].copy(), descriptions[:described].copy(), stop < end
    )


@njit(cache=True)
def _scan(
    text: Any, words: Any, end: int, starts: Any, sizes: Any, channel: Any, receipts: Any, descriptions: Any
) -> tuple[int, int, int]:
    """Locate records; return where the first damaged one begins, or the end, and the numbers of what was found."""
    at, count, described = 0, 0, 0
    while at < end:
        opcode, room = text[at], end - at - _RECORD_HEAD
        if opcode == 0 or room < 0 or words[at + 1] > np.uint64(room):
            break
        length: Any = np.int64(words[at + 1])
        if opcode == MESSAGE:
            if length < _HEAD - _RECORD_HEAD:
                break
            starts[count], sizes[count] = at + _HEAD, length - (_HEAD - _RECORD_HEAD)
            channel[count] = text[at + _CHANNEL_AT] + 256 * np.int64(text[at + _CHANNEL_AT + 1])
            receipts[count] = words[at + _TIME_AT]
            count += 1
        elif opcode in (SCHEMA, CHANNEL):
            descriptions[described, 0], descriptions[described, 1] = at, count
            described += 1
        at += _RECORD_HEAD + length
    return at, count, described
