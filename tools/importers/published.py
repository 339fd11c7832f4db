"""Read the tables of public data sets as published, and report what is wrong with a file and how to mend it."""

import gzip
import re
import warnings
import zlib
from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import pandas as pd

from socast.core.errors import LARGEST_INPUT, ImportFileError, read_input

SUFFIXES: Final = (".csv", ".csv.gz")


class TableFormat(NamedTuple):
    """Describe a published table.

    Parameters
    ----------
    command : str
        Name of the data set on the command line.
    title : str
        Name that the data set gives itself.
    separator, encoding : str
        Separator of the cells and encoding of the text.
    needed : tuple of str
        Numeric columns that every file of the data set has.
    optional : tuple of str
        Numeric columns that only some files have.
    """

    command: str
    title: str
    separator: str
    encoding: str
    needed: tuple[str, ...]
    texts: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()


ENGINE_COLUMNS: Final = (
    "MAF[g/sec]",
    "Engine RPM[RPM]",
    "Absolute Load[%]",
    "Fuel Rate[L/hr]",
    "Short Term Fuel Trim Bank 1[%]",
    "Short Term Fuel Trim Bank 2[%]",
    "Long Term Fuel Trim Bank 1[%]",
    "Long Term Fuel Trim Bank 2[%]",
)
"""Columns of VED that only a car with an engine fills."""

VED: Final = TableFormat(
    command="ved",
    title="the Vehicle Energy Dataset",
    separator=",",
    encoding="utf-8",
    needed=(
        "DayNum",
        "VehId",
        "Trip",
        "Timestamp(ms)",
        "Latitude[deg]",
        "Longitude[deg]",
        "Vehicle Speed[km/h]",
        "OAT[DegC]",
        "Air Conditioning Power[Watts]",
        "Heater Power[Watts]",
        "HV Battery Current[A]",
        "HV Battery SOC[%]",
        "HV Battery Voltage[V]",
    ),
    optional=("Air Conditioning Power[kW]", *ENGINE_COLUMNS),
)
BMW_I3: Final = TableFormat(
    command="bmw-i3",
    title="the BMW i3 driving cycles",
    separator=";",
    encoding="latin-1",
    needed=(
        "Time [s]",
        "Velocity [km/h]",
        "Elevation [m]",
        "Battery Voltage [V]",
        "Battery Current [A]",
        "Battery Temperature [C]",
        "SoC [%]",
        "AirCon Power [kW]",
        "Ambient Temperature [C]",
    ),
    optional=("Heating Power LIN [W]",),
)
TWIZY: Final = TableFormat(
    command="twizy",
    title="the RSK Twizy dataset",
    separator=",",
    encoding="utf-8",
    needed=("Soc", "Speed", "LAT", "LON", "ALT", "Temperature", "Humidity", "WindSpeedAv"),
    texts=("Date", "Time"),
)
FORMATS: Final = (VED, BMW_I3, TWIZY)


