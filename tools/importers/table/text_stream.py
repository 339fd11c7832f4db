"""Read a text file as clean UTF-8, and count rows and files that cannot be read, with the first one and a remedy."""

import codecs
import csv
import io
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from socast.core.errors import ImportFileError
from socast.tools.importers.table.cells import is_grouped, is_value
from socast.tools.importers.table.guess_names import guess_name

READ_BYTES: Final = 1 << 20
"""Part of a file that is decoded at a time. [B]"""
MOST_BLANK: Final = 10_000
"""Blank lines that are noted."""
LETTERS: Final = "windows-1252"
"""Encoding of letters that are no UTF-8, which includes Latin-1."""
MOST_ZEROS: Final = 0.2
"""Share of NUL bytes at even or odd places from which a text is UTF-16. [1]"""
_BLANK: Final = re.compile(rb"\n[ \t]*\r?(?=\n)")
_DEGREES: Final = {b"\xb0": LETTERS, b"\xa1": "mac_roman", b"\xf8": "cp850"}
"""Sign of degrees in one byte -> encoding."""
_HANDLER: Final = "socast-single-bytes"
WRONG_WIDTH: Final = "another number of cells than the header"
"""Cause: a row that cannot be divided into columns."""
DIVIDED_THOUSANDS: Final = (
    "more cells than the header, because thousands separators divide their numbers (export them without thousands "
    "separators, or in quotes, or with ';' between the cells)"
)
DIVIDED_DECIMALS: Final = (
    "more cells than the header, because decimal commas divide their numbers (export with ';' between the cells, or "
    "with decimal points)"
)
OPEN_QUOTE: Final = "a quote that is opened and not closed, up to the next quote (close or remove it)"
HEADER_AGAIN: Final = "the header again, as in joined files"
LONGEST_EXAMPLE: Final = 60
"""Letters of a row that are shown."""


class _SingleBytes:
    """Decode bytes that are no UTF-8 as single letters, and count them."""

    def __init__(self) -> None:
        self.count = 0
        self.encoding = LETTERS

    def __call__(self, error: Any) -> tuple[str, int]:
        """Return the letters of the bytes, and where to go on."""
        wrong = error.object[error.start : error.end]
        self.count += len(wrong)
        return wrong.decode(self.encoding, "replace"), error.end


_single_bytes = _SingleBytes()
codecs.register_error(_HANDLER, _single_bytes)


class TextStream(io.RawIOBase):
    """Yield the bytes of a text file as UTF-8.

    Parameters
    ----------
    encoding : str
        Its encoding. Letters that are no UTF-8 in a file of UTF-8 are read as those of `LETTERS`.

    Attributes
    ----------
    blank_lines : list of int
        Numbers of the first blank lines so far.
    """

    def __init__(self, path: Path, encoding: str) -> None:
        self.blank_lines: list[int] = []
        self._path, self._encoding = path, encoding
        self._is_utf8 = codecs.lookup(encoding).name in {"utf-8", "utf-8-sig"}
        errors = _HANDLER if self._is_utf8 else "strict"
        self._decoder = codecs.getincrementaldecoder("utf-8" if self._is_utf8 else encoding)(errors)
        self._raw = pa.input_stream(str(path), compression="detect")
        self._buffer, self._line, self._last = b"", 1, b""
        self._is_pending = self._is_ended = False
        self._nuls = self._letters = self._first_nul = self._first_letter = 0

    def readable(self) -> bool:
        """Return that the stream can be read."""
        return True

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes, at most as many as asked for."""
        while not self._is_ended and (size < 0 or len(self._buffer) < size):
            self._buffer += self._take()
        part = self._buffer if size < 0 else self._buffer[:size]
        self._buffer = self._buffer[len(part) :]
        return part

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer with the next bytes, and return their number."""
        part = self.read(len(buffer))
        buffer[: len(part)] = part
        return len(part)

    def close(self) -> None:
        """Close the file."""
        self._raw.close()
        super().close()

    def list_notes(self) -> list[str]:
        """Return what a person should know of the bytes read so far."""
        notes = []
        if self._nuls:
            notes.append(
                f"{self._path}: {self._nuls:,} NUL bytes, as a loss of power leaves them, are left out, "
                f"the first in line {self._first_nul}"
            )
        if self._letters:
            notes.append(
                f"{self._path}: {self._letters:,} letters from line {self._first_letter} on are no UTF-8 and "
                f"are read as {LETTERS} (Latin-1); set encoding in [file] if they are of another one"
            )
        return notes

    def _take(self) -> bytes:
        """Return the next part of the file in UTF-8."""
        raw = self._raw.read(READ_BYTES)
        self._is_ended = not raw
        if self._is_utf8 and not self._is_pending and raw.isascii():
            data = raw
        else:
            data = self._decode(raw).replace("\ufeff", "").encode()
        if b"\0" in data:
            self._first_nul = self._first_nul or self._line + _count_lines(data[: data.index(b"\0")])
            self._nuls += data.count(b"\0")
            data = data.replace(b"\0", b"")
        self._note_lines(data)
        return bytes(data)

    def _decode(self, raw: bytes) -> str:
        """Return the text of bytes."""
        before = _single_bytes.count
        try:
            text: str = self._decoder.decode(raw, self._is_ended)
        except UnicodeDecodeError as error:
            raise ImportFileError(
                f"{self._path}: line {self._line} or a later one holds bytes that are no {self._encoding} "
                f"({error.reason}); set encoding in [file] of the map, such as utf-8 or latin-1"
            ) from error
        self._is_pending = bool(self._decoder.getstate()[0])
        if found := _single_bytes.count - before:
            if not self._letters:
                first = _find_first_wrong(raw)
                self._first_letter = self._line + _count_lines(raw[:first])
            self._letters += found
        return text

    def _note_lines(self, data: bytes) -> None:
        """Count the lines of bytes, and note the blank ones."""
        if len(self.blank_lines) < MOST_BLANK:
            whole, offset = self._last + data, len(self._last)
            line, at = self._line, offset
            for found in _BLANK.finditer(whole):
                start = max(found.start() + 1, at)
                line, at = line + _count_lines(whole[at:start]), start
                self.blank_lines.append(line)
        self._line += _count_lines(data)
        self._last = data[-1:]


