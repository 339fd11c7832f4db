"""The MCAP reader, for recordings that are complete, unfinished or damaged.

The `mcap` package makes an object of every record, which takes 7 µs per message, and stops at the first invalid byte.
This reader decompresses a chunk and locates its messages in one compiled loop (`mcap_scan.py`); it makes no object of a
message. It counts the data that it cannot read, and leaves them out.

Files may be forged. Time and memory are therefore bounded, and time is linear in the size of the file: a chunk has at
most `LARGEST_CHUNK` bytes, all chunks together expand to at most `EXPANSION` times the bytes read and `ALLOWANCE`, at
most `MOST_HELD` bytes wait to be sorted, and a summary that contradicts the file is not used.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from math import inf
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import numpy as np
import zstandard

from core.batch import Ints
from core.errors import RecordingError
from core.wire.message_block import MessageBlock, MessageColumns
from stream.mcap_format import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    FOOTER_RECORD,
    FOR_VIEWERS,
    HEADER,
    LARGEST_CHUNK,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    METADATA,
    METADATA_NAME,
    RECORD,
    SCHEMA,
    STATISTICS,
    OversizedError,
    decode_channel,
    decode_metadata,
    decompress_chunk,
    explain_foreign_channel,
    iterate_strings,
    read_records,
)
from stream.mcap_losses import ALLOWANCE, EXPANSION, Losses
from stream.mcap_scan import NO_RECORDS, scan_chunk
from stream.waiting_messages import WaitingMessages

RAW_BLOCK: Final = 1 << 20
"""Approximate size of the blocks in which the reader takes messages outside chunks. [B]"""

MOST_YIELDED: Final = 16_000
"""Number of messages from which no further chunk is read before they are yielded; steps on many messages cost less."""
MOST_YIELDED_BYTES: Final = 8 << 20
"""Size of messages from which no further chunk is read before they are yielded. [B]"""
LARGEST_SUMMARY: Final = 64 << 20
"""Largest summary that is read of any file. [B]"""
SUMMARY_SHARE: Final = 8
"""Ratio of a large file to the largest summary that is read of it; with a larger one, a scan finds the chunks."""
LARGEST_DESCRIPTION: Final = 1 << 20
"""Largest schema or channel. [B]"""
MOST_DESCRIPTIONS: Final = 1 << 18
"""Largest number of descriptions that differ from the one before of the same number."""
DESCRIPTION_BYTES: Final = 64 << 20
"""Largest size of all schemas and channels together. [B]"""
LARGEST_METADATA: Final = 64 << 10
"""Largest metadata record. [B]"""
_STATISTICS: Final = struct.Struct("<QHIIII")  # messages, schemas, channels, attachments, metadata, chunks
_CHUNK_PLACE: Final = struct.Struct("<QQQQ")  # first time, last time, offset, length
_SPAN: Final = struct.Struct("<QQ")  # first and last time in the head of a chunk
_TAIL: Final = FOOTER_RECORD.size + len(MAGIC)
IN_ORDER: Final = "only a reader of the whole recording, in order, can use it; read it without --cluster"
_DAMAGE: Final = (ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError)


class _Block(NamedTuple):
    """Locate a run of messages in the file: a chunk, or messages outside chunks."""

    first_ns: int
    last_ns: int
    offset: int
    length: int
    chunked: bool


class McapSource:
    """Read an MCAP recording as a source that can be iterated repeatedly.

    Parameters
    ----------
    path : str or Path
        The recording.

    Attributes
    ----------
    losses : Losses
        Data that the current iteration could not read so far; complete after its end.
    blocks, blocks_read : int
        Number of chunks in the file, and number of chunks that the current iteration has read.
    schemas : dict
        Name of the schema by topic, for the topics read so far; an empty name for a topic without a schema.
    metadata : dict of str to str
        What wrote the recording, see `stream.recording_metadata`; empty if the file does not say.
    viewer_messages : Counter of str
        Number of messages by topic that the current iteration has left out because their channels are marked as
        `FOR_VIEWERS`.

    Raises
    ------
    RecordingError
        If the file is missing, empty, a directory or not MCAP, or if none of its channels follows the wire contract.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.losses = Losses()
        self.blocks_read = 0
        self.schemas: dict[str, str] = {}
        self.metadata: dict[str, str] = {}
        self.viewer_messages: Counter[str] = Counter()
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._topics: list[str] = []  # the keys of all blocks of messages
        self._numbers: dict[str, int] = {}
        self._key_of_channel = np.full(1 << 16, -1)
        self._foreign: dict[int, tuple[str, str]] = {}
        self._for_viewers: set[int] = set()
        self._learnt: dict[tuple[int, bytes], bytes] = {}
        self._learnt_bytes = self._changes = self._read_bytes = self._expanded = 0
        self._count: int | None = None
        try:
            with self.path.open("rb") as file:
                self._check(file)
                with suppress(*_DAMAGE):
                    self._read_metadata(file)
                self._blocks = self._read_index(file) or self._scan_chunks(file)
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be read: {(error.strerror or str(error)).lower()}") from error
        self._of_file = self.losses
        if self._count is not None:
            self._refuse_foreign()

    @property
    def blocks(self) -> int:
        """Return the number of chunks in the file."""
        return len(self._blocks)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last time of receipt, without reading the chunks. [ns]

        Returns
        -------
        tuple of (int, int) or None
            Unix times from the heads of the chunks; None if the recording holds no message.
        """
        full = [block for block in self._blocks if block.last_ns]
        return (min(block.first_ns for block in full), max(block.last_ns for block in full)) if full else None

    def __iter__(self) -> Iterator[MessageBlock]:
        """Yield the messages in order of receipt, some chunks at a time."""
        whole = self._of_file
        self.losses = Losses(whole.unfinished, whole.truncated_bytes, is_contradicted=whole.is_contradicted)
        self.viewer_messages = Counter()
        self._read_bytes = self._expanded = 0
        self.blocks_read = delivered = 0
        waiting, ready = WaitingMessages(), list[MessageBlock]()
        count = size = 0
        with self.path.open("rb") as file:
            for at, block in enumerate(self._blocks):
                messages = self._read_messages(file, block)
                self.blocks_read = at + 1
                following = self._blocks[at + 1].first_ns if at + 1 < len(self._blocks) else inf
                ready.append(waiting.release(messages, following))
                self.losses.disordered = waiting.disordered
                count, size = count + len(ready[-1]), size + ready[-1].size
                if count >= MOST_YIELDED or size >= MOST_YIELDED_BYTES or following == inf:
                    yield MessageBlock.join(ready)
                    delivered += count
                    ready, count, size = [], 0, 0
        left_out = self.losses.undescribed + self.losses.foreign.total() + self.viewer_messages.total()
        if self._count is not None:
            self.losses.missing_messages = max(0, self._count - delivered - left_out)
        if not delivered:
            self._refuse_foreign()

    @property
    def block_spans(self) -> list[tuple[int, int, int]]:
        """Return the first and last time of receipt [ns] and the size [B] of each chunk, in the order of time."""
        return [(block.first_ns, block.last_ns, block.length) for block in self._blocks]

    def read_span(self, start_ns: float, stop_ns: float) -> MessageBlock:
        """Return the messages received in a span of time, in the order of an iteration.

        `losses` and `viewer_messages` then count those of the chunks that begin in the span, so that the counts of
        spans that follow each other add up.

        Parameters
        ----------
        start_ns, stop_ns : float
            The first time, and the time before which the span ends; either may be infinite. [Unix ns]

        Raises
        ------
        RecordingError
            If a message is outside the span of time of its chunk, or if a chunk does not describe its channels.
        """
        counted, others = (Losses(), Counter[str]()), (Losses(), Counter[str]())
        parts: list[MessageBlock] = []
        with self.path.open("rb") as file:
            for block in self._blocks:
                is_own = start_ns <= block.first_ns < stop_ns
                if not is_own and not block.first_ns < start_ns <= block.last_ns:
                    continue
                self.losses, self.viewer_messages = counted if is_own else others
                self._read_bytes = self._expanded = 0
                parts.append(self._select_span(block, self._read_messages(file, block), start_ns, stop_ns))
        self.losses, self.viewer_messages = counted
        if self._count is None and self.losses.undescribed:
            raise RecordingError(f"{self.path} breaks off, and its chunks do not describe their channels: {IN_ORDER}")
        return MessageBlock.join(parts).sort()

    def _select_span(self, block: _Block, messages: MessageBlock, start_ns: float, stop_ns: float) -> MessageBlock:
        """Return those messages of a block that were received in a span of time."""
        times = messages.receipt_ns
        first_ns, last_ns = (int(times.min()), int(times.max())) if len(times) else (block.first_ns, block.last_ns)
        if first_ns < block.first_ns or last_ns > block.last_ns:
            raise RecordingError(f"{self.path} has messages outside the time span of their chunk: {IN_ORDER}")
        if start_ns <= first_ns and last_ns < stop_ns:
            return messages
        return messages.take((times >= start_ns) & (times < stop_ns))

    @property
    def count(self) -> int | None:
        """Return the number of messages by the summary; None without an intact one."""
        return self._count

    def _check(self, file: BinaryIO) -> None:
        """Refuse an empty file and a file that is not MCAP."""
        begin = file.read(len(MAGIC))
        if not begin:
            raise RecordingError(f"{self.path} is empty: 0 bytes; nothing was recorded")
        if begin != MAGIC:
            raise RecordingError(f"{self.path} is not an MCAP recording: it begins with {begin!r}, not {MAGIC!r}")

    def _read_metadata(self, file: BinaryIO) -> None:
        """Read the metadata records between the header and the first chunk."""
        opcode, length = RECORD.unpack(file.read(RECORD.size))
        if opcode == HEADER:
            file.seek(length, 1)
            opcode, length = RECORD.unpack(file.read(RECORD.size))
        while opcode == METADATA and length <= LARGEST_METADATA:
            name, entries = decode_metadata(file.read(length))
            if name == METADATA_NAME:
                self.metadata = entries
                return
            opcode, length = RECORD.unpack(file.read(RECORD.size))

    def _refuse_foreign(self) -> None:
        """Refuse a recording if none of its channels follows the wire contract."""
        if self._foreign and (self._key_of_channel < 0).all():
            _, reason = next(iter(self._foreign.values()))
            raise RecordingError(
                f"{self.path} is of another contract: {reason}; record with `socast live --record DIR`"
            )

    def _locate_summary(self, file: BinaryIO) -> tuple[int, int]:
        """Return the place of the summary and its size; a size of 0 without an intact summary."""
        size = file.seek(0, 2)
        if size < 2 * len(MAGIC) + _TAIL:
            return 0, 0
        file.seek(size - _TAIL)
        tail = file.read(_TAIL)
        opcode, _, start, _, crc = FOOTER_RECORD.unpack(tail[: FOOTER_RECORD.size])
        length = size - _TAIL - start
        most = max(LARGEST_SUMMARY, size // SUMMARY_SHARE)
        if opcode != FOOTER or not tail.endswith(MAGIC) or not start or not 0 <= length <= most:
            return 0, 0
        file.seek(start)
        found = 0
        for at in range(0, length if crc else 0, RAW_BLOCK):
            found = zlib.crc32(file.read(min(RAW_BLOCK, length - at)), found)
        is_damaged = crc and zlib.crc32(tail[: FOOTER_RECORD.size - 4], found) != crc
        return start, 0 if is_damaged else length

    def _read_index(self, file: BinaryIO) -> list[_Block]:
        """Return the chunks that the summary lists; an empty list without an intact summary that counts them."""
        start, length = self._locate_summary(file)
        blocks: list[_Block] = []
        count = chunks = None
        try:
            for opcode, body in read_records(file, start, length, LARGEST_DESCRIPTION):
                if opcode == CHUNK_INDEX:
                    first_ns, last_ns, offset, length = _CHUNK_PLACE.unpack_from(body)
                    blocks.append(_Block(first_ns, last_ns, offset, length, chunked=True))
                elif opcode == STATISTICS:
                    count, *_, chunks = _STATISTICS.unpack_from(body)
                else:
                    self._learn(opcode, body)
        except _DAMAGE:
            return []
        if chunks != len(blocks) or not _are_apart(blocks, start):
            self.losses.is_contradicted = bool(blocks) and chunks is not None
            return []
        self._count = count if blocks else None
        return sorted(blocks, key=itemgetter(0))

    def _scan_chunks(self, file: BinaryIO) -> list[_Block]:
        """Return the chunks found by a scan from record to record, up to the first incomplete record."""
        size, at = file.seek(0, 2), len(MAGIC)
        blocks: list[_Block] = []
        self.losses.unfinished = True
        while at + RECORD.size <= size:
            file.seek(at)
            head = file.read(MESSAGE_HEAD.size).ljust(MESSAGE_HEAD.size, b"\0")
            opcode, length = RECORD.unpack_from(head)
            end = at + RECORD.size + length
            if end > size or not opcode:
                break
            if opcode == CHUNK:
                first_ns, last_ns = _SPAN.unpack_from(head, RECORD.size)
                blocks.append(_Block(first_ns, last_ns, at, end - at, chunked=True))
            elif opcode == MESSAGE:
                _add_raw(blocks, int.from_bytes(head[15:23], "little"), at, end - at)
            elif opcode in {SCHEMA, CHANNEL}:
                file.seek(at + RECORD.size)
                with suppress(*_DAMAGE):  # its messages count as undescribed
                    self._learn(opcode, file.read(min(length, LARGEST_DESCRIPTION + 1)))
            at = end
            if opcode == DATA_END:
                self.losses.unfinished = False
                return self._order_blocks(file, blocks)
        self.losses.truncated_bytes = size - at
        return self._order_blocks(file, blocks)

    def _order_blocks(self, file: BinaryIO, blocks: list[_Block]) -> list[_Block]:
        """Return blocks by time; if the file has another order, first read the channels in the order of the file."""
        ordered = sorted(blocks, key=itemgetter(0))
        if ordered != blocks:
            for block in blocks:
                self._read_messages(file, block)
        return ordered

    def _learn(self, opcode: int, body: bytes) -> None:
        """Store a schema or a channel; ignore other records."""
        if opcode not in {SCHEMA, CHANNEL} or self._learnt.get((opcode, body[:2])) == body:
            return
        before = len(self._learnt.get((opcode, body[:2]), b""))
        if (
            len(body) > LARGEST_DESCRIPTION
            or self._changes >= MOST_DESCRIPTIONS
            or self._learnt_bytes + len(body) - before > DESCRIPTION_BYTES
        ):
            raise OversizedError(f"a description of {len(body):,} bytes, number {self._changes + 1:,}")
        self._changes += 1
        self._learnt_bytes += len(body) - before
        number = int.from_bytes(body[:2], "little")
        if opcode == SCHEMA:
            name, form, data = iterate_strings(body, 2, 3)
            self._schemas[number] = (name.decode(), form.decode(), data)
        else:
            topic, encoding, marks = decode_channel(body)
            wire = self._schemas.get(int.from_bytes(body[2:4], "little"), ("", "", b""))
            self.schemas[topic] = wire[0]
            is_for_viewers = marks == FOR_VIEWERS
            (self._for_viewers.add if is_for_viewers else self._for_viewers.discard)(number)
            reason = f"topic {topic} is for viewers" if is_for_viewers else ""
            reason = reason or explain_foreign_channel(topic, encoding, *wire)
            self._key_of_channel[number] = -1 if reason else self._number_topic(topic)
            if reason:
                self._foreign[number] = (topic, reason)
        self._learnt[opcode, body[:2]] = body

    def _number_topic(self, topic: str) -> int:
        """Return the number of a key."""
        number = self._numbers.setdefault(topic, len(self._topics))
        if number == len(self._topics):
            self._topics.append(topic)
        return number

    def _read_messages(self, file: BinaryIO, block: _Block) -> MessageBlock:
        """Return the messages of a block in the order of the file; of a damaged block those before the damage."""
        records, key, done = NO_RECORDS, np.empty(0, np.int64), 0
        try:
            records = scan_chunk(self._read_block(file, block))
            key = np.empty(len(records.channel), np.int64)
            for at, before in zip(*(map(int, column) for column in records.descriptions.T), strict=True):
                opcode, body = records.get_description(at)
                if self._learnt.get((opcode, body[:2])) != body:
                    self._find_keys(records.channel[done:before], key[done:before])
                    done = before
                    self._learn(opcode, body)
            self._find_keys(records.channel[done:], key[done:])
            done = len(key)
            if records.is_damaged:
                raise ValueError("a record reaches beyond its chunk, or is none")
        except OversizedError:
            self.losses.oversized += 1
            self.losses.oversized_bytes += block.length
        except _DAMAGE:
            self.losses.damaged_chunks += 1
            self.losses.damaged_bytes += block.length
        columns = MessageColumns(self._topics, key, records.text, records.starts, records.sizes, records.receipts)
        messages = MessageBlock(columns.select(slice(done)))
        has_key = key[:done] >= 0
        return messages if has_key.all() else messages.take(has_key)

    def _find_keys(self, channel: Ints, key: Ints) -> None:
        """Write the number of the key of each message, -1 where it has none; count those that are left out."""
        key[:] = self._key_of_channel[channel]
        if (key >= 0).all():
            return
        for number, count in zip(*np.unique(channel[key < 0], return_counts=True), strict=True):
            if number in self._foreign:
                left_out = self.viewer_messages if number in self._for_viewers else self.losses.foreign
                left_out[self._foreign[number][0]] += int(count)
            else:
                self.losses.undescribed += int(count)

    def _read_block(self, file: BinaryIO, block: _Block) -> bytes:
        """Return the records of a block, within the limits."""
        if block.length > LARGEST_CHUNK:
            raise OversizedError(f"a record of {block.length:,} bytes")
        file.seek(block.offset)
        data = file.read(block.length)
        self._read_bytes += len(data)
        if block.chunked:
            left = ALLOWANCE + EXPANSION * self._read_bytes - self._expanded
            data = decompress_chunk(data, min(LARGEST_CHUNK, left))
            self._expanded += len(data)
        return data


def _are_apart(blocks: list[_Block], end: int) -> bool:
    """Return whether chunks lie in the file, before its summary, and none overlaps another."""
    at = len(MAGIC)
    for block in sorted(blocks, key=itemgetter(2)):
        if block.offset < at or block.length < RECORD.size:
            return False
        at = block.offset + block.length
    return at <= end


def _add_raw(blocks: list[_Block], receipt_ns: int, offset: int, length: int) -> None:
    """Add a message outside chunks to the block that it continues, or else as a new block."""
    last = blocks[-1] if blocks else None
    if last and not last.chunked and last.offset + last.length == offset and last.length < RAW_BLOCK:
        first_ns, last_ns = min(last.first_ns, receipt_ns), max(last.last_ns, receipt_ns)
        blocks[-1] = _Block(first_ns, last_ns, last.offset, last.length + length, chunked=False)
    else:
        blocks.append(_Block(receipt_ns, receipt_ns, offset, length, chunked=False))
