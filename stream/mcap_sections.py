"""Find the recordings in an MCAP file, which may hold several one after another, as `cat a.mcap b.mcap` leaves them."""

import errno
import os
from collections import deque
from typing import BinaryIO, Final, NamedTuple

from socast.stream.mcap_format import (
    CHUNK,
    DAMAGE,
    DATA_END,
    FOOTER,
    FOOTER_RECORD,
    HEADER,
    LARGEST_CHUNK,
    MAGIC,
    RECORD,
    decompress_chunk,
)
from socast.stream.mcap_scan import scan_chunk

MOST_SECTIONS: Final = 10_000
"""Largest number of recordings in a file; more are left out."""
_BEGIN: Final = MAGIC + bytes([HEADER])
_HEAD: Final = len(_BEGIN) + 8 + 4  # and the length of the header, and that of its first string
_LARGEST_HEADER: Final = 4096
_BLOCK: Final = 1 << 20
_CHECKED: Final = 8  # last chunks of which an intact one is looked for, each once


class Section(NamedTuple):
    """Locate a recording in a file.

    Parameters
    ----------
    begin, end : int
        Its first byte, which every place in it is relative to, and the byte after its last one.
    """

    begin: int
    end: int


def find_sections(file: BinaryIO) -> tuple[list[Section], int]:
    """Return the recordings in a file that begins with one, and the number of bytes that belong to none.

    A recording ends with its footer. One that breaks off or is damaged ends where the next one begins.
    """
    size = file.seek(0, 2)
    sections: list[Section] = []
    begin, stray = 0, 0
    while begin < size:
        if len(sections) == MOST_SECTIONS:
            return sections, stray + size - begin
        end, is_whole = _find_end(file, begin, size)
        following = _find_begin(file, end, size)
        sections.append(Section(begin, end if is_whole else following))
        stray += following - end if is_whole else 0
        begin = following
    return sections, stray


def _find_end(file: BinaryIO, begin: int, size: int) -> tuple[int, bool]:
    """Return the end of a recording after its footer, or else the end of its last intact chunk.

    Where a recording breaks off, its last record seems to go on in the next recording, and records seem to follow it. A
    footer that they lead to is that of the next recording: its summary follows its data, and tells where it begins.
    """
    at = summary = begin + len(MAGIC)
    chunks: deque[tuple[int, int]] = deque(maxlen=_CHECKED)
    while at + RECORD.size <= size:
        file.seek(at)
        opcode, length = RECORD.unpack(file.read(RECORD.size))
        end = at + RECORD.size + length
        if not opcode or end > size:
            break
        if opcode == CHUNK:
            chunks.append((at, end))
        if opcode == DATA_END:
            summary = end
        if opcode == FOOTER and end == at + FOOTER_RECORD.size:
            file.seek(at)
            _, _, summary_start, _, _ = FOOTER_RECORD.unpack(file.read(FOOTER_RECORD.size))
            found = file.read(len(_BEGIN))
            other = summary - summary_start if summary_start else begin
            if other > begin and _begins(file, other):
                return other, False
            if found == _BEGIN:
                return end, False
            if found[: len(MAGIC)] == MAGIC:
                return end + len(MAGIC), True
        at = end
    intact = (end for start, end in reversed(chunks) if _is_intact(file, start, end))
    return next(intact, begin + len(MAGIC)), False


def _begins(file: BinaryIO, at: int) -> bool:
    """Return whether a recording begins at a place."""
    file.seek(at)
    return file.read(len(_BEGIN)) == _BEGIN


def _is_intact(file: BinaryIO, start: int, end: int) -> bool:
    """Return whether a record is a chunk that can be read."""
    if end - start > LARGEST_CHUNK:
        return False
    file.seek(start)
    try:
        return not scan_chunk(decompress_chunk(file.read(end - start))).is_damaged
    except DAMAGE:
        return False


def _find_begin(file: BinaryIO, at: int, size: int) -> int:
    """Return where the next recording begins, at a place or later, or else the end of the file."""
    number = file.fileno()
    before = os.lseek(number, 0, os.SEEK_CUR)
    try:
        while at < size:
            try:
                at = os.lseek(number, at, os.SEEK_DATA)
            except OSError as error:
                if error.errno == errno.ENXIO:  # nothing but a hole follows
                    return size
            block = os.pread(number, _BLOCK + _HEAD, at)
            place = block.find(_BEGIN)
            while 0 <= place < _BLOCK:
                if _is_header(block[place : place + _HEAD]):
                    return at + place
                place = block.find(_BEGIN, place + 1)
            at += _BLOCK
    finally:
        os.lseek(number, before, os.SEEK_SET)
    return size


def _is_header(head: bytes) -> bool:
    """Return whether bytes that begin as a recording go on as one: its header has a plausible size."""
    length = int.from_bytes(head[len(_BEGIN) : -4], "little")
    return len(head) == _HEAD and length <= _LARGEST_HEADER and 8 + int.from_bytes(head[-4:], "little") <= length
