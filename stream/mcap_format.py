"""The records of an MCAP file, taken apart.

References
----------
MCAP format specification, https://mcap.dev/spec.
"""

import json
import struct
import zlib
from collections.abc import Iterator
from functools import lru_cache
from typing import Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from core.wire.messages import address
from core.wire.schema import make_schema

MAGIC: Final = b"\x89MCAP0\r\n"
LARGEST_CHUNK: Final = 1 << 30
"""A chunk that claims to be larger is damaged. [B]"""

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, STATISTICS, DATA_END = 2, 3, 4, 5, 6, 8, 11, 15
RECORD: Final = struct.Struct("<BQ")
"""What every record begins with: opcode, length of the rest."""
MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time."""
FOOTER_RECORD: Final = struct.Struct("<BQQQI")
"""Opcode, length, start of the summary, start of its offsets, CRC."""
_CHUNK_HEAD: Final = struct.Struct("<BQQQQII")  # opcode, length, first, last time, size, CRC, length of a name
_LENGTH: Final = struct.Struct("<I")


def iterate_records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of each record."""
    at = 0
    while at < len(data):
        opcode, length = RECORD.unpack_from(data, at)
        at += RECORD.size + length
        yield opcode, data[at - length : at]


def iterate_strings(body: bytes, at: int, count: int) -> Iterator[bytes]:
    """Yield strings that follow their length."""
    for _ in range(count):
        (length,) = _LENGTH.unpack_from(body, at)
        at += _LENGTH.size + length
        if at > len(body):
            raise ValueError("a string reaches beyond its record")
        yield body[at - length : at]


def decompress_chunk(record: bytes) -> bytes:
    """Return what is in a chunk, checked."""
    opcode, _, _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(record)
    at = _CHUNK_HEAD.size + name_length
    name = record[_CHUNK_HEAD.size : at]
    packed = record[at + 8 :]
    if opcode != CHUNK or size > LARGEST_CHUNK or int.from_bytes(record[at : at + 8], "little") != len(packed):
        raise ValueError("not a whole chunk")
    if name == b"zstd":
        data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    elif name == b"lz4":
        data = lz4.frame.decompress(packed)
    elif not name:
        data = packed
    else:
        raise ValueError(f"unknown compression {name!r}")
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise ValueError("a chunk differs from its checksum")
    return data


@lru_cache(maxsize=256)
def _lacking(kind: str, data: bytes) -> list[str]:
    """Return the fields that a kind must have and a JSON schema does not know."""
    try:
        properties = json.loads(data).get("properties")
    except (ValueError, AttributeError):
        return []
    return sorted(set(make_schema(kind)["required"]) - set(properties)) if properties else []


def explain_foreign_channel(topic: str, encoding: str, name: str, schema_encoding: str, data: bytes) -> str:
    """Say why a channel is not of the wire contract; empty for one that is, and for whatever may be."""
    if encoding not in {"", "json"} or schema_encoding not in {"", "jsonschema"}:
        return f"topic {topic} holds {encoding or schema_encoding} messages, schema {name or 'none'}, not JSON"
    known = address(topic)
    lacking = _lacking(known.kind, data) if known and data else []
    return f"topic {topic} has schema {name}, which lacks `{'`, `'.join(lacking)}`" if lacking else ""