def find_encoding(head: bytes) -> str:
    r"""Return the encoding that the first bytes of a file show.

    Examples
    --------
    >>> find_encoding("Höhe (m)\n".encode("latin-1")), find_encoding("Température (°C)\n".encode("mac_roman"))
    ('windows-1252', 'mac_roman')
    >>> find_encoding("time,speed\n".encode("utf-16-le"))
    'utf-16-le'
    """
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    even, odd = head[0::2].count(0), head[1::2].count(0)
    if max(even, odd) > MOST_ZEROS * len(head) / 2 and min(even, odd) < max(even, odd) / 10:
        return "utf-16-le" if odd > even else "utf-16-be"
    whole = head[: head.rfind(b"\n") + 1] or head
    try:
        whole.decode("utf-8")
    except UnicodeDecodeError:
        return "utf-8" if _is_mostly_utf8(whole) else _find_single_byte_encoding(whole)
    return "utf-8"


def _is_mostly_utf8(text: bytes) -> bool:
    """Return whether most letters beyond ASCII are UTF-8, as where files of two encodings were joined."""
    return len(re.findall(rb"[\xc2-\xf4][\x80-\xbf]+", text)) > len(re.findall(rb"[\x80-\xff]+", text)) / 2


def _find_single_byte_encoding(text: bytes) -> str:
    """Return the encoding of letters of one byte, by the sign of degrees, else by where letters stand."""
    if found := re.search(rb"(?<![\x80-\xff])([\xb0\xa1\xf8])\s?[CF]\b", text):
        return _DEGREES[found[1]]
    low = len(re.findall(rb"(?<=[A-Za-z])[\x80-\x9f](?=[a-z])", text))
    high = len(re.findall(rb"[\xc0-\xff]", text))
    return "mac_roman" if low > high else LETTERS


def _find_first_wrong(raw: bytes) -> int:
    """Return the place of the first byte that is no UTF-8."""
    try:
        raw.decode("utf-8")
    except UnicodeDecodeError as error:
        return error.start
    return 0


def _count_lines(data: bytes) -> int:
    """Return the number of ends of lines, of any kind."""
    ends = data.count(b"\n")
    return ends + data.count(b"\r") - data.count(b"\r\n") if b"\r" in data else ends


