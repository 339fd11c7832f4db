"""The MCAP reader, for recordings that are complete, unfinished or damaged.

The `mcap` package makes an object of every record, which takes 7 µs per message, and stops at the first invalid byte.
This reader decompresses a chunk and splits it into messages in one loop, which takes less than 1 µs per message. It
counts the data that it cannot read, and leaves them out.
"""

import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import inf
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import zstandard

from core.errors import RecordingError
from core.wire.messages import Message
from stream.mcap_format import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    FOOTER_RECORD,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD,
    SCHEMA,
    STATISTICS,
    decompress_chunk,
    explain_foreign_channel,
    iterate_records,
    iterate_strings,
)

RAW_BLOCK: Final = 1 << 20
"""Approximate size of the blocks in which the reader takes messages outside chunks. [B]"""

_CHUNK_PLACE: Final = struct.Struct("<QQQQ")  # first time, last time, offset, length
_SPAN: Final = struct.Struct("<QQ")  # first and last time in the head of a chunk
_TAIL: Final = FOOTER_RECORD.size + len(MAGIC)
_DAMAGE: Final = (ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError)
_receipt = itemgetter(2)


@dataclass
class Losses:
    """Count the data that could not be read from a recording.

    Parameters
    ----------
    unfinished : bool
        Whether the file has no end mark, because its writer was killed. Data that the writer had not yet written are
        lost.
    truncated_bytes : int
        Size of the incomplete record at the end of the file. [B]
    damaged_chunks, damaged_bytes : int
        Number and total size of the chunks that do not decompress or whose checksum differs. [1], [B]
    missing_messages : int
        Number of messages that the summary counts but the chunks do not contain.
    undescribed : int
        Number of messages whose channel the file does not describe.
    foreign : Counter
        Number of messages outside the wire contract by topic, because of another encoding or schema.
    """

    unfinished: bool = False
    truncated_bytes: int = 0
    damaged_chunks: int = 0
    damaged_bytes: int = 0
    missing_messages: int = 0
    undescribed: int = 0
    foreign: Counter[str] = field(default_factory=Counter)

    def __bool__(self) -> bool:
        """Return whether anything was lost."""
        return bool(self.lines())

    def lines(self) -> list[str]:
        """Return one sentence per kind of loss; an empty list for a complete recording."""
        sentences = []
        if self.unfinished:
            sentences.append(f"it breaks off: {self.truncated_bytes:,} bytes after the last whole chunk are lost")
        if self.damaged_chunks:
            sentences.append(f"{self.damaged_chunks:,} damaged chunks, {self.damaged_bytes:,} bytes, are lost")
        if self.missing_messages:
            sentences.append(f"{self.missing_messages:,} messages that its summary counts are lost")
        if self.undescribed:
            sentences.append(f"{self.undescribed:,} messages of channels that are nowhere described are left out")
        if self.foreign:
            sentences.append(
                f"{self.foreign.total():,} messages on {len(self.foreign):,} topics outside the contract are left out"
            )
        return sentences


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
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._keys: dict[int, str | None] = {}
        self._foreign: dict[int, tuple[str, str]] = {}
        self._learnt: dict[tuple[int, bytes], bytes] = {}
        self._count: int | None = None
        try:
            with self.path.open("rb") as file:
                self._check(file)
                self._blocks = self._read_index(file) or self._scan_chunks(file)
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be read: {(error.strerror or str(error)).lower()}") from error
        self._unread = (self.losses.unfinished, self.losses.truncated_bytes)
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

    def __iter__(self) -> Iterator[list[Message]]:
        """Yield the messages in order of receipt, about one chunk at a time."""
        self.losses = Losses(*self._unread)
        self.blocks_read = delivered = 0
        held: list[Message] = []
        with self.path.open("rb") as file:
            for at, block in enumerate(self._blocks):
                held += self._read_messages(file, block)
                held.sort(key=_receipt)
                self.blocks_read = at + 1
                following = self._blocks[at + 1].first_ns if at + 1 < len(self._blocks) else inf
                cut = bisect_right(held, following, key=_receipt)
                ready, held = held[:cut], held[cut:]
                delivered += len(ready)
                yield ready
        left_out = self.losses.undescribed + self.losses.foreign.total()
        if self._count is not None:
            self.losses.missing_messages = max(0, self._count - delivered - left_out)
        if not delivered:
            self._refuse_foreign()

    def _check(self, file: BinaryIO) -> None:
        """Refuse an empty file and a file that is not MCAP."""
        begin = file.read(len(MAGIC))
        if not begin:
            raise RecordingError(f"{self.path} is empty: 0 bytes; nothing was recorded")
        if begin != MAGIC:
            raise RecordingError(f"{self.path} is not an MCAP recording: it begins with {begin!r}, not {MAGIC!r}")

    def _refuse_foreign(self) -> None:
        """Refuse a recording if none of its channels follows the wire contract."""
        if self._keys and not any(self._keys.values()):
            _, reason = next(iter(self._foreign.values()))
            raise RecordingError(
                f"{self.path} is of another contract: {reason}; record with `socast live --record DIR`"
            )

    def _read_index(self, file: BinaryIO) -> list[_Block]:
        """Return the chunks that the summary lists; an empty list without an intact summary."""
        size = file.seek(0, 2)
        if size < 2 * len(MAGIC) + _TAIL:
            return []
        file.seek(size - _TAIL)
        tail = file.read(_TAIL)
        opcode, _, start, _, crc = FOOTER_RECORD.unpack(tail[: FOOTER_RECORD.size])
        if opcode != FOOTER or not tail.endswith(MAGIC) or not 0 < start <= size - _TAIL:
            return []
        file.seek(start)
        data = file.read(size - _TAIL - start)
        if crc and zlib.crc32(tail[: FOOTER_RECORD.size - 4], zlib.crc32(data)) != crc:
            return []
        blocks, count = [], None
        try:
            for opcode, body in iterate_records(data):
                if opcode == CHUNK_INDEX:
                    first_ns, last_ns, offset, length = _CHUNK_PLACE.unpack_from(body)
                    blocks.append(_Block(first_ns, last_ns, offset, length, chunked=True))
                elif opcode == STATISTICS:
                    count = int.from_bytes(body[:8], "little")
                else:
                    self._learn(opcode, body)
        except _DAMAGE:
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
                self._learn(opcode, file.read(length))
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
        number = int.from_bytes(body[:2], "little")
        if opcode == SCHEMA:
            name, form, data = iterate_strings(body, 2, 3)
            self._schemas[number] = (name.decode(), form.decode(), data)
        else:
            topic, encoding = (part.decode() for part in iterate_strings(body, 4, 2))
            wire = self._schemas.get(int.from_bytes(body[2:4], "little"), ("", "", b""))
            self.schemas[topic] = wire[0]
            reason = explain_foreign_channel(topic, encoding, *wire)
            self._keys[number] = None if reason else topic
            if reason:
                self._foreign[number] = (topic, reason)
        self._learnt[opcode, body[:2]] = body

    def _read_messages(self, file: BinaryIO, block: _Block) -> list[Message]:
        """Return the messages of a block in the order of the file; of a damaged block those before the damage."""
        file.seek(block.offset)
        out: list[Message] = []
        try:
            data = file.read(block.length)
            self._split(decompress_chunk(data) if block.chunked else data, out)
        except _DAMAGE:
            self.losses.damaged_chunks += 1
            self.losses.damaged_bytes += block.length
        return out

    def _split(self, data: bytes, out: list[Message]) -> None:
        """Split a chunk into records and append its messages to `out`."""
        at, end = 0, len(data)
        data += bytes(MESSAGE_HEAD.size)  # padding, so that a short last record needs no special case
        unpack, head, get, new = MESSAGE_HEAD.unpack_from, MESSAGE_HEAD.size, self._keys.get, tuple.__new__
        append = out.append
        while at < end:
            opcode, length, channel, _, receipt_ns, _ = unpack(data, at)
            stop = at + 9 + length
            if stop > end:
                raise ValueError("a record reaches beyond its chunk")
            if opcode == MESSAGE:
                key = get(channel)
                if key is not None:
                    append(new(Message, (key, data[at + head : stop], receipt_ns)))
                elif channel in self._foreign:
                    self.losses.foreign[self._foreign[channel][0]] += 1
                else:
                    self.losses.undescribed += 1
            else:
                self._learn(opcode, data[at + 9 : stop])
            at = stop


def _add_raw(blocks: list[_Block], receipt_ns: int, offset: int, length: int) -> None:
    """Add a message outside chunks to the block that it continues, or else as a new block."""
    last = blocks[-1] if blocks else None
    if last and not last.chunked and last.offset + last.length == offset and last.length < RAW_BLOCK:
        first_ns, last_ns = min(last.first_ns, receipt_ns), max(last.last_ns, receipt_ns)
        blocks[-1] = _Block(first_ns, last_ns, last.offset, last.length + length, chunked=False)
    else:
        blocks.append(_Block(receipt_ns, receipt_ns, offset, length, chunked=False))
