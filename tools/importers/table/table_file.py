"""Read CSV and Parquet files as blocks of columns, in bounded memory."""

import csv
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from socast.core.errors import ImportFileError
from socast.tools.importers.table.cells import (
    SEPARATORS,
    find_decimal,
    find_grouped,
    find_header,
    find_units,
    is_value,
    number_duplicates,
    split_cells,
)
from socast.tools.importers.table.column_map import FileFormat
from socast.tools.importers.table.text_stream import (
    LONGEST_EXAMPLE,
    OPEN_QUOTE,
    RowFaults,
    TextStream,
    find_encoding,
    find_open_quote,
    find_width_cause,
    is_header,
)

BLOCK_BYTES: Final = 4 << 20
"""Part of a CSV file that is parsed at a time. [B]"""
BLOCK_ROWS: Final = 1 << 16
"""Rows of a Parquet file that are read at a time."""
HEAD_BYTES: Final = 1 << 18
"""Part of a CSV file from which its form is found. [B]"""
MOST_JOINED: Final = 200
"""Rows from which the form of numbers is found."""
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
_CONTROLS: Final = re.compile(r"[\x00-\x08\x0e-\x19\x1c-\x1f]")
_LINE_END: Final = re.compile(r"\r\n|\r|\n")

Block = Mapping[str, pa.Array]


class TableFile(NamedTuple):
    """Hold the form of a table in a file.

    Parameters
    ----------
    names : tuple of str
        Names of the columns. Where several have one name, they are called `NAME#1`, `NAME#2` and so on.
    extra_cells : bool
        Whether rows may have more cells than the header; those beyond it are not read.
    units : tuple of str
        Cells of a row of units below the header, empty where there is none.
    """

    path: Path
    kind: str
    names: tuple[str, ...]
    separator: str = ","
    decimal: str = "."
    encoding: str = "utf-8"
    skip_lines: int = 0
    extra_cells: bool = False
    grouped: tuple[str, ...] = ()
    units: tuple[str, ...] = ()

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

    def iterate_blocks(self, columns: Sequence[str], faults: RowFaults) -> Iterator[Block]:
        """Yield the rows of the file in blocks of columns; cells of a CSV file are text, null where unknown."""
        present = [name for name in columns if name in self.names]
        with _one_line(self.path):
            blocks = self._read_csv(present, faults) if self.kind == "csv" else self._read_parquet(present, faults)
            for batch in blocks:
                yield dict(zip(present, batch.columns, strict=True))

    def _read_csv(self, columns: list[str], faults: RowFaults) -> Iterator[Any]:
        """Yield the record batches of a CSV file."""
        above = self.skip_lines + 1 + bool(self.units)
        with TextStream(self.path, self.encoding) as stream:
            faults.start_file(stream.blank_lines)
            wrong = _WrongRows(self, faults, above + 1)
            try:
                batches = pacsv.open_csv(
                    pa.PythonFile(stream, mode="r"),
                    read_options=pacsv.ReadOptions(
                        use_threads=False, block_size=BLOCK_BYTES, skip_rows=above, column_names=list(self.names)
                    ),
                    parse_options=pacsv.ParseOptions(delimiter=self.separator, invalid_row_handler=wrong.skip),
                    convert_options=pacsv.ConvertOptions(
                        column_types=dict.fromkeys(columns, pa.string()),
                        include_columns=columns,
                        strings_can_be_null=True,
                        quoted_strings_can_be_null=True,
                        null_values=list(UNKNOWN),
                    ),
                )
                for batch in batches:
                    yield wrong.merge(batch, columns)
                    wrong.refuse_header()
            except pa.ArrowInvalid as error:
                wrong.refuse_header()
                if (line := find_open_quote(self.path, self.encoding)) is not None:
                    raise ImportFileError(
                        f"{self.path}: line {line} opens a quote that is not closed; close it, or remove the line"
                    ) from error
                raise
            finally:
                faults.notes += stream.list_notes()
            if wrong.longer:
                yield wrong.merge(pa.record_batch([pa.array([], pa.string())] * len(columns), names=columns), columns)
            wrong.refuse_header()

    def _read_parquet(self, columns: list[str], faults: RowFaults) -> Iterator[Any]:
        """Yield the record batches of a Parquet file."""
        faults.start_file([])
        with pq.ParquetFile(self.path) as file:
            for batch in file.iter_batches(batch_size=BLOCK_ROWS, columns=columns):
                yield batch.select(columns)


