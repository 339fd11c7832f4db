"""What the published files look like, and how a wrong one is told: by its name, its column and what would fit."""

import gzip
import re
import warnings
import zlib
from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import pandas as pd

from core.errors import ImportFileError

SUFFIXES: Final = (".csv", ".csv.gz")


class Format(NamedTuple):
    """A published table.

    Parameters
    ----------
    command : str. The importer's name on the command line.
    title : str. What the data set calls itself.
    separator, encoding : str
    needed : tuple of str. Numeric columns without which a file is another one's.
    texts : tuple of str. Columns of text that are needed too.
    optional : tuple of str. Numeric columns that only some files have.
    """

    command: str
    title: str
    separator: str
    encoding: str
    needed: tuple[str, ...]
    texts: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()


ENGINE: Final = (
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

VED: Final = Format(
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
    optional=("Air Conditioning Power[kW]", *ENGINE),
)
BMW_I3: Final = Format(
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
TWIZY: Final = Format(
    command="twizy",
    title="the RSK Twizy dataset",
    separator=",",
    encoding="utf-8",
    needed=("Soc", "Speed", "LAT", "LON", "ALT", "Temperature", "Humidity", "WindSpeedAv"),
    texts=("Date", "Time"),
)
FORMATS: Final = (VED, BMW_I3, TWIZY)


def files(paths: Iterable[Path]) -> list[Path]:
    """Return the files that are meant: those named, and of each directory its `.csv` and `.csv.gz` by name.

    Raises
    ------
    ImportFileError
        For a path that does not exist, and for a directory without such files.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.name.lower().endswith(SUFFIXES) and p.is_file())
            if not inside:
                raise ImportFileError(
                    f"{path}: holds no .csv or .csv.gz file; name the folder of the unpacked data set"
                )
            found += inside
        elif path.exists():
            found.append(path)
        else:
            raise ImportFileError(f"{path}: does not exist")
    return found


def stem(path: Path) -> str:
    """Return a file's name without `.csv` and `.gz`.

    >>> stem(Path("a/TripA01.csv.gz"))
    'TripA01'
    """
    return re.sub(r"(\.csv)?(\.gz)?$", "", path.name, flags=re.IGNORECASE)


def read(path: Path, form: Format) -> pd.DataFrame:
    """Read the columns that an importer uses, plain or gzipped.

    Parameters
    ----------
    path : Path
    form : Format

    Returns
    -------
    DataFrame
        Columns named as in `form`: numbers as float64, NaN where empty; text as text; a column that is optional and
        absent is all NaN. Rows wholly empty are left out, and the index is the line's number in the file.

    Raises
    ------
    ImportFileError
        For a file that is not such a table. The message names the file, the column and, where one of the other
        importers would read it, that one.
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
    """Return what the file holds, unpacked."""
    try:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ImportFileError(f"{path}: is not a whole gzip file: {error}") from error
    except OSError as error:
        raise ImportFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not content.strip():
        raise ImportFileError(f"{path}: is empty")
    return content


def _plain(name: str) -> str:
    """Return a column's name without what differs between the files: case, spaces, degree signs, stray brackets.

    >>> _plain("Velocity [km/h]]]") == _plain("velocity [km/h] ")
    True
    """
    ascii_only = name.encode("ascii", "ignore").decode().strip().strip('"').casefold()
    return re.sub(r"\]+$", "]", re.sub(r"\s+", " ", ascii_only).strip())


def _header(first: bytes, form: Format) -> list[str]:
    return [_plain(name) for name in first.decode("latin-1").split(form.separator)]


def _wrong_header(path: Path, first: bytes, form: Format, missing: Sequence[str]) -> str:
    """Say which column is missing, and which importer would read the file."""
    more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
    text = f"{path}: has no column '{missing[0]}'{more}, so it is not a file of {form.title}"
    for other in FORMATS:
        if other is not form and all(_plain(name) in _header(first, other) for name in (*other.texts, *other.needed)):
            return f"{text} but of {other.title}: use `socast import {other.command}`"
    return text


def _check_widths(path: Path, content: bytes, form: Format) -> None:
    """Refuse rows longer or shorter than the header, as a broken download leaves them, empty cells at the end aside."""
    separator = form.separator.encode()
    first, *lines = content.split(b"\n")
    most, least = first.count(separator), first.rstrip(separator + b"\r ").count(separator)
    for number, line in enumerate(lines, start=2):
        cells = line.count(separator)
        if not least <= cells <= most and line.strip():
            filled = line.rstrip(separator + b"\r ").count(separator)
            if cells < least or filled > most:
                raise ImportFileError(
                    f"{path}: line {number} has {cells + 1} cells, the header {most + 1}; is it whole?"
                )


def _parse(path: Path, content: bytes, form: Format, places: list[int]) -> pd.DataFrame:
    """Return the columns at `places`, whatever pandas makes of them."""
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
    """Return a column as float64; text where a number belongs is an error that names its line."""
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
