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
from socast.core.wire.message_block import PADDING, Bytes, MessageBlock, copy_spans, get_words
from socast.stream.mcap_format import MESSAGE_HEAD, RECORD

ZSTD: Final = b"zstd"
"""Compression of chunks."""
_HEAD_FIELDS: Final = "opcode", "length", "channel", "sequence", "log_time", "publish_time", "first_byte"
_HEAD: Final = np.dtype(list(zip(_HEAD_FIELDS, ("u1", "<u8", "<u2", "<u4", "<u8", "<u8", "u1"), strict=True)))
"""Start of a message record as in `MESSAGE_HEAD`, and the byte after it."""
_INDEX_HEAD: Final = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("size", "<u4"), ("first_byte", "u1")]
)
"""Start of a message index, and the byte after it; sizes. [B]"""
_PLACE: Final = np.dtype([("channel", "<u2"), ("place", "<u8")])
"""Entry of a chunk index: where the message index of a channel begins. [B]"""
_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
"""Body of a chunk index up to its entries: span [ns], place and size of the chunk [B], size of the entries [B]."""
_CHUNK_INDEX_END: Final = struct.Struct(f"<QI{len(ZSTD)}sQQ")
"""The rest: size of the message indexes [B], compression, size of the chunk's records, compressed and not [B]."""
_ENTRY: Final = np.dtype([("channel", "i8"), ("log_time", "u8"), ("offset", "u8")])
"""Row of the index of messages: its time of receipt [ns] and its place in the records [B]."""
Compressor = Callable[[bytes], bytes]
_END_US: Final = float(2**64 // 1000 + 1)
"""First time that nanoseconds in 64 bits cannot hold. [us]"""


class PackedChunk(NamedTuple):
    """Hold a chunk as it is written.

    Parameters
    ----------
    record, indexes : bytes, memoryview
        The chunk record, and the message index records, one of each channel.
    channels, counts, places : (channels,) int
        Numbers of the channels, of their messages, and the place of the index of each in `indexes`. [B]
    span : tuple of int
        First and last time of receipt. [ns]
    size, packed_size : int
        Size of the records, and compressed. [B]
    """

    record: bytes
    indexes: memoryview
    channels: Ints
    counts: Ints
    places: Ints
    span: tuple[int, int]
    size: int
    packed_size: int

    def describe(self, offset: int) -> bytes:
        """Return the chunk index record of a chunk that begins at a place of the file, which its indexes follow."""
        places = np.empty(len(self.channels), _PLACE)
        places["channel"], places["place"] = self.channels, self.places + offset + len(self.record)
        body = _CHUNK_INDEX.pack(*self.span, offset, len(self.record), places.nbytes) + places.tobytes()
        body += _CHUNK_INDEX_END.pack(len(self.indexes), len(ZSTD), ZSTD, self.packed_size, self.size)
        return RECORD.pack(Opcode.CHUNK_INDEX, len(body)) + body


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
            used = [channels[for_viewers][block.columns.keys[number]] for number in numbers.tolist()]
            for record in [each for channel in used for each in records[channel - 1]]:
                if record not in described:
                    described.add(record)
                    parts.append(record)
            data, entries = _make_records(block, np.array(used)[at])
            entries["offset"] += np.uint64(sum(map(len, parts)))
            parts.append(data)
            rows.append(entries)
        return _pack(b"".join(parts), np.concatenate(rows), compress) if rows else None


def _make_records(block: MessageBlock, channels: Ints) -> tuple[memoryview, NDArray[np.void]]:
    """Return the records of messages on their channels, and the rows of their index."""
    columns = block.columns
    heads = np.zeros(len(columns.sizes), _HEAD)
    heads["opcode"], heads["length"] = Opcode.MESSAGE, columns.sizes + MESSAGE_HEAD.size - RECORD.size
    heads["channel"], heads["log_time"] = channels, block.receipt_ns
    heads["publish_time"] = _find_publish_times(block)
    records, places = _interleave(heads, columns.text, columns.starts, columns.sizes)
    entries = np.empty(len(places), _ENTRY)
    entries["channel"], entries["log_time"], entries["offset"] = channels, heads["log_time"], places
    return records, entries


def _pack(data: bytes, entries: NDArray[np.void], compress: Compressor) -> PackedChunk:
    """Return the chunk of records and the rows of their index."""
    packed, first, last = compress(data), int(entries["log_time"].min()), int(entries["log_time"].max())
    record = encode_record(Chunk(ZSTD.decode(), packed, last, first, zlib.crc32(data), len(data)))
    entries = entries[np.argsort(entries["channel"], kind="stable")]
    text = np.zeros((len(entries) + PADDING, 2), "<u8")
    text[: len(entries), 0], text[: len(entries), 1] = entries["log_time"], entries["offset"]
    channels, begins, counts = np.unique(entries["channel"], return_index=True, return_counts=True)
    size = text[0].nbytes
    heads = np.zeros(len(channels), _INDEX_HEAD)
    heads["opcode"] = Opcode.MESSAGE_INDEX
    heads["length"] = size * counts + _INDEX_HEAD.itemsize - 1 - RECORD.size
    heads["channel"], heads["size"] = channels, size * counts
    indexes, places = _interleave(heads, text.reshape(-1).view(np.uint8), size * begins, size * counts)
    return PackedChunk(record, indexes, channels, counts, places, (first, last), len(data), len(packed))


def _interleave(heads: NDArray[np.void], text: Bytes, starts: Ints, sizes: Ints) -> tuple[memoryview, Ints]:
    """Return heads, each with a span of a buffer after it, and their places. [B]

    The last byte of a head becomes the first one of its span, so that both are copied as whole words. The buffer needs
    `PADDING` bytes after the last span.
    """
    heads["first_byte"] = text[starts]
    heads.flags.writeable = text.flags.writeable = False  # as the kernel is compiled for
    head_sizes = np.full_like(sizes, heads.itemsize)
    lengths = sizes + heads.itemsize - 1
    places = np.cumsum(lengths) - lengths
    out = np.empty(int(lengths.sum()) + PADDING, np.uint8)
    words, head_starts = get_words(out), np.cumsum(head_sizes) - heads.itemsize
    copy_spans(get_words(text), starts, sizes, places + heads.itemsize - 1, words)
    copy_spans(get_words(heads.view(np.uint8)), head_starts, head_sizes, places, words)
    return out.data[:-PADDING], places


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