class _WrongRows:
    """Receive the rows of a CSV file that have another number of cells than its header, and keep what can be read."""

    def __init__(self, table: TableFile, faults: RowFaults, first: int) -> None:
        self.longer: list[tuple[float, str]] = []
        self._table, self._faults, self._next = table, faults, first
        self._left_out: list[int] = []
        self._header: tuple[int | None, str] | None = None

    def skip(self, row: Any) -> str:
        """Keep a row that is longer and may be so, and count any other by its cause."""
        text, table = row.text, self._table
        self._left_out.append(row.number)
        if row.actual_columns > row.expected_columns and (table.extra_cells or self._ends_empty(row)):
            self.longer.append((row.number, text))
            return "skip"
        line = self._faults.count_blank(row.number)
        if self._header is None and is_header(split_cells(text, table.separator), table.names):
            self._header = line, text
        cause = find_width_cause(text, table.names, table.separator)
        if cause == OPEN_QUOTE:
            lines = _LINE_END.split(text)
            whole = [
                (row.number + at / len(lines), each)
                for at, each in enumerate(lines)
                if each.count('"') % 2 == 0 and len(split_cells(each, table.separator)) == row.expected_columns
            ]
            self.longer += whole
            self._faults.add_wide(cause, len(lines) - len(whole), table.path, line, lines[0])
        else:
            self._faults.add_wide(cause, 1, table.path, line, text)
        return "skip"

    def merge(self, batch: Any, columns: Sequence[str]) -> Any:
        """Return rows together with the longer ones among them, without the cells beyond the header, in their order."""
        span = np.arange(self._next, self._next + len(batch) + len(self._left_out))
        numbers = np.setdiff1d(span, self._left_out)[: len(batch)]
        last = int(numbers[-1]) if len(batch) else int(span[-1]) + 1 if len(span) else self._next
        self._next = last + 1
        self._left_out = [number for number in self._left_out if number > last]
        self._faults.numbers = numbers
        kept = [each for each in self.longer if each[0] <= last]
        if not kept:
            return batch
        self.longer = [each for each in self.longer if each[0] > last]
        rows = list(csv.reader([text for _, text in kept], delimiter=self._table.separator))
        places = [self._table.names.index(name) for name in columns]
        cells = [[None if row[place] in UNKNOWN else row[place] for row in rows] for place in places]
        cut = [pa.array(column, pa.string()) for column in cells]
        joined = [
            pa.concat_arrays([each.cast(pa.string()), more]) for each, more in zip(batch.columns, cut, strict=True)
        ]
        of_all = np.concatenate((numbers, [number for number, _ in kept]))
        order = np.argsort(of_all, kind="stable")
        self._faults.numbers = of_all[order].astype("i8")
        return pa.record_batch([each.take(pa.array(order)) for each in joined], names=list(columns))

    def refuse_header(self) -> None:
        """Refuse a file in which another header stands between the rows."""
        if self._header is not None:
            raise ImportFileError(describe_header(self._table.path, *self._header))

    def _ends_empty(self, row: Any) -> bool:
        """Return whether all cells beyond the header are empty."""
        return not any(cell.strip() for cell in split_cells(row.text, self._table.separator)[row.expected_columns :])