class RowFaults:
    """Count rows that cannot be read by cause, with the place of the first one.

    Attributes
    ----------
    places : dict of str to str
        Cause -> file, line and text of its first row.
    notes : list of str
        What else a person should know of the files.
    blank_lines : list of int
        Blank lines of the file that is read.
    numbers : (n,) int
        Numbers of the rows of the block that is read, counted in the file without blank lines.
    wide : int
        Rows that cannot be divided into columns.
    """

    def __init__(self) -> None:
        self.causes: Counter[str] = Counter()
        self.places: dict[str, str] = {}
        self.notes: list[str] = []
        self.wide = 0
        self.numbers = np.zeros(0, "i8")
        self.blank_lines: list[int] = []

    def start_file(self, blank_lines: list[int]) -> None:
        """Begin a file, whose blank lines are noted while it is read."""
        self.blank_lines, self.numbers = blank_lines, np.zeros(0, "i8")

    def take_lines(self, other: "RowFaults") -> None:
        """Take over where the rows of a block stand in their file."""
        self.blank_lines, self.numbers = other.blank_lines, other.numbers

    def find_line(self, row: int) -> int | None:
        """Return the line of a row of the block that is read, None where it is not known."""
        return self.count_blank(int(self.numbers[row])) if row < len(self.numbers) else None

    def count_blank(self, number: int) -> int:
        """Return the line of a row whose number leaves out blank lines."""
        for blank in self.blank_lines:
            number += blank <= number
        return number

    def add(self, cause: str, count: int, path: Path, line: int | None, text: str) -> None:
        """Count rows by their cause."""
        self.causes[cause] += count
        if cause not in self.places:
            where = f"{path.name} line {line}" if line is not None else path.name
            shown = text if len(text) <= LONGEST_EXAMPLE else f"{text[:LONGEST_EXAMPLE]}..."
            self.places[cause] = f"first in {where}: {shown!r}" if text else f"first in {where}"

    def add_wide(self, cause: str, count: int, path: Path, line: int | None, text: str) -> None:
        """Count rows that cannot be divided into columns by their cause."""
        self.wide += count
        self.add(cause, count, path, line, text)

    def explain(self) -> str:
        """Return the causes with their numbers, the most frequent first."""
        return ", ".join(f"{count:,} with {cause}" for cause, count in self.causes.most_common())

    def explain_first(self) -> str:
        """Return the place of the first row of the most frequent cause, empty where there is none."""
        return next((self.places[cause] for cause, _ in self.causes.most_common(1) if cause in self.places), "")


def find_width_cause(text: str, names: Sequence[str], separator: str) -> str:
    """Return why a row has another number of cells than the header.

    Examples
    --------
    >>> find_width_cause("7,12,000.5,80", ["t", "odometer", "soc"], ",") == DIVIDED_THOUSANDS
    True
    >>> find_width_cause("7,0,5,79,9", ["t", "speed", "soc"], ",") == DIVIDED_DECIMALS
    True
    """
    if "\n" in text or "\r" in text or text.count('"') % 2:
        return OPEN_QUOTE
    cells = next(csv.reader([text], delimiter=separator), [])
    extra = len(cells) - len(names)
    if extra <= 0 or separator != ",":
        return WRONG_WIDTH
    if _join_thousands(cells) <= len(names) < len(cells):
        return DIVIDED_THOUSANDS
    numbers = sum(cell.strip().lstrip("+-").isdigit() for cell in cells)
    return DIVIDED_DECIMALS if numbers >= 2 * extra else WRONG_WIDTH


def is_header(cells: Sequence[str | None], names: Sequence[str]) -> bool:
    """Return whether cells are names of columns: of at least two, and with no value among them."""
    words = [cell.strip() for cell in cells if cell and cell.strip()]
    if len(words) < 2 or any(map(is_value, words)):
        return False
    known = sum(word in names or guess_name(word) is not None for word in words)
    return known >= max(2, len(words) / 2)


def find_open_quote(path: Path, encoding: str) -> int | None:
    """Return the number of the first line with an odd number of quotes, None where there is none."""
    with TextStream(path, encoding) as stream:
        for number, line in enumerate(io.TextIOWrapper(io.BufferedReader(stream), "utf-8", "replace"), start=1):
            if line.count('"') % 2:
                return number
    return None


def _join_thousands(cells: Sequence[str]) -> int:
    """Return the least number of cells that remains where cells that continue a number are joined to it."""
    count, at = 0, 0
    while at < len(cells):
        end = at + 1
        while end < len(cells) and is_grouped(
            ",".join(cell.strip() for cell in cells[at : end + 1]), ".", is_sure=False
        ):
            end += 1
        count, at = count + 1, end
    return count


class SkippedFiles:
    """Collect the files of an import that cannot be read.

    Parameters
    ----------
    is_active : bool
        Whether to skip them; otherwise the first one ends the import.

    Attributes
    ----------
    rows : dict of Path to int
        File -> rows that were read before the damage, and are kept.
    """

    def __init__(self, is_active: bool = False) -> None:
        self.is_active = is_active
        self.rows: dict[Path, int] = {}
        self._causes: dict[str, list[Path]] = defaultdict(list)

    @contextmanager
    def skip(self, path: Path) -> Iterator[None]:
        """Skip a file with an error, where files are skipped."""
        try:
            yield
        except ImportFileError as error:
            if not self.is_active:
                raise
            self.rows.setdefault(path, 0)
            cause = str(error).removeprefix(str(path)).lstrip(": ").partition(";")[0]
            self._causes[cause].append(path)

    def list_lines(self, files: int) -> list[str]:
        """Return a line for each cause, the most frequent first."""
        lines = []
        for cause, paths in sorted(self._causes.items(), key=lambda item: -len(item[1])):
            others = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
            kept = sum(self.rows[path] for path in paths)
            rows = f"; {kept:,} rows before the damage are kept" if kept else ""
            lines.append(f"skipped {len(paths)} of {files} files ({paths[0].name}{others}): {cause}{rows}")
        return lines
