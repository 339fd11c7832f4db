"""Where tables come from: recordings, settings of cleaning and maps, noted beside them to read them again."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import pandas as pd

from socast.core.errors import SocastError
from socast.core.models.features import EFFECT_PREFIX
from socast.core.settings import Settings
from socast.stream.mcap_format import RECORDING
from socast.stream.mcap_reader import McapSource
from socast.stream.recording_metadata import INVENTED
from socast.tools.terminal.table_files import KEY, WINDOW

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
    except msgspec.DecodeError:
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
    except (OSError, msgspec.DecodeError):
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
