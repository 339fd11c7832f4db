"""The record layout of MCAP files, and functions that decode records.

References
----------
MCAP format specification, https://mcap.dev/spec.
"""

import json
import struct
import zlib
from collections.abc import Iterator
from functools import lru_cache
from typing import BinaryIO, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from socast.core.wire.messages import BATCH, address
from socast.core.wire.schema import make_schema

RECORDING: Final = ".mcap"
"""Ending of the name of a recording."""
MAGIC: Final = b"\x89MCAP0\r\n"
LARGEST_CHUNK: Final = 64 << 20
"""Largest size of a chunk, compressed or not, and of a message outside chunks; larger ones are left out. [B]"""

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 8
STATISTICS, METADATA, DATA_END = 11, 12, 15
METADATA_NAME: Final = "socast"
"""Name of the metadata record that says what wrote a recording."""
FOR_VIEWERS: Final = {"socast": "for viewers"}
"""Metadata of a channel that was added for viewers, and that the reader leaves out."""
ARROW: Final = "application/vnd.apache.arrow.stream"
"""Encoding of the messages of a channel of batches."""
RECORD: Final = struct.Struct("<BQ")
"""Start of every record: opcode, and length of the rest. [B]"""
MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
"""Start of a message record: opcode, length [B], channel, sequence, log time [ns], publish time [ns]."""
FOOTER_RECORD: Final = struct.Struct("<BQQQI")
"""Footer record: opcode, length [B], start of the summary [B], start of its offsets [B], CRC."""
DAMAGE: Final = (ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError)
"""What damaged records raise."""
_CHUNK_HEAD: Final = struct.Struct("<BQQQQII")  # opcode, length, first and last time, size, CRC, length of a name
_LENGTH: Final = struct.Struct("<I")


class OversizedError(ValueError):
    """Refuse a record that would take more memory or time than its file justifies."""


def read_records(file: BinaryIO, start: int, length: int, largest: int) -> Iterator[tuple[int, bytes]]:
    """Yield the opcode and the body of each record of a part of a file, one at a time.

    Units: start [B], length [B], largest [B].
    """
    file.seek(start)
    while length:
        opcode, size = RECORD.unpack(file.read(RECORD.size))
        length -= RECORD.size + size
        if not opcode or size > largest or length < 0:
            raise ValueError("a record without opcode, too large or beyond its part")
        yield opcode, file.read(size)


def iterate_strings(body: bytes, at: int, count: int) -> Iterator[bytes]:
    """Yield strings, each of which follows its length in the record.

    Units: at [B].
    """
    for _ in range(count):
        (length,) = _LENGTH.unpack_from(body, at)
        at += _LENGTH.size + length
        if at > len(body):
            raise ValueError("a string reaches beyond its record")
        yield body[at - length : at]


def decode_metadata(body: bytes) -> tuple[str, dict[str, str]]:
    """Return the name and the entries of a metadata record."""
    (name,) = iterate_strings(body, 0, 1)
    return name.decode(), _decode_map(body, _LENGTH.size + len(name))


def decode_channel(body: bytes) -> tuple[str, str, dict[str, str]]:
    """Return the topic, the encoding of messages and the metadata of a channel record."""
    topic, encoding = iterate_strings(body, 4, 2)
    at = 4 + 2 * _LENGTH.size + len(topic) + len(encoding)
    return topic.decode(), encoding.decode(), _decode_map(body, at)


def _decode_map(body: bytes, at: int) -> dict[str, str]:
    """Return a map of strings, which follows its length in the record."""
    end = at + _LENGTH.size + _LENGTH.unpack_from(body, at)[0]
    at += _LENGTH.size
    entries: dict[str, str] = {}
    while at < end:
        key, value = iterate_strings(body, at, 2)
        entries[key.decode()] = value.decode()
        at += 2 * _LENGTH.size + len(key) + len(value)
    return entries


def decompress_chunk(record: bytes, limit: int = LARGEST_CHUNK) -> bytes:
    """Return the decompressed records of a chunk, after a check of size and checksum.

    Units: limit [B].
    """
    opcode, _, _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(record)
    at = _CHUNK_HEAD.size + name_length
    name = record[_CHUNK_HEAD.size : at]
    packed = record[at + 8 :]
    if opcode != CHUNK or int.from_bytes(record[at : at + 8], "little") != len(packed):
        raise ValueError("not a whole chunk")
    if size > limit:
        raise OversizedError(f"a chunk of {size:,} bytes, above the limit of {limit:,}")
    if name == b"zstd":
        if zstandard.get_frame_parameters(packed).content_size not in {size, zstandard.CONTENTSIZE_UNKNOWN}:
            raise ValueError("a chunk differs from its size")  # the library would allocate what the frame claims
        data = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK).decompress(packed, max_output_size=size)
    elif name == b"lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    elif not name:
        data = packed
    else:
        raise ValueError(f"unknown compression {name!r}")
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise ValueError("a chunk differs from its checksum")
    return data


@lru_cache(maxsize=256)
def _list_lacking(kind: str, data: bytes) -> list[str]:
    """Return the required fields of a kind that a JSON schema does not have."""
    try:
        properties = json.loads(data).get("properties")
    except (ValueError, AttributeError, RecursionError):
        return []
    if not properties or not isinstance(properties, dict):
        return []
    return sorted(set(make_schema(kind)["required"]) - set(properties))


def explain_foreign_channel(topic: str, encoding: str, name: str, schema_encoding: str, data: bytes) -> str:
    """Return the reason why a channel does not follow the wire contract.

    Returns
    -------
    str
        Empty for a channel that follows the contract, and for one that may follow it.
    """
    known = address(topic)
    if encoding == ARROW and known is not None and known.kind == BATCH:
        return ""
    if encoding not in {"", "json"} or schema_encoding not in {"", "jsonschema"}:
        return f"topic {topic} holds {encoding or schema_encoding} messages, schema {name or 'none'}, not JSON"
    lacking = _list_lacking(known.kind, data) if known and known.kind != BATCH and data else []
    return f"topic {topic} has schema {name}, which lacks `{'`, `'.join(lacking)}`" if lacking else ""
