"""Read and write ride tables and window tables, and note beside them where they come from, to read it again."""

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import msgspec
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from socast.core.errors import ModelError, SettingsError, SocastError
from socast.core.files import UNREADABLE, refuse_beyond_memory, replacing
from socast.core.fit.ride_blocks import explain_table_errors, list_parts
from socast.core.models.features import EFFECT_PREFIX
from socast.core.settings import Settings
from socast.stream.mcap_format import RECORDING
from socast.stream.mcap_reader import McapSource
from socast.stream.recording_metadata import INVENTED

PARQUET: Final = ".parquet"
"""End of the name of a table."""
KEY: Final = "ride_key"
"""Column with the key of a ride, in both tables."""
WINDOW: Final = "window"
"""Column with the number of a window in its ride, in the window table only."""


def read(
    files: Sequence[Path], columns: Sequence[str] | None = None, present: Sequence[str] | None = None
) -> pd.DataFrame:
    """Read tables and concatenate them; with several files, the index of the file comes before each ride key.

    Parameters
    ----------
    columns, present : sequence of str, optional
        Columns to read, that must be there, or else that are read where they are. Default: all.
    """
    return join_parts([_read(file, columns, present) for file in files])


def join_parts(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Concatenate tables; with several, the index of the table comes before each ride key."""
    if len(parts) == 1:
        return parts[0]
    if any(KEY not in part for part in parts):
        return pd.concat(parts, ignore_index=True)
    keyed = [part.assign(**{KEY: f"{i}/" + part[KEY].astype(str)}) for i, part in enumerate(parts)]
    return pd.concat(keyed, ignore_index=True)


def is_window_table(file: Path) -> bool:
    """Tell whether a file is a Parquet file of windows."""
    try:
        return WINDOW in pq.read_schema(list_parts(file)[0]).names
    except (OSError, IndexError, pa.ArrowException):
        return False


def is_table(path: Path) -> bool:
    """Return whether there is a file, or a folder with the files of a table, whose name ends as that of a file."""
    return path.is_file() or (path.is_dir() and path.suffix == PARQUET and bool(list_parts(path)))


def _read(table: Path, columns: Sequence[str] | None, present: Sequence[str] | None) -> pd.DataFrame:
    """Read a table from its Parquet files."""
    parts = [_read_file(file, columns, present) for file in list_parts(table)]
    if not parts:
        raise ModelError(f"{table} holds no Parquet file; name a table that `socast tables` made")
    with explain_table_errors(table):
        whole: pd.DataFrame = pa.concat_tables(parts, promote_options="permissive").to_pandas()
    return whole


def _read_file(file: Path, columns: Sequence[str] | None, present: Sequence[str] | None) -> pa.Table:
    """Read the columns of a Parquet file."""
    with explain_table_errors(file), pq.ParquetFile(file) as opened:
        there = opened.schema_arrow.names
        if missing := [name for name in columns or () if name not in set(there)]:
            raise ModelError(f"{file}: column {missing[0]!r} is missing: make the tables again with `socast tables`")
        if present is not None:
            columns = [name for name in present if name in set(there)]
        refuse_beyond_memory(file, opened.metadata.num_rows, len(there if columns is None else columns))
        return opened.read(columns=None if columns is None else list(columns))


class ParquetTable:
    """Write a Parquet file by row groups; the first row group fixes the columns.

    It is a context manager. The file takes the place of an existing one at its end, unless anything is raised.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = 0
        self._writer: pq.ParquetWriter | None = None
        self._opened = ExitStack()

    def __enter__(self) -> Self:
        """Return the table."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish the file, or remove it if anything was raised."""
        try:
            self._opened.__exit__(kind, error, trace)
        except OSError as failure:
            raise self._explain(failure) from failure

    def append(self, table: pd.DataFrame) -> None:
        """Write a row group; text columns stay text even if all their values in a group are unknown."""
        try:
            writer = self._writer or self._open(table)
            writer.write_table(pa.Table.from_pandas(table, schema=self._schema, preserve_index=False))
        except OSError as error:
            raise self._explain(error) from error
        self.rows += len(table)

    def _open(self, table: pd.DataFrame) -> pq.ParquetWriter:
        """Return the writer of a new file with the columns of a row group."""
        text = {
            name
            for name, kind in table.dtypes.items()
            if not pd.api.types.is_numeric_dtype(kind) and not pd.api.types.is_bool_dtype(kind)
        }
        inferred = pa.Schema.from_pandas(table, preserve_index=False)
        self._schema = pa.schema([pa.field(f.name, pa.string() if f.name in text else f.type) for f in inferred])
        fresh = self._opened.enter_context(replacing(self.path))
        self._writer = self._opened.enter_context(pq.ParquetWriter(fresh, self._schema, compression="zstd"))
        return self._writer

    def _explain(self, error: OSError) -> SettingsError:
        """Return the error of a file that cannot be written."""
        reason = error.strerror or " ".join(str(error).split())
        return SettingsError(f"{self.path} cannot be written: {reason}; make room, or name another folder")


QUALITY: Final = "quality.json"
"""File beside the tables that names their source."""

ReadAgain = Callable[[Sequence[Path], Sequence[str], Settings, Sequence[Path]], tuple[pd.DataFrame, pd.DataFrame]]
"""Function of recordings, names of effects, settings and maps of elevation that returns ride and window tables."""


class TableSource(msgspec.Struct, frozen=True):
    """Hold what tables were made from, with paths from their folder.

    Parameters
    ----------
    dated : bool
        Whether the dates of the recordings are known, and not invented by `socast import --sequence`.
    """

    recordings: tuple[str, ...]
    settings: Settings
    elevation: tuple[str, ...] = ()
    dated: bool = True


class _Quality(msgspec.Struct):
    """Hold what is read of the file beside the tables."""

    source: TableSource


def describe_source(
    folder: Path, recordings: Sequence[Path], settings: Settings, elevation: Sequence[Path] = ()
) -> dict[str, Any]:
    """Return the source of tables in a folder, for the file beside them."""
    names = [tuple(os.path.relpath(path, folder) for path in paths) for paths in (recordings, elevation)]
    described: dict[str, Any] = msgspec.to_builtins(
        TableSource(names[0], settings, names[1], all(map(is_dated, recordings)))
    )
    return described


def is_dated(recording: Path) -> bool:
    """Return whether the dates of a recording are known, and not invented by `socast import --sequence`."""
    try:
        settings = msgspec.json.decode(McapSource(recording).metadata.get("settings") or "{}", type=dict[str, Any])
    except UNREADABLE:
        return True
    return settings.get("dates") != INVENTED


def are_dated(files: Sequence[Path]) -> bool:
    """Return whether the dates of all recordings, or of all files of rides, are known."""
    if files[0].suffix == RECORDING:
        return all(map(is_dated, files))
    sources = [read_source(file.parent) for file in files]
    return all(source is None or source.dated for source in sources)


def read_source(folder: Path) -> TableSource | None:
    """Return the source of the tables in a folder; None where none is noted."""
    try:
        return msgspec.json.decode((folder / QUALITY).read_bytes(), type=_Quality).source
    except (OSError, *UNREADABLE):
        return None


def complete_tables(
    folder: Path, rides: pd.DataFrame, windows: pd.DataFrame, effects: Sequence[str], read_again: ReadAgain
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return tables with the columns of effects that they lack, from the recordings that they were made of.

    Returns
    -------
    rides, windows : DataFrame
        The tables as they were where their recordings are gone, or give other rides now.
    """
    lacking = [name for name in effects if f"{EFFECT_PREFIX}{name}" not in windows]
    source = read_source(folder) if lacking and KEY in rides and {KEY, WINDOW} <= set(windows) else None
    if source is None:
        return rides, windows
    recordings, elevation = ([folder / name for name in names] for names in (source.recordings, source.elevation))
    if not all(path.is_file() for path in (*recordings, *elevation)):
        return rides, windows
    try:
        again = read_again(recordings, lacking, source.settings, elevation)
    except SocastError:
        return rides, windows
    columns = [f"{EFFECT_PREFIX}{name}" for name in lacking]
    made = []
    for table, fresh, keys in zip((rides, windows), again, ([KEY], [KEY, WINDOW]), strict=True):
        if set(table[keys].itertuples(index=False, name=None)) != set(fresh[keys].itertuples(index=False, name=None)):
            return rides, windows
        missing = [name for name in columns if name not in table]
        made.append(table.merge(fresh[[*keys, *missing]], on=keys, how="left", validate="one_to_one"))
    return made[0], made[1]
