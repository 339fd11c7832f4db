"""A chunk of a recording: the records of messages as bytes, and their indexes, made from columns.

The `mcap` package needs 5 to 7 us for a message, and the columns of a block less than one.

References
----------
MCAP format specification, https://mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from numpy.typing import NDArray

from socast.core.batch import Ints
from socast.core.wire.json_scanner import read_each_time
from socast.core.wire.message_block import PADDING, MessageBlock, copy_spans, get_words
from socast.stream.mcap_format import MESSAGE_HEAD, RECORD

_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
        ("first_byte", "u1"),
    ]
)
"""Start of a message record as in `MESSAGE_HEAD`, and the byte after it, so that whole words can be copied."""
_ENTRY: Final = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_INDEX_HEAD: Final = struct.Struct("<BQHI")
"""Start of a message index: opcode, length [B], channel, size of the entries [B]."""
_END_US: Final = float(2**64 // 1000 + 1)
"""First time that nanoseconds in 64 bits cannot hold. [us]"""


class PackedChunk(NamedTuple):
    """Hold a chunk as it is written.

    Parameters
    ----------
    record : bytes
        The chunk record.
    indexes : list of bytes
        Message index records, one of each channel in `counts`.
    counts : dict of int to int
        Channel -> number of its messages.
    span : tuple of int
        First and last time of receipt. [ns]
    size, packed_size : int
        Size of the records, and compressed. [B]
    """

    record: bytes
    indexes: list[bytes]
    counts: dict[int, int]
    span: tuple[int, int]
    size: int
    packed_size: int


class ChunkBuilder:
    """Gather the records of one chunk.

    Attributes
    ----------
    size : int
        Size of the records so far. [B]
    """

    def __init__(self) -> None:
        self.size = 0
        self._described: set[bytes] = set()
        self._parts: list[bytes | memoryview] = []
        self._channels: list[Ints] = []
        self._entries: list[NDArray[np.void]] = []

    def __bool__(self) -> bool:
        """Return whether the chunk has messages."""
        return bool(self._entries)

    def describe(self, *records: bytes) -> None:
        """Add records other than messages that the chunk does not have."""
        for record in records:
            if record not in self._described:
                self._described.add(record)
                self._parts.append(record)
                self.size += len(record)

    def put(self, block: MessageBlock, channels: Ints) -> None:
        """Add messages, one or more.

        Parameters
        ----------
        channels : (n,) int
            Numbers of their channels, which must have been described.
        """
        _, _, text, starts, sizes, _ = block.columns
        lengths = sizes + MESSAGE_HEAD.size
        places = np.cumsum(lengths) - lengths
        heads = np.zeros(len(sizes), _HEAD)
        heads["opcode"] = Opcode.MESSAGE
        heads["length"] = lengths - RECORD.size
        heads["channel"] = channels
        heads["log_time"] = block.receipt_ns
        heads["publish_time"] = _find_publish_times(block)
        heads["first_byte"] = text[starts]
        size = int(lengths.sum())
        out = np.empty(size + PADDING, np.uint8)
        copy_spans(get_words(text), starts, sizes, places + MESSAGE_HEAD.size, get_words(out))
        heads.flags.writeable = False  # as the kernel is compiled for
        head_sizes = np.full_like(sizes, _HEAD.itemsize)
        copy_spans(
            get_words(heads.view(np.uint8)), np.cumsum(head_sizes) - _HEAD.itemsize, head_sizes, places, get_words(out)
        )
        entries = np.empty(len(sizes), _ENTRY)
        entries["log_time"], entries["offset"] = heads["log_time"], self.size + places
        self._parts.append(out.data[:size])
        self._channels.append(channels)
        self._entries.append(entries)
        self.size += size

    def pack(self, compress: Callable[[bytes], bytes]) -> PackedChunk:
        """Return the chunk of one message or more, compressed with zstd."""
        data = b"".join(self._parts)
        packed = compress(data)
        channels, entries = np.concatenate(self._channels), np.concatenate(self._entries)
        times = entries["log_time"]
        span = int(times.min()), int(times.max())
        record = encode_record(Chunk("zstd", packed, span[1], span[0], zlib.crc32(data), len(data)))
        sorted_entries = entries[np.argsort(channels, kind="stable")].tobytes()
        used, counts = np.unique(channels, return_counts=True)
        indexes, at = [], 0
        for channel, count in zip(used.tolist(), counts.tolist(), strict=True):
            size = count * _ENTRY.itemsize
            head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, _INDEX_HEAD.size - RECORD.size + size, channel, size)
            indexes.append(head + sorted_entries[at : at + size])
            at += size
        counted = dict(zip(used.tolist(), counts.tolist(), strict=True))
        return PackedChunk(record, indexes, counted, span, len(data), len(packed))


def encode_record(record: Any) -> bytes:
    """Return the bytes of a record of the `mcap` package."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _find_publish_times(block: MessageBlock) -> NDArray[np.uint64]:
    """Return the senders' times, or that of receipt where a payload has no valid time or is a batch, (n,). [ns]"""
    microseconds = np.rint(read_each_time(block) * 1e6)  # a float of Unix time resolves 0.25 us
    is_valid = (microseconds >= 0.0) & (microseconds < _END_US)
    times = np.where(is_valid, microseconds, 0.0).astype(np.uint64) * np.uint64(1000)
    return np.where(is_valid, times, block.receipt_ns)
