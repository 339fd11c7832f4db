"""The MCAP writer: every payload verbatim, under its Zenoh key, at its time of receipt.

Topic is the key, message encoding `json`, schema encoding `jsonschema`, `log_time` the receipt and `publish_time` the
sender's `time_s`. Chunks are zstd, indexed, and each describes the channels that it uses, so that a damaged chunk costs
no more than itself. The hot loops, one message in and one message out, pack and unpack the records by hand: the `mcap`
package's own cost five to seven microseconds a message.

References
----------
MCAP format specification, https://mcap.dev/spec.
"""

import json
import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Self

import msgspec
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Header, Schema, Statistics, SummaryOffset

from core.errors import RecordingError
from core.wire.messages import KINDS, Message, address
from core.wire.schema import make_schema
from stream.mcap_format import FOOTER_RECORD, MAGIC, MESSAGE_HEAD, RECORD

CHUNK_BYTES: Final = 1 << 20
"""Size that a chunk grows to before it is compressed and written. [B]"""
MOST_CHANNELS: Final = 0xFFFF
"""Keys that one recording can hold: the format numbers them with 16 bits."""

_BODY: Final = MESSAGE_HEAD.size - RECORD.size


class _Stamp(msgspec.Struct, gc=False):
    """All that a recording needs to know of a payload."""

    time_s: float


_stamp = msgspec.json.Decoder(_Stamp | list[_Stamp]).decode


def _published(payload: bytes, receipt_ns: int) -> int:
    """Return the sender's time, or the receipt where the payload does not tell, in ns."""
    try:
        stamp = _stamp(payload)
        time_s = (stamp[0] if isinstance(stamp, list) else stamp).time_s
        time_ns = round(time_s * 1e6) * 1000  # a float of Unix time is good to a quarter of a microsecond
    except (msgspec.MsgspecError, UnicodeDecodeError, IndexError, OverflowError, RecursionError):
        return receipt_ns
    return time_ns if 0 <= time_ns < 1 << 64 else receipt_ns


