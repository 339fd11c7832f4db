"""Read CSV and Parquet files as blocks of columns, in bounded memory."""

import csv
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from core.errors import ImportFileError
from tools.importers.table.column_map import FileFormat

BLOCK_BYTES: Final = 4 << 20
"""Part of a CSV file that is parsed at a time. [B]"""
BLOCK_ROWS: Final = 1 << 16
"""Rows of a Parquet file that are read at a time."""
HEAD_BYTES: Final = 1 << 18
"""Part of a CSV file from which its form is found. [B]"""
SEPARATORS: Final = (",", ";", "\t", "|")
MOST_ABOVE: Final = 50
"""Lines among which the header is looked for."""
WRONG_WIDTH: Final = "another number of cells than the header"
"""Cause: a row that cannot be divided into columns."""
UNKNOWN: Final = ("", "NaN", "nan", "NA", "N/A", "n/a", "null", "NULL", "None", "none", "-", "\\N", "#N/A")
"""Cells that mean an unknown value."""
KINDS: Final[Mapping[str, tuple[str, ...]]] = {
    "csv": (".csv", ".tsv", ".txt", ".csv.gz", ".tsv.gz", ".txt.gz"),
    "parquet": (".parquet", ".pq"),
}
"""Kind of a table -> endings of its files in a folder."""