def describe_header(path: Path, line: int | None, text: str) -> str:
    """Return the message for a header between the rows that is not that of the file."""
    shown = text if len(text) <= LONGEST_EXAMPLE else f"{text[:LONGEST_EXAMPLE]}..."
    where = f"line {line}" if line is not None else "one of its lines"
    return (
        f"{path}: {where} holds another header ({shown}), so files with other columns were joined; divide the file "
        "there, and import each part"
    )


def open_table(path: Path, kind: str, form: FileFormat) -> TableFile:
    """Return the form of a table: as the map gives it, else as the file shows it."""
    with _one_line(path):
        if kind == "parquet":
            with pq.ParquetFile(path) as file:
                return TableFile(path, kind, number_duplicates(file.schema_arrow.names))
        with pa.input_stream(str(path), compression="detect") as stream:
            head = stream.read(HEAD_BYTES)
    if not head.strip(b" \t\r\n\0"):
        raise ImportFileError(f"{path}: is empty; leave it out")
    if head.startswith(b"PAR1"):
        raise ImportFileError(f"{path}: is a Parquet file; use `socast import parquet`")
    for start, words in OTHER_KINDS.items():
        if head.lstrip().startswith(start):
            raise ImportFileError(f"{path}: is {words}; save it as CSV and import that")
    encoding = form.encoding or find_encoding(head)
    text = "" if _is_binary(head, encoding) else _read_head(path, encoding)
    if not text or len(re.sub(_CONTROLS, "", text)) < len(text) * (1 - MOST_CONTROLS):
        raise ImportFileError(f"{path}: is no text file; leave it out, or save the table as CSV")
    lines = _LINE_END.split(text)
    skipped = form.skip_lines or find_header(lines)
    lines = lines[skipped:]
    if not lines or not lines[0].strip():
        raise ImportFileError(f"{path}: has no header in line {skipped + 1}; set skip_lines in [file] of the map")
    if lines[0].count('"') % 2:
        raise ImportFileError(
            f"{path}: line {skipped + 1} opens a quote that is not closed, such as around a name of two lines; write "
            "each name in one line"
        )
    separator = form.separator or max(SEPARATORS, key=lambda each: len(split_cells(lines[0], each)))
    names = number_duplicates([name.strip() for name in split_cells(lines[0], separator)])
    if sum(is_value(name.partition("#")[0]) for name in names) > len(names) / 2:
        raise ImportFileError(
            f"{path}: line {skipped + 1} holds values such as {names[0]!r}, and no names of columns; write a line "
            "of names above it, such as time,speed_kmh,power_kw"
        )
    complete = lines[1:-1] if len(head) == HEAD_BYTES else lines[1:]
    rows = [split_cells(line, separator) for line in complete[:MOST_JOINED] if line.strip()]
    units = find_units(rows, names)
    rows = rows[1:] if units else rows
    decimal = form.decimal or find_decimal(rows, separator)
    grouped = find_grouped([split_cells(line, separator) for line in complete if line.strip()][1:], names, decimal)
    return TableFile(path, kind, names, separator, decimal, encoding, skipped, form.extra_cells, grouped, units)


def _read_head(path: Path, encoding: str) -> str:
    """Return the first part of a file as text."""
    try:
        with TextStream(path, encoding) as stream:
            return stream.read(HEAD_BYTES).decode("utf-8", "ignore")
    except LookupError as error:
        raise ImportFileError(
            f"{path}: encoding '{encoding}' is not known; write one such as utf-8 or latin-1"
        ) from error


def _is_binary(head: bytes, encoding: str) -> bool:
    """Return whether a file holds control bytes, except NUL in long rows, as a loss of power leaves them."""
    if encoding.lower().replace("_", "-").startswith(("utf-16", "utf-32")):
        return False
    lost = sum(map(len, re.findall(rb"\0{8,}", head)))
    controls = len(re.findall(rb"[\x00-\x08\x0e-\x19\x1c-\x1f]", head))
    return controls - lost > MOST_CONTROLS * len(head)


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