class McapSink:
    """Write an MCAP recording, as a sink; a context manager.

    Parameters
    ----------
    path : Path
        Overwritten where it exists.
    chunk_bytes : int
        What is lost when the process is killed is at most this much, and what came since the last `flush`. [B]

    Attributes
    ----------
    written : int
        Size of the file so far, the chunk in the making included as it stands. [B]
    messages, kept : int
        How many were put, and how many of them are in the file.

    Raises
    ------
    RecordingError
        Where the file cannot be written.
    """

    def __init__(self, path: str | Path, chunk_bytes: int = CHUNK_BYTES) -> None:
        self.path = Path(path)
        self.messages = self.kept = 0
        self._chunk_bytes = chunk_bytes
        self._compress = zstandard.ZstdCompressor().compress
        self._keys: dict[str, int] = {}
        self._schemas: dict[str, Schema] = {}
        self._channels: list[Channel] = []
        self._counts: Counter[int] = Counter()
        self._indexes: list[ChunkIndex] = []
        self._span: tuple[int, int] | None = None
        self._start_chunk()
        try:
            self._file: BinaryIO = self.path.open("wb")
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be written: {error.strerror}; choose another place") from error
        self._write(MAGIC + _bytes(Header(profile="", library="socast")), flush=True)

    @property
    def written(self) -> int:
        """Size of the recording so far, in bytes."""
        return self._file.tell() + self._size if not self._file.closed else self.path.stat().st_size

    @property
    def full(self) -> bool:
        """Whether no key can be added."""
        return len(self._channels) >= MOST_CHANNELS

    def room(self, messages: Sequence[Message]) -> int:
        """Return how many of the messages, from the first on, bring no more keys than the recording can hold."""
        left = MOST_CHANNELS - len(self._channels)
        if len(messages) <= left:
            return len(messages)
        fresh: set[str] = set()
        for at, (key, _, _) in enumerate(messages):
            if key not in self._keys:
                fresh.add(key)
                if len(fresh) > left:
                    return at
        return len(messages)

    def put(self, messages: Sequence[Message]) -> None:
        """Append messages.

        Raises
        ------
        RecordingError
            Where the disk is full, or more than `MOST_CHANNELS` keys come.
        """
        parts, pack, body = self._parts, MESSAGE_HEAD.pack, _BODY
        for key, payload, receipt_ns in messages:
            channel = self._keys.get(key) or self._open(key)
            index = self._index.get(channel)
            if index is None:
                index = self._describe(channel)
            length = body + len(payload)
            index.append(receipt_ns)
            index.append(self._size)
            parts.append(pack(5, length, channel, 0, receipt_ns, _published(payload, receipt_ns)))
            parts.append(payload)
            self._size += length + 9
            if self._size >= self._chunk_bytes:
                self._end_chunk()
                parts = self._parts
        self.messages += len(messages)

    def flush(self) -> None:
        """End the chunk in the making, so that a reader finds all that was put."""
        self._end_chunk()

    def close(self) -> None:
        """Write the summary and close the file."""
        if self._file.closed:
            return
        try:
            self._end_chunk()
            self._write(_bytes(DataEnd(data_section_crc=0)))
            self._write(self._summary() + MAGIC, flush=True)
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is, without a summary, where the disk takes no more."""
        with suppress(OSError):
            self._file.close()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    def _open(self, key: str) -> int:
        """Give a new key its number; one outside the contract gets no schema."""
        if self.full:
            raise RecordingError(
                f"{self.path}: key {MOST_CHANNELS + 1:,} is {key}; a recording holds {MOST_CHANNELS:,}"
            )
        known = address(key)
        if known and known.kind not in self._schemas:
            data = json.dumps(make_schema(known.kind)).encode()
            number = len(self._schemas) + 1
            self._schemas[known.kind] = Schema(number, data, "jsonschema", KINDS[known.kind].__name__)
        channel = self._keys[key] = len(self._channels) + 1
        described = self._schemas[known.kind].id if known else 0
        self._channels.append(Channel(channel, key, "json", {}, described))
        return channel

    def _describe(self, channel: int) -> list[int]:
        """Write what a chunk says of a channel before its first message there, and begin its index."""
        record = self._channels[channel - 1]
        for wire in self._schemas.values():
            if wire.id == record.schema_id and wire.id not in self._described:
                self._described.add(wire.id)
                self._append(_bytes(wire))
        self._append(_bytes(record))
        return self._index.setdefault(channel, [])

    def _append(self, data: bytes) -> None:
        """Add a record that is not a message to the chunk in the making."""
        self._parts.append(data)
        self._size += len(data)

    def _start_chunk(self) -> None:
        """Begin an empty chunk."""
        self._parts: list[bytes] = []
        self._index: dict[int, list[int]] = {}
        self._described: set[int] = set()
        self._size = 0

    def _end_chunk(self) -> None:
        """Write the chunk in the making and its message indexes."""
        if not self._index:
            return
        data = b"".join(self._parts)
        packed = self._compress(data)
        times = [time for index in self._index.values() for time in index[::2]]
        first, last = min(times), max(times)
        self._span = (min(first, self._span[0]), max(last, self._span[1])) if self._span else (first, last)
        offset = self._file.tell()
        chunk = _bytes(Chunk("zstd", packed, last, first, zlib.crc32(data), len(data)))
        tables, places, at = [], {}, offset + len(chunk)
        for channel, index in self._index.items():
            self._counts[channel] += len(index) // 2
            places[channel] = at
            tables.append(struct.pack(f"<BQHI{len(index)}Q", 7, 6 + 8 * len(index), channel, 8 * len(index), *index))
            at += len(tables[-1])
        self._write(chunk + b"".join(tables), flush=True)
        self.kept = self._counts.total()
        size = at - offset - len(chunk)
        self._indexes.append(ChunkIndex(len(chunk), offset, "zstd", len(packed), last, size, places, first, len(data)))
        self._start_chunk()

    def _summary(self) -> bytes:
        """Return the summary section and the footer."""
        first, last = self._span or (0, 0)
        statistics = Statistics(
            0, len(self._channels), dict(self._counts), len(self._indexes), self._counts.total(), last, first, 0,
            len(self._schemas),
        )  # fmt: skip
        groups: tuple[list[Any], ...] = (list(self._schemas.values()), self._channels, [statistics], self._indexes)
        opcodes = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX)
        start = at = self._file.tell()
        parts, offsets = [], b""
        for opcode, records in zip(opcodes, groups, strict=True):
            group = b"".join(map(_bytes, records))
            offsets += _bytes(SummaryOffset(opcode, at, len(group)))
            parts.append(group)
            at += len(group)
        data = b"".join(parts) + offsets
        crc = zlib.crc32(FOOTER_RECORD.pack(Opcode.FOOTER, 20, start, at, 0)[:-4], zlib.crc32(data))
        return data + _bytes(Footer(summary_offset_start=at, summary_start=start, summary_crc=crc))

    def _write(self, data: bytes, *, flush: bool = False) -> None:
        """Write to the file."""
        try:
            self._file.write(data)
            if flush:
                self._file.flush()
        except OSError as error:
            raise RecordingError(
                f"{self.path} cannot be written: {error.strerror}; make room or stop recording"
            ) from error


def _bytes(record: Any) -> bytes:
    """Return a record of the `mcap` package as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
