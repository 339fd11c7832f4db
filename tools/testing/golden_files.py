"""Golden files: tables that an earlier run wrote, and with which a test compares those of the current one."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import pandas as pd

from socast.core.errors import RecordingError, SettingsError, SocastError
from socast.core.files import replacing
from socast.core.forecast.forecast_table import FORECAST_COLUMNS, is_forecast, tabulate_forecasts
from socast.core.formatting import format_count
from socast.stream.mcap_reader import McapSource
from socast.tools.testing.difference_report import format_comparison
from socast.tools.testing.table_differences import TableComparison, compare_tables, find_key
from socast.tools.testing.tolerances import Tolerances

RECORDING, CSV, PARQUET = ".mcap", ".csv", ".parquet"
SUFFIXES: Final = (CSV, PARQUET)
"""Ends of the names of files that hold a table."""
ROWS: Final = {("vehicle_id", "time_s"): "forecast", ("vehicle_id", "start_s"): "ride", ("counter",): "counter"}
"""Key -> what a row is."""
OPTION: Final = "--socast-update"


class Checked(NamedTuple):
    """Hold the result of a comparison with a golden file.

    Parameters
    ----------
    difference : str
        What differs, for people; empty where the table is as expected, or the file was written.
    written : str
        What writing the file has changed; empty where it was not written.
    """

    difference: str
    written: str


def compare_recordings(expected: Path, found: Path, tolerances: Tolerances | None = None) -> TableComparison:
    """Compare the forecasts in two recordings, as `socast replay --out` writes them."""
    wanted = _read_forecasts(expected)
    if wanted.empty:
        raise RecordingError(f"{expected}: holds no forecasts to compare with; write it anew with the update option")
    made = _read_forecasts(found)
    return compare_tables(wanted, made, tolerances=tolerances, rows="forecast", known=FORECAST_COLUMNS)


def check_forecasts(expected: Path, found: Path, tolerances: Tolerances | None, *, update: bool) -> Checked:
    """Compare the forecasts in a recording with those in a golden file, or replace the file by the recording."""

    def write(fresh: Path) -> None:
        shutil.copyfile(found, fresh)

    return _check(expected, lambda file: compare_recordings(file, found, tolerances), write, update=update)


def check_table(
    expected: Path, found: pd.DataFrame, *, key: Sequence[str], tolerances: Tolerances | None, update: bool
) -> Checked:
    """Compare a table with that of a golden file, or write the file."""
    if expected.suffix not in SUFFIXES:
        raise SettingsError(f"{expected}: give a name that ends with {' or '.join(SUFFIXES)}")
    levels = [name for name in found.index.names if name is not None]
    plain = found.reset_index(level=[each for each in levels if each not in found.columns]) if levels else found
    names = list(key) or find_key(found)
    rows = ROWS.get(tuple(names), "row")

    def write(fresh: Path) -> None:
        if expected.suffix == CSV:
            plain.to_csv(fresh, index=False, lineterminator="\n")
        else:
            plain.to_parquet(fresh, index=False)

    return _check(
        expected,
        lambda file: compare_tables(_read_table(file, plain), plain, key=names, tolerances=tolerances, rows=rows),
        write,
        update=update,
    )


def describe_update(file: Path, comparison: TableComparison | str) -> str:
    """Return what the new content of a golden file changes."""
    if isinstance(comparison, str):
        return f"{file}: {comparison}"
    if comparison.is_equal:
        return f"{file}: {format_count(comparison.compared, comparison.rows)} as before"
    return f"{file}: written anew; {format_comparison(comparison)}"


def compare_with_old(file: Path, compare: Callable[[Path], TableComparison]) -> TableComparison | str:
    """Return how new content differs from that of a golden file, or why there is nothing to compare with."""
    if not file.exists():
        return "written for the first time"
    try:
        return compare(file)
    except SocastError as error:
        return f"written anew; the old content could not be compared: {error}"


def _check(
    expected: Path, compare: Callable[[Path], TableComparison], write: Callable[[Path], None], *, update: bool
) -> Checked:
    """Compare with a golden file, or write it whole."""
    if update:
        changed = compare_with_old(expected, compare)
        expected.parent.mkdir(parents=True, exist_ok=True)
        with replacing(expected) as fresh:
            write(fresh)
        return Checked("", describe_update(expected, changed))
    if not expected.is_file():
        return Checked(f"{expected}: does not exist; write it with pytest {OPTION}, look at it and keep it", "")
    comparison = compare(expected)
    if comparison.is_equal:
        return Checked("", "")
    text = format_comparison(comparison)
    return Checked(f"{text}\nIf this is meant to be, write {expected} with pytest {OPTION}.", "")


def _read_forecasts(path: Path) -> pd.DataFrame:
    """Return the forecasts in a recording."""
    messages = [message for block in McapSource(path) for message in block if is_forecast(message)]
    try:
        return tabulate_forecasts(messages)
    except msgspec.DecodeError as error:
        raise RecordingError(f"{path}: a forecast is not JSON: {error}; write it anew") from error


def _read_table(file: Path, like: pd.DataFrame) -> pd.DataFrame:
    """Return the table of a golden file; text of a CSV file becomes what the columns of another table hold."""
    try:
        if file.suffix == PARQUET:
            return pd.read_parquet(file)
        text = pd.read_csv(file, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise SettingsError(f"{file}: cannot read a table: {reason}; write it with pytest {OPTION}") from error
    known = {str(name): column for name, column in like.items()}
    return pd.DataFrame({name: _read_column(column, known.get(str(name))) for name, column in text.items()})


def _read_column(text: pd.Series, like: pd.Series | None) -> pd.Series:
    """Return the values of a column of text; text that is not of the kind of the other column stays text."""
    plain = text.where(text != "", None)
    kind = pd.Series(dtype=float) if like is None or like.isna().all() else like
    values = plain
    if pd.api.types.is_bool_dtype(kind):
        values = plain.map({"True": True, "False": False})
    elif pd.api.types.is_numeric_dtype(kind):
        values = pd.Series(pd.to_numeric(plain, errors="coerce"))
    elif pd.api.types.is_datetime64_any_dtype(kind):
        values = pd.Series(pd.to_datetime(plain, errors="coerce")).astype(kind.dtype)
    return values if values.notna().equals(plain.notna()) else plain
