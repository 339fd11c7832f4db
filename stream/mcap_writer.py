"""The MCAP writer: it stores every payload verbatim, with its Zenoh key and its time of receipt.

The topic is the key, the message encoding is `json` and the schema encoding is `jsonschema`; batches of gateways have
the message encoding `ARROW` and no schema. `log_time` is the time of receipt and `publish_time` is the sender's
`time_s`. Chunks are compressed with zstd and indexed. Each chunk describes the channels that it uses, so that a damaged
chunk does not make other chunks unreadable. Writer and reader take the messages of a chunk as columns, without the
`mcap` package, which needs 5 to 7 µs per message. A metadata record `socast` after the header says what wrote the
recording.

References
----------
MCAP format specification, https://mcap.dev/spec.
"""

import json
import os
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from socast.core.errors import RecordingError
from socast.core.files import replacing
from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import BATCH, KINDS, Message, address
from socast.core.wire.schema import make_schema
from socast.stream.closeable import Closeable
from socast.stream.mcap_chunk import ChunkBuilder, encode_record
from socast.stream.mcap_format import ARROW, FOOTER_RECORD, FOR_VIEWERS, MAGIC, MESSAGE_HEAD, METADATA_NAME
from socast.stream.recording_metadata import find_version

CHUNK_BYTES: Final = 1 << 20
"""Size at which the writer compresses a chunk and writes it. [B]"""
MOST_CHANNELS: Final = 0xFFFF
"""Largest number of keys in one recording, because the format numbers channels with 16 bits."""


