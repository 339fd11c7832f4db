"""The MCAP reader, for recordings that are complete, unfinished or damaged.

The `mcap` package makes an object of every record, which takes 7 µs per message, and stops at the first invalid byte.
This reader decompresses a chunk and locates its messages in one compiled loop (`mcap_scan.py`); it makes no object of a
message. It counts the data that it cannot read, and leaves them out. It reads each of several recordings that were
joined to one file, with its own channels.

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

from socast.core.batch import Ints
from socast.core.errors import RecordingError
from socast.core.wire.message_block import MessageBlock, MessageColumns
from socast.stream.mcap_channels import LARGEST_DESCRIPTION, Channels, Topics
from socast.stream.mcap_format import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DAMAGE,
    DATA_END,
    FOOTER,
    FOOTER_RECORD,
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
    decode_metadata,
    decompress_chunk,
    read_records,
)
from socast.stream.mcap_losses import ALLOWANCE, EXPANSION, Losses
from socast.stream.mcap_scan import NO_RECORDS, scan_chunk
from socast.stream.mcap_sections import Section, find_sections
from socast.stream.waiting_messages import WaitingMessages

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
LARGEST_METADATA: Final = 64 << 10
"""Largest metadata record. [B]"""
_STATISTICS: Final = struct.Struct("<QHIIII")  # messages, schemas, channels, attachments, metadata, chunks
_CHUNK_PLACE: Final = struct.Struct("<QQQQ")  # first time, last time, offset, length
_SPAN: Final = struct.Struct("<QQ")  # first and last time in the head of a chunk
_TAIL: Final = FOOTER_RECORD.size + len(MAGIC)
IN_ORDER: Final = "only a reader of the whole recording, in order, can use it; read it without --cluster"


class _Block(NamedTuple):
    """Locate a run of messages in the file: a chunk, or messages outside chunks."""

    first_ns: int
    last_ns: int
    offset: int
    length: int
    channels: Channels
    chunked: bool


class McapSource:
    """Read an MCAP recording as a source that can be iterated repeatedly.

    Attributes
    ----------
    losses : Losses
        Data that the current iteration could not read so far; complete after its end.
    blocks, blocks_read : int
        Number of chunks in the file, and number of chunks that the current iteration has read.
    joined : int
        Number of recordings in the file, more than one where files were joined.
    schemas : dict
        Name of the schema by topic, for the topics read so far; an empty name for a topic without a schema.
    metadata : dict of str to str
        What wrote the recording, see `socast.stream.recording_metadata`; empty if the file does not say.
    viewer_messages : Counter of str
        Number of messages by topic that the current iteration has left out because their channels are marked as
        `FOR_VIEWERS`.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.losses = Losses()
        self.blocks_read = 0
        self.metadata: dict[str, str] = {}
        self.viewer_messages: Counter[str] = Counter()
        self._topics = Topics()
        self.schemas = self._topics.schemas
        self._parts: list[Channels] = []
        self._read_bytes = self._expanded = 0
        self._count: int | None = None
        if self.path.is_fifo():  # it would wait for a writer
            raise RecordingError(f"{self.path} is a pipe, and a recording is read from several places: give a file")
        try:
            with self.path.open("rb") as file:
                self._check(file)
                with suppress(*DAMAGE):
                    self._read_metadata(file)
                self._blocks = self._locate_blocks(file)
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
    def joined(self) -> int:
        """Return the number of recordings in the file."""
        return len(self._parts)

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
        self.losses = Losses(
            whole.unfinished,
            whole.truncated_bytes,
            is_contradicted=whole.is_contradicted,
            stray_bytes=whole.stray_bytes,
        )
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
        """Return the number of messages by the summary; None without an intact one of each recording in the file."""
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
        if opcode == HEADER and length <= LARGEST_METADATA:
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
        foreign = [reason for channels in self._parts for _, reason in channels.foreign.values()]
        if foreign and not self._topics.keys:
            reason = foreign[0]
            raise RecordingError(
                f"{self.path} is of another contract: {reason}; record with `socast live --record DIR`"
            )

    def _locate_blocks(self, file: BinaryIO) -> list[_Block]:
        """Return the chunks of each recording in the file, by time."""
        whole = Section(0, file.seek(0, 2))
        blocks, self._count = self._read_index(file, whole, channels := Channels(self._topics))
        self._parts = [channels]
        if blocks:
            return blocks
        sections, self.losses.stray_bytes = find_sections(file)
        counts: list[int | None] = []
        self.losses.is_contradicted &= len(sections) == 1
        self._parts = [channels] if len(sections) == 1 else [Channels(self._topics) for _ in sections]
        for section, channels in zip(sections, self._parts, strict=True):
            listed, count = self._read_index(file, section, channels) if len(sections) > 1 else ([], None)
            counts.append(count)
            blocks += listed or self._scan_chunks(file, section, channels)
        known = [count for count in counts if count is not None]
        self._count = sum(known) if len(known) == len(counts) else None
        return sorted(blocks, key=itemgetter(0))

    def _locate_summary(self, file: BinaryIO, section: Section) -> tuple[int, int]:
        """Return the place of the summary of a recording and its size; a size of 0 without an intact summary."""
        begin, end = section
        if end - begin < 2 * len(MAGIC) + _TAIL:
            return 0, 0
        file.seek(end - _TAIL)
        tail = file.read(_TAIL)
        opcode, _, start, _, crc = FOOTER_RECORD.unpack(tail[: FOOTER_RECORD.size])
        length = end - begin - _TAIL - start
        most = max(LARGEST_SUMMARY, (end - begin) // SUMMARY_SHARE)
        if opcode != FOOTER or not tail.endswith(MAGIC) or not start or not 0 <= length <= most:
            return 0, 0
        file.seek(begin + start)
        found = 0
        for at in range(0, length if crc else 0, RAW_BLOCK):
            found = zlib.crc32(file.read(min(RAW_BLOCK, length - at)), found)
        is_damaged = crc and zlib.crc32(tail[: FOOTER_RECORD.size - 4], found) != crc
        return begin + start, 0 if is_damaged else length

    def _read_index(self, file: BinaryIO, section: Section, channels: Channels) -> tuple[list[_Block], int | None]:
        """Return the chunks that a summary lists, and the number of messages; none without one that counts them."""
        start, length = self._locate_summary(file, section)
        blocks: list[_Block] = []
        count = chunks = None
        try:
            for opcode, body in read_records(file, start, length, LARGEST_DESCRIPTION):
                if opcode == CHUNK_INDEX:
                    first_ns, last_ns, offset, length = _CHUNK_PLACE.unpack_from(body)
                    blocks.append(_Block(first_ns, last_ns, section.begin + offset, length, channels, chunked=True))
                elif opcode == STATISTICS:
                    count, *_, chunks = _STATISTICS.unpack_from(body)
                else:
                    channels.learn(opcode, body)
        except DAMAGE:
            return [], None
        if chunks != len(blocks) or not _are_apart(blocks, section.begin, start):
            self.losses.is_contradicted |= bool(blocks) and chunks is not None
            return [], None
        return sorted(blocks, key=itemgetter(0)), count if blocks else None

    def _scan_chunks(self, file: BinaryIO, section: Section, channels: Channels) -> list[_Block]:
        """Return the chunks found by a scan from record to record, up to the first incomplete record."""
        at, size = section.begin + len(MAGIC), section.end
        blocks: list[_Block] = []
        while at + RECORD.size <= size:
            file.seek(at)
            head = file.read(MESSAGE_HEAD.size).ljust(MESSAGE_HEAD.size, b"\0")
            opcode, length = RECORD.unpack_from(head)
            end = at + RECORD.size + length
            if end > size or not opcode:
                break
            if opcode == CHUNK:
                first_ns, last_ns = _SPAN.unpack_from(head, RECORD.size)
                blocks.append(_Block(first_ns, last_ns, at, end - at, channels, chunked=True))
            elif opcode == MESSAGE:
                _add_raw(blocks, int.from_bytes(head[15:23], "little"), at, end - at, channels)
            elif opcode in {SCHEMA, CHANNEL}:
                file.seek(at + RECORD.size)
                with suppress(*DAMAGE):  # its messages count as undescribed
                    channels.learn(opcode, file.read(min(length, LARGEST_DESCRIPTION + 1)))
            at = end
            if opcode == DATA_END:
                return self._order_blocks(file, blocks)
        self.losses.unfinished = True
        self.losses.truncated_bytes += size - at
        return self._order_blocks(file, blocks)

    def _order_blocks(self, file: BinaryIO, blocks: list[_Block]) -> list[_Block]:
        """Return blocks by time; if the file has another order, first read the channels in the order of the file."""
        ordered = sorted(blocks, key=itemgetter(0))
        if ordered != blocks:
            for block in blocks:
                self._read_messages(file, block)
        return ordered

    def _read_messages(self, file: BinaryIO, block: _Block) -> MessageBlock:
        """Return the messages of a block in the order of the file; of a damaged block those before the damage."""
        records, key, done = NO_RECORDS, np.empty(0, np.int64), 0
        try:
            records = scan_chunk(self._read_block(file, block))
            key = np.empty(len(records.channel), np.int64)
            for at, before in zip(*(map(int, column) for column in records.descriptions.T), strict=True):
                opcode, body = records.get_description(at)
                if not block.channels.know(opcode, body):
                    self._find_keys(block, records.channel[done:before], key[done:before])
                    done = before
                    block.channels.learn(opcode, body)
            self._find_keys(block, records.channel[done:], key[done:])
            done = len(key)
            if records.is_damaged:
                raise ValueError("a record reaches beyond its chunk, or is none")
        except OversizedError:
            self.losses.oversized += 1
            self.losses.oversized_bytes += block.length
        except DAMAGE:
            self.losses.damaged_chunks += 1
            self.losses.damaged_bytes += block.length
        columns = MessageColumns(self._topics.keys, key, records.text, records.starts, records.sizes, records.receipts)
        messages = MessageBlock(columns.select(slice(done)))
        has_key = key[:done] >= 0
        return messages if has_key.all() else messages.take(has_key)

    def _find_keys(self, block: _Block, channel: Ints, key: Ints) -> None:
        """Write the number of the key of each message of a block, see `Channels.find_keys`."""
        block.channels.find_keys(channel, key, self.losses, self.viewer_messages)

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


def _are_apart(blocks: list[_Block], begin: int, end: int) -> bool:
    """Return whether chunks lie in a recording, before its summary, and none overlaps another."""
    at = begin + len(MAGIC)
    for block in sorted(blocks, key=itemgetter(2)):
        if block.offset < at or block.length < RECORD.size:
            return False
        at = block.offset + block.length
    return at <= end


def _add_raw(blocks: list[_Block], receipt_ns: int, offset: int, length: int, channels: Channels) -> None:
    """Add a message outside chunks to the block that it continues, or else as a new block."""
    last = blocks[-1] if blocks else None
    if last and not last.chunked and last.offset + last.length == offset and last.length < RAW_BLOCK:
        first_ns, last_ns = min(last.first_ns, receipt_ns), max(last.last_ns, receipt_ns)
        blocks[-1] = _Block(first_ns, last_ns, last.offset, last.length + length, channels, chunked=False)
    else:
        blocks.append(_Block(receipt_ns, receipt_ns, offset, length, channels, chunked=False))