def list_files(paths: Iterable[Path]) -> list[Path]:
    """Return the given files, and of each given directory its `.csv` and `.csv.gz` files by name."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.name.lower().endswith(SUFFIXES) and p.is_file())
            if not inside:
                raise ImportFileError(
                    f"{path}: holds no .csv or .csv.gz file; name the folder of the unpacked data set"
                )
            files += inside
        elif path.exists():
            files.append(path)
        else:
            raise ImportFileError(f"{path}: does not exist; give a file of the data set or its folder")
    return files


def strip_suffixes(path: Path) -> str:
    """Return the name of a file without `.csv` and `.gz`.

    >>> strip_suffixes(Path("a/TripA01.csv.gz"))
    'TripA01'
    """
    return re.sub(r"(\.csv)?(\.gz)?$", "", path.name, flags=re.IGNORECASE)


def read_table(path: Path, form: TableFormat) -> pd.DataFrame:
    """Read the columns that an importer uses from a plain or gzipped file.

    Returns
    -------
    DataFrame
        Columns with the names of `form`: numbers as float64, NaN if empty; text as text. A missing optional column is
        all NaN. Empty rows are left out, and the index is the line number in the file.
    """
    content = _content(path)
    first = content.split(b"\n", 1)[0].rstrip(b"\r")
    if b"\0" in content[:4096] or len(first) > 100_000:
        raise ImportFileError(f"{path}: is not a table of text; unpack archives first")
    header = _header(first, form)
    wanted = (*form.texts, *form.needed, *form.optional)
    places = {name: header.index(_plain(name)) for name in wanted if _plain(name) in header}
    missing = [name for name in (*form.texts, *form.needed) if name not in places]
    if missing:
        raise ImportFileError(_wrong_header(path, first, form, missing))
    _check_widths(path, content, form)
    table = _parse(path, content, form, sorted(places.values()))
    names = {place: name for name, place in places.items()}
    table.columns = pd.Index([names[place] for place in sorted(places.values())])
    table.index = pd.RangeIndex(2, len(table) + 2)
    table = table.dropna(how="all")
    if table.empty:
        raise ImportFileError(f"{path}: has a header but no rows")
    for name in table.columns:
        table[name] = table[name].astype(str) if name in form.texts else _numbers(path, table[name])
    return table.reindex(columns=list(wanted))


def _content(path: Path) -> bytes:
    """Return the content of a file, unpacked."""
    try:
        content = read_input(path)
        if content[:2] == b"\x1f\x8b":
            with gzip.open(path) as file:
                content = file.read(LARGEST_INPUT + 1)
            if len(content) > LARGEST_INPUT:
                raise ImportFileError(f"{path}: unpacks to more than {LARGEST_INPUT:,} bytes")
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ImportFileError(f"{path}: is not a whole gzip file: {error}") from error
    except OSError as error:
        raise ImportFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not content.strip():
        raise ImportFileError(f"{path}: is empty")
    return content


def _plain(name: str) -> str:
    """Return a column's name without the differences between files: case, spaces, degree signs, stray brackets.

    >>> _plain("Velocity [km/h]]]") == _plain("velocity [km/h] ")
    True
    """
    ascii_only = name.encode("ascii", "ignore").decode().strip().strip('"').casefold()
    return re.sub(r"\]+$", "]", re.sub(r"\s+", " ", ascii_only).strip())


def _header(first: bytes, form: TableFormat) -> list[str]:
    """Return the column names of a header line in their plain form."""
    return [_plain(name) for name in first.decode("latin-1").split(form.separator)]


def _wrong_header(path: Path, first: bytes, form: TableFormat, missing: Sequence[str]) -> str:
    """Return a message that names the missing column, and the importer that would read the file."""
    more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
    text = f"{path}: has no column '{missing[0]}'{more}, so it is not a file of {form.title}"
    for other in FORMATS:
        if other is not form and all(_plain(name) in _header(first, other) for name in (*other.texts, *other.needed)):
            return f"{text} but of {other.title}: use `socast import {other.command}`"
    return text


def _check_widths(path: Path, content: bytes, form: TableFormat) -> None:
    """Reject rows longer or shorter than the header (a broken download); ignore empty cells at the end."""
    separator = form.separator.encode()
    first, *lines = content.split(b"\n")
    most, least = first.count(separator), first.rstrip(separator + b"\r ").count(separator)
    for number, line in enumerate(lines, start=2):
        cells = line.count(separator)
        if not least <= cells <= most and line.strip():
            filled = line.rstrip(separator + b"\r ").count(separator)
            if cells < least or filled > most:
                raise ImportFileError(
                    f"{path}: line {number} has {cells + 1} cells, the header {most + 1}; download the file again"
                )


def _parse(path: Path, content: bytes, form: TableFormat, places: list[int]) -> pd.DataFrame:
    """Return the columns at `places` with the types that pandas infers."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", pd.errors.ParserWarning)
            return pd.read_csv(
                BytesIO(content),
                sep=form.separator,
                encoding=form.encoding,
                header=None,
                skiprows=1,
                usecols=places,
                index_col=False,
                skip_blank_lines=False,
                low_memory=False,
                dtype=None,
            )
    except pd.errors.EmptyDataError as error:
        raise ImportFileError(f"{path}: has a header but no rows") from error
    except (pd.errors.ParserError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ImportFileError(f"{path}: its rows do not fit its header: {reason}") from error


def _numbers(path: Path, column: "pd.Series[Any]") -> "pd.Series[float]":
    """Return a column as float64, or raise an error that names the line of text in place of a number."""
    if column.dtype.kind not in "fiu":
        texts = column.astype(str)
        numbers = pd.to_numeric(texts, errors="coerce")
        wrong = numbers.isna() & column.notna() & (texts.str.strip() != "")
        if wrong.any():
            row = int(wrong.to_numpy().argmax())
            text, line = texts.iloc[row][:40], texts.index[row]
            raise ImportFileError(
                f"{path}: column '{column.name}' holds {text!r} in line {line}, where a number belongs"
            )
        column = numbers
    return column.astype("float64")