class McapSink(Closeable):
    """Write an MCAP recording as a sink.

    Parameters
    ----------
    path : str or Path
        File to write; an existing file is overwritten. `replace_recording` keeps it until the new one is complete.
    chunk_bytes : int
        Size at which a chunk is written. [B] A killed process loses at most this many bytes, and only messages that
        came after the last `flush`.
    metadata : mapping of str to str, optional
        What made the recording, see `socast.stream.recording_metadata.make_metadata`. The version of socast is added.
    viewer_schemas : mapping of str to dict, optional
        Last chunk of a topic outside the wire contract -> JSON schema of its messages, with its name as `title`; for
        messages that are put for viewers.
    file : Path, optional
        File that is written instead of `path`, which errors name.

    Attributes
    ----------
    written : int
        Size of the file so far, with the uncompressed size of the unfinished chunk. [B]
    messages, kept : int
        Number of messages that were put, and number of those in the file; after `sync` found the file removed or moved,
        of those that were in it at the `sync` before.
    """

    def __init__(
        self,
        path: str | Path,
        chunk_bytes: int = CHUNK_BYTES,
        *,
        metadata: Mapping[str, str] | None = None,
        viewer_schemas: Mapping[str, Mapping[str, Any]] | None = None,
        file: Path | None = None,
    ) -> None:
        self.path = Path(path)
        self.messages = self.kept = self._synced = 0
        self._chunk_bytes = chunk_bytes
        self._viewer_schemas = viewer_schemas or {}
        self._compress = zstandard.ZstdCompressor().compress
        self._keys: dict[str, int] = {}
        self._viewer_keys: dict[str, int] = {}
        self._schemas: dict[str, Schema] = {}
        self._channels: list[Channel] = []
        self._descriptions: list[list[bytes]] = []
        self._counts: Counter[int] = Counter()
        self._indexes: list[bytes] = []
        self._span: tuple[int, int] | None = None
        self._chunk = ChunkBuilder()
        with _explain(self.path, "choose another place"):
            self._file: BinaryIO = (file or self.path).open("wb")
        begin = MAGIC + encode_record(Header(profile="", library="socast"))
        about = encode_record(Metadata(METADATA_NAME, {"version": find_version()} | dict(metadata or {})))
        self._metadata_index = MetadataIndex(len(begin), len(about), METADATA_NAME)
        self._write(begin + about, flush=True)

    @property
    def written(self) -> int:
        """Return the size of the recording so far. [B]"""
        return self._file.tell() + self._chunk.size if not self._file.closed else self.path.stat().st_size

    @property
    def full(self) -> bool:
        """Return whether the recording holds the largest number of keys."""
        return len(self._channels) >= MOST_CHANNELS

    def room(self, messages: Sequence[Message]) -> int:
        """Return how many of the messages, from the first on, fit into the recording by their number of keys."""
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

    def put(self, messages: Sequence[Message], *, for_viewers: bool = False) -> None:
        """Append messages to the recording.

        Parameters
        ----------
        for_viewers : bool
            Put them on channels of their own, which only viewers read and `McapSource` leaves out.
        """
        block = MessageBlock.of(messages)
        for key in block.list_keys():
            self._find_channel(key, for_viewers=for_viewers)
        while len(block):
            count = self._count_fitting(block)
            self._chunk.put(block[:count], for_viewers=for_viewers)
            self.messages += count
            block = block[count:]
            if self._chunk.size >= self._chunk_bytes:
                self._end_chunk()

    def _count_fitting(self, block: MessageBlock) -> int:
        """Return how many of the messages, from the first on, fill the chunk."""
        room = self._chunk_bytes - self._chunk.size
        if block.size + MESSAGE_HEAD.size * len(block) < room:
            return len(block)
        ends = np.cumsum(block.columns.sizes + MESSAGE_HEAD.size)
        return min(len(block), int(np.searchsorted(ends, room)) + 1)

    def flush(self) -> None:
        """Write the unfinished chunk, so that a reader finds every message that was put."""
        self._end_chunk()

    def sync(self) -> None:
        """Write the unfinished chunk, and return once the operating system has everything on disk.

        A file that was removed or moved still takes data, which nobody would find there: `RecordingError`.
        """
        self._end_chunk()
        with _explain(self.path):
            os.fdatasync(self._file.fileno())
        if not self._is_found():
            self.kept = self._synced
            raise RecordingError(f"{self.path} was removed or moved: bring its folder back, and another file begins")
        self._synced = self.kept

    def close(self) -> None:
        """Write the summary and close the file."""
        if self._file.closed:
            return
        try:
            self._end_chunk()
            self._write(encode_record(DataEnd(data_section_crc=0)))
            self._write(self._make_summary() + MAGIC, flush=True)
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file without a summary, for use after the disk refused data."""
        with suppress(OSError):
            self._file.close()

    def _is_found(self) -> bool:
        """Return whether the path of the file that is written still leads to it."""
        try:
            return os.path.samestat(os.fstat(self._file.fileno()), Path(self._file.name).stat())
        except (FileNotFoundError, NotADirectoryError):
            return False

    def _find_channel(self, key: str, *, for_viewers: bool) -> int:
        """Return the channel number of a key, which may be new."""
        keys = self._viewer_keys if for_viewers else self._keys
        if key in keys:
            return keys[key]
        if self.full:
            raise RecordingError(
                f"{self.path}: key {MOST_CHANNELS + 1:,} is {key}; a recording holds {MOST_CHANNELS:,}"
            )
        channel = len(self._channels) + 1
        keys[key] = channel
        schema = self._find_schema(key, for_viewers=for_viewers)
        encoding = ARROW if (known := address(key)) and known.kind == BATCH else "json"
        number = schema.id if schema else 0
        record = Channel(channel, key, encoding, FOR_VIEWERS if for_viewers else {}, number)
        self._channels.append(record)
        self._descriptions.append([encode_record(each) for each in (schema, record) if each])
        return channel

    def _find_schema(self, key: str, *, for_viewers: bool) -> Schema | None:
        """Return the schema of a key; None as of batches and outside the wire contract."""
        known = address(key)
        if known and known.kind == BATCH:
            return None
        kind = known.kind if known else key.rpartition("/")[2]
        if not known and not (for_viewers and kind in self._viewer_schemas):
            return None
        if kind not in self._schemas:
            schema = make_schema(kind) if known else self._viewer_schemas[kind]
            name = KINDS[kind].__name__ if known else schema["title"]
            self._schemas[kind] = Schema(len(self._schemas) + 1, json.dumps(schema).encode(), "jsonschema", name)
        return self._schemas[kind]

    def _end_chunk(self) -> None:
        """Write the unfinished chunk and its message indexes."""
        chunk = self._chunk.pack([self._keys, self._viewer_keys], self._descriptions, self._compress)
        if chunk is None:
            return
        (first, last), index = chunk.span, chunk.describe(self._file.tell())
        self._write(chunk.record + bytes(chunk.indexes), flush=True)
        self._span = (min(first, self._span[0]), max(last, self._span[1])) if self._span else (first, last)
        self._counts.update(dict(zip(chunk.channels.tolist(), chunk.counts.tolist(), strict=True)))
        self.kept += int(chunk.counts.sum())
        self._indexes.append(index)
        self._chunk = ChunkBuilder()

    def _make_summary(self) -> bytes:
        """Return the summary section and the footer."""
        first, last = self._span or (0, 0)
        statistics = Statistics(
            0, len(self._channels), dict(self._counts), len(self._indexes), self._counts.total(), last, first, 1,
            len(self._schemas),
        )  # fmt: skip
        groups = {
            Opcode.SCHEMA: map(encode_record, self._schemas.values()),
            Opcode.CHANNEL: map(encode_record, self._channels),
            Opcode.STATISTICS: [encode_record(statistics)],
            Opcode.CHUNK_INDEX: self._indexes,
            Opcode.METADATA_INDEX: [encode_record(self._metadata_index)],
        }
        start = at = self._file.tell()
        parts, offsets = [], b""
        for opcode, records in groups.items():
            parts.append(group := b"".join(records))
            offsets += encode_record(SummaryOffset(opcode, at, len(group)))
            at += len(group)
        data = b"".join(parts) + offsets
        crc = zlib.crc32(FOOTER_RECORD.pack(Opcode.FOOTER, 20, start, at, 0)[:-4], zlib.crc32(data))
        return data + encode_record(Footer(summary_offset_start=at, summary_start=start, summary_crc=crc))

    def _write(self, data: bytes, *, flush: bool = False) -> None:
        """Write data to the file; raise `RecordingError` if the disk refuses them."""
        with _explain(self.path):
            self._file.write(data)
            if flush:
                self._file.flush()


@contextmanager
def replace_recording(
    path: str | Path,
    *,
    metadata: Mapping[str, str] | None = None,
    viewer_schemas: Mapping[str, Mapping[str, Any]] | None = None,
) -> Iterator[McapSink]:
    """Yield the writer of a recording that takes the place of a file once it is complete and nothing was raised.

    The parameters are those of `McapSink`.
    """
    path = Path(path)
    with ExitStack() as failing:
        with _explain(path, "choose another place"):
            fresh = failing.enter_context(replacing(path))
        with McapSink(path, metadata=metadata, viewer_schemas=viewer_schemas, file=fresh) as sink:
            yield sink
        with _explain(path):
            failing.pop_all().close()


@contextmanager
def _explain(path: Path, remedy: str = "make room or stop recording") -> Iterator[None]:
    """Raise `RecordingError` where the disk refuses a recording."""
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{path} cannot be written: {error.strerror}; {remedy}") from error
