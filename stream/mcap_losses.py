"""What a reader could not read from an MCAP file, and the limits beyond which it leaves data out."""

from collections import Counter
from dataclasses import dataclass, field, fields
from typing import Any, Final

from socast.stream.mcap_format import LARGEST_CHUNK
from socast.stream.waiting_messages import MOST_HELD

EXPANSION: Final = 200
"""Largest ratio of the size of decompressed chunks to the size of what was read of the file."""
ALLOWANCE: Final = 64 << 20
"""Size that chunks may have beyond that ratio. [B]"""


@dataclass
class Losses:
    """Count the data that could not be read from a recording.

    Parameters
    ----------
    unfinished : bool
        Whether the file has no end mark, because it is still being written or its writer was killed. Data that a killed
        writer had not yet written are lost.
    truncated_bytes : int
        Size of the incomplete record at the end of each recording in the file. [B]
    damaged_chunks, damaged_bytes : int
        Number and total size of the chunks that do not decompress or whose checksum differs. [1], [B]
    missing_messages : int
        Number of messages that the summary counts but the chunks do not contain.
    undescribed : int
        Number of messages whose channel the file does not describe.
    foreign : Counter
        Number of messages outside the wire contract by topic, because of another encoding or schema.
    oversized, oversized_bytes : int
        Number and total size in the file of the chunks and messages that exceed a limit. [1], [B]
    disordered : int
        Number of messages that came after messages with a later time of receipt.
    is_contradicted : bool
        Whether the summary lists chunks that overlap, repeat or lie outside the file, or not all of them.
    stray_bytes : int
        Size of what lies in the file after or between recordings. [B]
    """

    unfinished: bool = False
    truncated_bytes: int = 0
    damaged_chunks: int = 0
    damaged_bytes: int = 0
    missing_messages: int = 0
    undescribed: int = 0
    foreign: Counter[str] = field(default_factory=Counter)
    oversized: int = 0
    oversized_bytes: int = 0
    disordered: int = 0
    is_contradicted: bool = False
    stray_bytes: int = 0

    def __bool__(self) -> bool:
        """Return whether anything was lost."""
        return bool(self.lines())

    def add(self, other: "Losses") -> "Losses":
        """Return these losses and those of another part of the recording."""
        pairs = {each.name: (getattr(self, each.name), getattr(other, each.name)) for each in fields(self)}
        sums: dict[str, Any] = {name: a or b if isinstance(a, bool) else a + b for name, (a, b) in pairs.items()}
        return Losses(**sums)

    def lines(self) -> list[str]:
        """Return one sentence per kind of loss; an empty list for a complete recording."""
        foreign = self.foreign.total()
        sentences: dict[str, object] = {
            "it has no end: it is still being written, or its writer was killed; "
            f"{self.truncated_bytes:,} bytes after its last whole chunk are not read": self.unfinished,
            f"{self.damaged_chunks:,} damaged chunks, {self.damaged_bytes:,} bytes, are lost": self.damaged_chunks,
            f"{self.missing_messages:,} messages that its summary counts are lost": self.missing_messages,
            f"{self.undescribed:,} messages of channels that are nowhere described are left out": self.undescribed,
            f"{foreign:,} messages on {len(self.foreign):,} topics outside the contract are left out": foreign,
            f"{self.oversized:,} chunks, {self.oversized_bytes:,} bytes, are left out: a chunk may have "
            f"{LARGEST_CHUNK >> 20} MiB, and all may expand to {EXPANSION} times the file and "
            f"{ALLOWANCE >> 20} MiB; write smaller chunks": self.oversized,
            f"{self.disordered:,} messages come out of order: chunks give a wrong time span, or more than "
            f"{MOST_HELD >> 20} MiB would have to wait; sort the recording by log time": self.disordered,
            "its summary contradicts the file: the chunks were found by a scan": self.is_contradicted,
            f"{self.stray_bytes:,} bytes after the end of a recording are none, and are not read": self.stray_bytes,
        }
        return [sentence for sentence, applies in sentences.items() if applies]
