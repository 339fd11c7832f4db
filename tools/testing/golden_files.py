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
from socast.core.wire.messages import BATCH
from socast.stream.mcap_format import RECORDING
from socast.stream.mcap_reader import McapSource
from socast.tools.testing.difference_report import format_comparison
from socast.tools.testing.table_differences import TableComparison, compare_tables, find_key
from socast.tools.testing.tolerances import Tolerances, resolve_tolerances

CSV, PARQUET = ".csv", ".parquet"
SUFFIXES: Final = (CSV, PARQUET)
"""Ends of the names of files that hold a table."""
ROWS: Final = {("vehicle_id", "time_s"): "forecast", ("vehicle_id", "start_s"): "ride", ("counter",): "counter"}
"""Key -> what a row is."""
OPTION: Final = "--socast-update"
NOTHING_COMMON: Final = "No row is in both: is this the expectation of another recording?"
_SAMPLES: Final = ("/telemetry", f"/{BATCH}")


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
    return compare_forecasts(read_expected(expected), found, tolerances)


def compare_forecasts(expected: pd.DataFrame, found: Path, tolerances: Tolerances | None = None) -> TableComparison:
    """Compare the forecasts in a recording with a table of forecasts."""
    made = _tabulate(found, McapSource(found))
    return compare_tables(expected, made, tolerances=tolerances, rows="forecast", known=FORECAST_COLUMNS)


def read_expected(path: Path, option: str = f"pytest {OPTION}") -> pd.DataFrame:
    """Return the forecasts of an expectation; refuse one that holds none, or that breaks off."""
    source = McapSource(path)
    table = _tabulate(path, source)
    if lost := list(source.losses.lines()):
        raise RecordingError(f"{path}: {lost[0]}; write it anew with {option}")
    if table.empty:
        remedy = (
            "it is a recording of telemetry: name another file" if _holds_telemetry(path) else f"write it with {option}"
        )
        raise RecordingError(f"{path}: holds no forecasts to compare with; {remedy}")
    return table


def refuse_replacing(path: Path, recordings: Sequence[Path] = ()) -> None:
    """Refuse to write an expectation over a file that is none: a recording of telemetry, or of another kind."""
    if path.suffix != RECORDING:
        raise SettingsError(f"{path}: give a name that ends with {RECORDING}")
    is_input = path.exists() and any(each.exists() and path.samefile(each) for each in recordings)
    if is_input or _holds_telemetry(path):
        raise SettingsError(f"{path}: is a recording of telemetry, which the update would replace; name another file")


def refuse_mistakes(
    expected: Path, inputs: Sequence[str | Path], tolerances: Tolerances | None, *, update: bool
) -> None:
    """Refuse mistakes before the replay: unknown fields, and an expectation that cannot be compared or replaced."""
    resolve_tolerances(tolerances, FORECAST_COLUMNS)
    if update:
        refuse_replacing(expected, [Path(each) for each in inputs])
    elif expected.is_file():
        read_expected(expected)


def check_forecasts(expected: Path, found: Path, tolerances: Tolerances | None, *, update: bool) -> Checked:
    """Compare the forecasts in a recording with those in a golden file, or replace the file by the recording."""
    if update:
        refuse_nothing(found)

    def write(fresh: Path) -> None:
        shutil.copyfile(found, fresh)

    return _check(expected, lambda file: compare_recordings(file, found, tolerances), write, update=update)


def refuse_nothing(found: Path) -> None:
    """Refuse to write an expectation without forecasts."""
    if not any(is_forecast(message) for block in McapSource(found) for message in block):
        raise SettingsError("the replay made no forecasts, and an expectation needs some: give a longer recording")


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
    remedy = f"If this is meant to be, write {expected} with pytest {OPTION}."
    return Checked(f"{text}\n{remedy if comparison.compared else NOTHING_COMMON}", "")


def _holds_telemetry(path: Path) -> bool:
    """Return whether a file is a recording with samples; a damaged file counts as none."""
    try:
        return path.exists() and any(m.key.endswith(_SAMPLES) for block in McapSource(path) for m in block)
    except RecordingError:
        return False


def _tabulate(path: Path, source: McapSource) -> pd.DataFrame:
    """Return the forecasts in a recording."""
    messages = [message for block in source for message in block if is_forecast(message)]
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