OTHER_KINDS: Final[Mapping[bytes, str]] = {
    b"PK\x03\x04": "an Excel workbook or another archive",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook",
    b"{": "JSON",
    b"[": "JSON",
    b"<": "XML or HTML, such as GPX",
    b"SQLite format 3": "an SQLite database",
}
"""First bytes of files that are no tables of text -> what they are."""
COMPRESSED: Final[Mapping[str, str]] = {".gz": "gzip", ".bz2": "bzip2", ".zst": "Zstandard", ".lz4": "LZ4"}
"""Ending of a compressed file -> its form."""
MOST_CONTROLS: Final = 0.01
"""Share of control characters above which a file is no text. [1]"""
_CONTROLS: Final = bytes(each for each in range(32) if each not in b"\t\n\v\f\r\x1b\x1a")
_VALUE: Final = re.compile(r"[+-]?\d+([.,]\d+)?|\d{1,4}[-/.]\d\d?[-/.]\d{1,4}([ T].*)?")
"""A number or a date, with which no header is filled."""
_THOUSANDS: Final = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""A number whose comma may divide thousands."""

Block = Mapping[str, pa.Array]


class TableFile(NamedTuple):
    """Hold the form of a table in a file.

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        `csv` or `parquet`.
    names : tuple of str
        Names of the columns. Where several have one name, they are called `NAME#1`, `NAME#2` and so on.
    separator, decimal, encoding : str
        Form of a CSV file.
    skip_lines : int
        Lines above the header.
    extra_cells : bool
        Whether rows may have more cells than the header; those beyond it are not read.
    """

    path: Path
    kind: str
    names: tuple[str, ...]
    separator: str = ","
    decimal: str = "."
    encoding: str = "utf-8"
    skip_lines: int = 0
    extra_cells: bool = False

    @property
    def stem(self) -> str:
        """Name of the file without its endings."""
        return self.path.name.split(".")[0]

    def check_columns(self, needed: Sequence[str]) -> None:
        """Refuse a file that lacks a column."""
        for name in needed:
            if name in self.names:
                continue
            if same := [each for each in self.names if each.rpartition("#")[0] == name]:
                raise ImportFileError(
                    f"{self.path}: column '{name}' appears {len(same)} times; write {' or '.join(same)} in the map"
                )
            listed = ", ".join(self.names[:12]) + (", ..." if len(self.names) > 12 else "")
            raise ImportFileError(f"{self.path}: has no column '{name}'; it has {listed}; correct the map")

    def iterate_blocks(self, columns: Sequence[str], causes: Counter[str]) -> Iterator[Block]:
        """Yield the rows of the file in blocks of columns; cells of a CSV file are text, null where unknown.

        Parameters
        ----------
        columns : sequence of str
            Columns to read; those that the file lacks are left out.
        causes : Counter of str
            Receives the number of rows that cannot be divided into columns.
        """
        present = [name for name in columns if name in self.names]
        with _one_line(self.path):
            blocks = self._read_csv(present, causes) if self.kind == "csv" else self._read_parquet(present)
            for batch in blocks:
                yield dict(zip(present, batch.columns, strict=True))

    def _read_csv(self, columns: list[str], causes: Counter[str]) -> Iterator[Any]:
        """Yield the record batches of a CSV file."""
        longer: list[str] = []

        def skip(row: Any) -> str:
            if self.extra_cells and row.actual_columns > row.expected_columns:
                longer.append(row.text)
            else:
                causes[WRONG_WIDTH] += 1
            return "skip"

        with pa.input_stream(str(self.path), compression="detect") as stream:
            batches = pacsv.open_csv(
                stream,
                read_options=pacsv.ReadOptions(
                    use_threads=False,
                    block_size=BLOCK_BYTES,
                    skip_rows=self.skip_lines + 1,
                    column_names=list(self.names),
                    encoding=self.encoding,
                ),
                parse_options=pacsv.ParseOptions(delimiter=self.separator, invalid_row_handler=skip),
                convert_options=pacsv.ConvertOptions(
                    column_types=dict.fromkeys(columns, pa.string()),
                    include_columns=columns,
                    strings_can_be_null=True,
                    quoted_strings_can_be_null=True,
                    null_values=list(UNKNOWN),
                ),
            )
            for batch in batches:
                yield batch
                if longer:
                    yield self._cut_rows(longer, columns)
                    longer.clear()
            if longer:
                yield self._cut_rows(longer, columns)

    def _cut_rows(self, lines: list[str], columns: list[str]) -> Any:
        """Return rows that are longer than the header, without the cells beyond it."""
        rows = list(csv.reader(lines, delimiter=self.separator))
        places = [self.names.index(name) for name in columns]
        cells = [[None if row[place] in UNKNOWN else row[place] for row in rows] for place in places]
        return pa.record_batch([pa.array(column, pa.string()) for column in cells], names=columns)

    def _read_parquet(self, columns: list[str]) -> Iterator[Any]:
        """Yield the record batches of a Parquet file."""
        with pq.ParquetFile(self.path) as file:
            for batch in file.iter_batches(batch_size=BLOCK_ROWS, columns=columns):
                yield batch.select(columns)


def open_table(path: Path, kind: str, form: FileFormat) -> TableFile:
    """Return the form of a table: as the map gives it, else as the file shows it.

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        `csv` or `parquet`.
    form : FileFormat
        What the map says of the form.

    Raises
    ------
    ImportFileError
        If the file cannot be read, is of the other kind or has no header.
    """
    with _one_line(path):
        if kind == "parquet":
            with pq.ParquetFile(path) as file:
                return TableFile(path, kind, _number_duplicates(file.schema_arrow.names))
        with pa.input_stream(str(path), compression="detect") as stream:
            head = stream.read(HEAD_BYTES)
    if not head.strip():
        raise ImportFileError(f"{path}: is empty; leave it out")
    if head.startswith(b"PAR1"):
        raise ImportFileError(f"{path}: is a Parquet file; use `socast import parquet`")
    for start, words in OTHER_KINDS.items():
        if head.lstrip().startswith(start):
            raise ImportFileError(f"{path}: is {words}; save it as CSV and import that")
    encoding = form.encoding or _find_encoding(head)
    if not encoding.lower().startswith("utf-16") and len(head.translate(None, _CONTROLS)) < len(head) * (
        1 - MOST_CONTROLS
    ):
        raise ImportFileError(f"{path}: is no text file; leave it out, or save the table as CSV")
    try:
        lines = head.decode(encoding, "replace").lstrip("\ufeff").splitlines()
    except LookupError as error:
        raise ImportFileError(
            f"{path}: encoding '{encoding}' is not known; write one such as utf-8 or latin-1"
        ) from error
    skipped = form.skip_lines or _find_header(lines)
    lines = lines[skipped:]
    if not lines or not lines[0].strip():
        raise ImportFileError(f"{path}: has no header in line {skipped + 1}; set skip_lines in [file] of the map")
    separator = form.separator or max(SEPARATORS, key=lambda each: len(_split(lines[0], each)))
    names = _number_duplicates([name.strip() for name in _split(lines[0], separator)])
    if sum(map(_is_value, names)) > len(names) / 2:
        raise ImportFileError(
            f"{path}: line {skipped + 1} holds values such as {names[0]!r}, and no names of columns; write a line "
            "of names above it, such as time,speed_kmh,power_kw"
        )
    complete = lines[1:-1] if len(head) == HEAD_BYTES else lines[1:]
    decimal = form.decimal or _find_decimal([_split(line, separator) for line in complete[:200]], separator)
    return TableFile(path, kind, names, separator, decimal, encoding, skipped, form.extra_cells)


def list_tables(paths: Sequence[Path], kind: str) -> list[Path]:
    """Return the files to read, with each folder replaced by its tables in the order of their names."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(each for each in path.iterdir() if each.name.lower().endswith(KINDS[kind]))
            if not inside:
                raise ImportFileError(f"{path}: holds no file that ends in {' or '.join(KINDS[kind])}; name the files")
            files += inside
        else:
            files.append(path)
    return files


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turn errors of files and of their form into one line."""
    try:
        yield
    except OSError as error:
        if error.errno is None and path.suffix in COMPRESSED:
            raise ImportFileError(
                f"{path}: is no {COMPRESSED[path.suffix]} file, or is incomplete; copy it again, or leave it out"
            ) from error
        reason = os.strerror(error.errno) if error.errno else error
        raise ImportFileError(f"{path} cannot be read: {reason}; name an existing file") from error
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise ImportFileError(f"{path} is damaged or of another form: {error}; export it again") from error


def _find_header(lines: Sequence[str]) -> int:
    """Return the number of lines above the header: lines without any separator, before one with separators."""
    if len(lines) < 2 or any(separator in lines[0] for separator in SEPARATORS):
        return 0
    found = next((at for at, line in enumerate(lines[:MOST_ABOVE]) if any(mark in line for mark in SEPARATORS)), 0)
    follows = lines[found + 1] if found and found + 1 < len(lines) else ""
    return found if any(mark in lines[found] and mark in follows for mark in SEPARATORS) else 0


def _is_value(name: str) -> bool:
    """Return whether a cell of a header is a number or a date."""
    return _VALUE.fullmatch(name.partition("#")[0]) is not None


def _split(line: str, separator: str) -> list[str]:
    """Return the cells of a line."""
    return next(csv.reader([line], delimiter=separator), [])


def _find_encoding(head: bytes) -> str:
    """Return the encoding that the first bytes of a file show."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        head[: head.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def _find_decimal(rows: Sequence[Sequence[str]], separator: str) -> str:
    """Return the decimal mark of the numbers in a file; beside a separating comma, numbers with a comma are quoted."""
    cells = [cell.strip() for row in rows for cell in row]
    commas, points = ([cell for cell in cells if _is_decimal(cell, mark)] for mark in (",", "."))
    if separator == "," and all(_THOUSANDS.fullmatch(cell) for cell in commas):
        return "."
    return "," if len(commas) > len(points) else "."


def _is_decimal(cell: str, mark: str) -> bool:
    """Return whether a cell is a number with a decimal mark."""
    whole, found, part = cell.lstrip("+-").partition(mark)
    return bool(found) and part.isdigit() and (whole.isdigit() or not whole)


def _number_duplicates(names: Sequence[str]) -> tuple[str, ...]:
    """Return column names, each of those that appear several times with its number.

    >>> _number_duplicates(["a", "b", "a", ""])
    ('a#1', 'b', 'a#2', 'column 4')
    """
    filled = [name or f"column {at}" for at, name in enumerate(names, start=1)]
    count, seen = Counter(filled), Counter[str]()
    numbered = []
    for name in filled:
        seen[name] += 1
        numbered.append(f"{name}#{seen[name]}" if count[name] > 1 else name)
    return tuple(numbered)
