"""A chunk of a recording: the records of messages as bytes, and their indexes, made from columns.

The `mcap` package needs 5 to 7 us for a message, and the columns of a chunk about one, of which compression takes half.

References
----------
MCAP format specification, https://mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
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
_ENTRY: Final = np.dtype([("channel", "i8"), ("log_time", "u8"), ("offset", "u8")])
"""Row of the index of messages: its time of receipt [ns] and its place in the records [B]."""
_INDEX_HEAD: Final = struct.Struct("<BQHI")
"""Start of a message index: opcode, length [B], channel, size of the entries [B]."""
Compressor = Callable[[bytes], bytes]
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
    """Gather messages, and make the records of a chunk of all of them at once.

    Attributes
    ----------
    size : int
        Size of the records of the messages so far. [B]
    """

    def __init__(self) -> None:
        self.size = 0
        self._blocks: dict[bool, list[MessageBlock]] = {}

    def put(self, block: MessageBlock, *, for_viewers: bool) -> None:
        """Add messages, on the channels of viewers or on the others."""
        size = block.size
        self._blocks.setdefault(for_viewers, []).append(block.compact() if block.is_sparse(size) else block)
        self.size += size + MESSAGE_HEAD.size * len(block)

    def pack(
        self, channels: Sequence[Mapping[str, int]], records: Sequence[Sequence[bytes]], compress: Compressor
    ) -> PackedChunk | None:
        """Return the chunk, compressed with zstd; None without messages.

        Parameters
        ----------
        channels : sequence of mapping of str to int
            Key -> number of its channel, for messages and for those of viewers.
        records : sequence of sequence of bytes
            Records that the chunk needs before the first message of each channel, from channel 1 on.
        """
        parts: list[bytes | memoryview] = []
        described: set[bytes] = set()
        rows: list[NDArray[np.void]] = []
        for for_viewers, blocks in self._blocks.items():
            block = MessageBlock.join(blocks)
            numbers, at = np.unique(block.columns.key, return_inverse=True)
            keys = block.columns.keys
            used = [channels[for_viewers][keys[number]] for number in numbers.tolist()]
            for record in [each for channel in used for each in records[channel - 1]]:
                if record not in described:
                    described.add(record)
                    parts.append(record)
            begin = sum(map(len, parts))
            data, entries = _make_records(block, np.array(used)[at])
            entries["offset"] += np.uint64(begin)
            parts.append(data)
            rows.append(entries)
        return _pack(b"".join(parts), np.concatenate(rows), compress) if rows else None


def _make_records(block: MessageBlock, channels: Ints) -> tuple[memoryview, NDArray[np.void]]:
    """Return the records of messages on their channels, and the rows of their index."""
    columns = block.columns
    sizes, lengths = columns.sizes, columns.sizes + MESSAGE_HEAD.size
    places = np.cumsum(lengths) - lengths
    heads = np.zeros(len(sizes), _HEAD)
    heads["opcode"] = Opcode.MESSAGE
    heads["length"] = lengths - RECORD.size
    heads["channel"] = channels
    heads["log_time"] = block.receipt_ns
    heads["publish_time"] = _find_publish_times(block)
    heads["first_byte"] = columns.text[columns.starts]
    heads.flags.writeable = False  # as the kernel is compiled for
    size = int(lengths.sum())
    out = np.empty(size + PADDING, np.uint8)
    copy_spans(columns.words, columns.starts, sizes, places + MESSAGE_HEAD.size, get_words(out))
    head_sizes = np.full_like(sizes, _HEAD.itemsize)
    head_starts = np.cumsum(head_sizes) - _HEAD.itemsize
    copy_spans(get_words(heads.view(np.uint8)), head_starts, head_sizes, places, get_words(out))
    entries = np.empty(len(sizes), _ENTRY)
    entries["channel"], entries["log_time"], entries["offset"] = channels, heads["log_time"], places
    return out.data[:size], entries


def _pack(data: bytes, entries: NDArray[np.void], compress: Compressor) -> PackedChunk:
    """Return the chunk of records and the rows of their index."""
    packed, times = compress(data), entries["log_time"]
    first, last = int(times.min()), int(times.max())
    record = encode_record(Chunk("zstd", packed, last, first, zlib.crc32(data), len(data)))
    ordered = entries[np.argsort(entries["channel"], kind="stable")]
    pairs = np.stack([ordered["log_time"], ordered["offset"]], axis=1)
    used, begins = np.unique(ordered["channel"], return_index=True)
    ends = [*begins[1:].tolist(), len(pairs)]
    indexes, counts = [], {}
    for channel, begin, end in zip(used.tolist(), begins.tolist(), ends, strict=True):
        entry = pairs[begin:end].tobytes()
        length = _INDEX_HEAD.size - RECORD.size + len(entry)
        indexes.append(_INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, length, channel, len(entry)) + entry)
        counts[channel] = end - begin
    return PackedChunk(record, indexes, counts, (first, last), len(data), len(packed))


def encode_record(record: Any) -> bytes:
    """Return the bytes of a record of the `mcap` package."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _find_publish_times(block: MessageBlock) -> NDArray[np.uint64]:
    """Return the senders' times, or that of receipt where a payload has no valid time or is a batch, (n,). [ns]"""
    with np.errstate(over="ignore"):
        microseconds = np.rint(read_each_time(block) * 1e6)  # a float of Unix time resolves 0.25 us
    is_valid = (microseconds >= 0.0) & (microseconds < _END_US)
    times = np.where(is_valid, microseconds, 0.0).astype(np.uint64) * np.uint64(1000)
    return np.where(is_valid, times, block.receipt_ns)
