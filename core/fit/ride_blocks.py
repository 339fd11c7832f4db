"""Read ride tables block by block, from memory or from Parquet files, and select the rides for training."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from math import inf
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.errors import ModelError
from socast.core.formatting import format_count
from socast.core.models.features import EFFECT_PREFIX
from socast.core.vehicles.fleet import CarParameters

ENERGY: Final = "energy_kwh"
UNKNOWN_VEHICLE: Final = "unknown_vehicle_or_effect"
"""Reason to leave a ride out: the figures of its car, or an effect, are unknown."""
_BLOCK: Final = 8192
"""Rides in a block."""
_WHOLE: Final = 1 << 40
"""Number of blocks that no table has."""
NAMES: Final = ("vehicle_model", "vehicle_id", "date")
"""Columns of text by which rides are grouped."""
OPTIONAL: Final = ("fit_for_training", "unfit_reason", *NAMES)
"""Columns that are read where present: they tell which rides to leave out and how to group the others."""


class RideSource(Protocol):
    """Iterate over a ride table, any number of times."""

    def blocks(self, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
        """Yield the rows in order, one block at a time."""

    def divide(self, blocks: int) -> Sequence["RideSource"]:
        """Return parts of the table, in order, each of that many blocks."""


@dataclass(frozen=True)
class RideFrame:
    """Iterate over a ride table in memory."""

    table: pd.DataFrame

    def blocks(self, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
        """Yield the rows in blocks, see `RideSource.blocks`."""
        names = _present(columns, self.table.columns, "the ride table")
        for start in range(0, len(self.table), _BLOCK):
            yield self.table.iloc[start : start + _BLOCK][names]

    def divide(self, blocks: int) -> Sequence["RideFrame"]:
        """Return parts of the table, see `RideSource.divide`."""
        size = blocks * _BLOCK
        return [RideFrame(self.table.iloc[start : start + size]) for start in range(0, max(len(self.table), 1), size)]


@dataclass(frozen=True)
class RideParquet:
    """Iterate over a ride table in Parquet files, read in batches.

    Parameters
    ----------
    paths : tuple of Path
        Files of the table, in order; or folders, each with the files of a table.
    """

    paths: tuple[Path, ...]

    def blocks(self, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
        """Yield the rows in blocks, see `RideSource.blocks`."""
        for rows in self._list_tables():
            yield from rows.blocks(columns)

    def divide(self, blocks: int) -> Sequence["ParquetRows"]:
        """Return parts of the table, see `RideSource.divide`; of the same blocks as those of the whole."""
        return [part for rows in self._list_tables() for part in rows.divide(blocks)]

    def _list_tables(self) -> list["ParquetRows"]:
        """Return the rows of each table."""
        return [ParquetRows(path, 0, _count_rows(path)) for path in self.paths]

    def table(self) -> pd.DataFrame:
        """Return the whole table in memory."""
        return pd.concat([block for path in self.paths for block in _read(path, None)], ignore_index=True)


@dataclass(frozen=True)
class ParquetRows:
    """Iterate over some rows of a ride table in Parquet files; only their row groups are read."""

    path: Path
    start: int
    stop: int

    def blocks(self, columns: Sequence[str], also: Sequence[str] = ()) -> Iterator[pd.DataFrame]:
        """Yield the rows in blocks, see `RideSource.blocks`, with those of other columns that are present."""
        yield from _read(self.path, columns, also, self.start, self.stop)

    def divide(self, blocks: int) -> Sequence["ParquetRows"]:
        """Return parts of the rows, see `RideSource.divide`."""
        size = blocks * _BLOCK
        starts = range(self.start, max(self.stop, self.start + 1), size)
        return [ParquetRows(self.path, start, min(start + size, self.stop)) for start in starts]


class ThinnedRides:
    """Iterate over a ride table in Parquet files, and keep every k-th ride, with the smallest k that respects a limit.

    Parameters
    ----------
    columns : sequence of str
        Columns to keep where present, besides those that are read and those of `OPTIONAL`.
    step, before : int
        Number k, and number of rides before the first one, of a part of a table.

    Attributes
    ----------
    kept : list of DataFrame
        Rides that the last iteration kept, by block.
    """

    def __init__(
        self, rides: RideParquet | ParquetRows, most: int, columns: Sequence[str], *, step: int = 0, before: int = 0
    ) -> None:
        self._columns, self._before = columns, before
        self._tables = rides.divide(_WHOLE)
        self._step = step or max(1, -(-sum(rows.stop for rows in self._tables) // most))
        self.kept: list[pd.DataFrame] = []

    def blocks(self, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
        """Yield the rows in blocks, see `RideSource.blocks`, and keep every k-th ride of this iteration."""
        self.kept, seen = [], self._before
        for rows in self._tables:
            for block in rows.blocks(columns, self._columns):
                self.kept.append(block.iloc[-seen % self._step :: self._step].copy())  # a view keeps the whole block
                seen += len(block)
                yield block

    def divide(self, blocks: int) -> Sequence["ThinnedRides"]:
        """Return parts of the table, see `RideSource.divide`, that together keep the same rides."""
        parts, seen = [], 0
        for rows in (part for table in self._tables for part in table.divide(blocks)):
            parts.append(ThinnedRides(rows, 0, self._columns, step=self._step, before=seen))
            seen += rows.stop - rows.start
        return parts

    def table(self) -> pd.DataFrame:
        """Return the rides that the last iteration kept.

        Returns
        -------
        DataFrame
            At most `most` rides, with the columns that were read or are to be kept.
        """
        return pd.concat(self.kept, ignore_index=True)


def list_parts(table: Path) -> list[Path]:
    """Return the Parquet files of a table: the file itself, or those of its folder in the order of their rows."""
    return sorted(table.glob("*.parquet")) if table.is_dir() else [table]


def _read(
    path: Path, columns: Sequence[str] | None, also: Sequence[str] = (), start: int = 0, stop: float = inf
) -> Iterator[pd.DataFrame]:
    """Yield the rows of a table in blocks of one size, however they are divided into files and row groups."""
    held: list[pa.RecordBatch] = []
    size = 0
    batch = None
    for batch in _read_batches(path, columns, also, start, stop):
        held.append(batch)
        size += batch.num_rows
        while size >= _BLOCK:
            table = pa.Table.from_batches(held)
            yield table.slice(0, _BLOCK).to_pandas(split_blocks=True)
            held = table.slice(_BLOCK).to_batches()
            size -= _BLOCK
    if batch is None:
        raise ModelError(f"{path} holds no Parquet file; name one that `socast tables` made")
    if size:
        yield pa.Table.from_batches(held).to_pandas(split_blocks=True)
    elif not batch.num_rows:
        yield batch.to_pandas()


def _read_batches(
    path: Path, columns: Sequence[str] | None, also: Sequence[str], start: int, stop: float
) -> Iterator[pa.RecordBatch]:
    """Yield rows of the files of a table in batches, with these columns and the others present, or with all."""
    at = 0
    with explain_table_errors(path):
        for part in list_parts(path):
            with pq.ParquetFile(part, pre_buffer=False) as file:
                names = None if columns is None else _present(columns, file.schema_arrow.names, str(part), also)
                groups: list[int] = []
                first = at
                for group in range(file.metadata.num_row_groups):
                    rows = file.metadata.row_group(group).num_rows
                    if at < stop and at + rows > start:
                        first = first if groups else at
                        groups.append(group)
                    at += rows
                for batch in file.iter_batches(batch_size=_BLOCK, columns=names, row_groups=groups) if groups else ():
                    skipped, kept = max(start - first, 0), min(stop - first, batch.num_rows)
                    first += batch.num_rows
                    if kept > skipped:
                        yield batch.slice(skipped, int(kept) - skipped)
                if not file.metadata.num_rows:
                    yield pa.RecordBatch.from_pylist([], schema=file.schema_arrow)


def _count_rows(path: Path) -> int:
    """Return the number of rows of a table."""
    with explain_table_errors(path):
        return sum(pq.read_metadata(part).num_rows for part in list_parts(path))


@contextmanager
def explain_table_errors(path: Path) -> Iterator[None]:
    """Raise ModelError where a table cannot be read."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or " ".join(str(error).split())
        raise ModelError(f"{path}: cannot read a table: {reason}; name one that `socast tables` made") from error
    except pa.ArrowException as error:
        words = " ".join(str(error).split())
        raise ModelError(f"{path}: no Parquet table: {words}; name a file that `socast tables` made") from error


def _present(
    columns: Sequence[str], there: Sequence[str] | pd.Index, where: str, also: Sequence[str] = ()
) -> list[str]:
    """Return the columns to read: all required ones, and the others and optional ones that are present."""
    known = set(there)
    wanted = dict.fromkeys((*columns, *OPTIONAL, *also))
    for name in columns:
        if name not in known and name not in OPTIONAL:
            raise ModelError(f"{where}: column {name!r} is missing: make the tables again with `socast tables`")
    return [name for name in wanted if name in known]


def select_trainable(block: pd.DataFrame, columns: Sequence[str]) -> tuple[pd.DataFrame, Counter[str]]:
    """Return the trainable rides of a block, and the number of the others by reason.

    A ride is left out if it is unfit for training, if its energy was not measured, or if the parameters of the car, and
    therefore its effects, are unknown. The fit fills other unknown values.
    """
    left_out: Counter[str] = Counter()
    reason = np.full(len(block), "", dtype=object)
    for name in columns:
        if name.startswith(EFFECT_PREFIX) or name in CarParameters._fields:
            reason[~np.isfinite(get_numbers(block, name))] = UNKNOWN_VEHICLE
    reason[~np.isfinite(get_numbers(block, ENERGY))] = "no_measured_energy"
    if "fit_for_training" in block:
        unfit = ~block["fit_for_training"].to_numpy(dtype=bool, na_value=False)
        why = (
            block["unfit_reason"][unfit].fillna("unfit").to_numpy(dtype=object) if "unfit_reason" in block else "unfit"
        )
        reason[unfit] = why
    left = reason != ""
    left_out.update(reason[left].tolist())
    return (block.loc[~left] if left.any() else block), left_out


def find_measured(rides: pd.DataFrame) -> NDArray[np.bool_]:
    """Return which rides are fit for training and have a measured energy."""
    fit = rides["fit_for_training"].to_numpy(dtype=bool, na_value=False) if "fit_for_training" in rides else True
    return np.asarray(fit & np.isfinite(get_numbers(rides, ENERGY)))


def word_too_few_rides(name: str, rides: int, least: int, left_out: Mapping[str, int]) -> str:
    """Return that a recipe has too few rides, with the reasons why others are left out, and the remedy.

    Examples
    --------
    >>> word_too_few_rides("road_load", 0, 3, {"too_short": 2})
    'recipe road_load: 2 rides, all unfit (2 too short), and it needs 3: give more rides'
    >>> word_too_few_rides("road_load", 1, 3, {})
    'recipe road_load: 1 ride to fit to, and it needs 3: give more rides'
    """
    why = ", ".join(f"{n:,} {reason.replace('_', ' ')}" for reason, n in sorted(left_out.items()))
    known = f"{format_count(rides, 'ride')} to fit to{f' ({why} left out)' if why else ''}"
    if why and not rides:
        known = f"{format_count(sum(left_out.values()), 'ride')}, all unfit ({why})"
    return f"recipe {name}: {known}, and it needs {least}: {suggest_rides(left_out)}"


def suggest_rides(left_out: Mapping[str, int]) -> str:
    """Return what to do where too few rides are left to fit to."""
    if left_out.get(UNKNOWN_VEHICLE):
        return (
            "some are of cars whose vehicle model is unknown; name it as you import (--vehicle-model, and --vehicles "
            "for a car of your own) and make the tables again, or give more rides"
        )
    if left_out.get("too_little_distance", 0) > 0.5 * sum(left_out.values()):
        return (
            "if no speed and no position was read, name their columns as you import and make the tables again; "
            "otherwise give longer rides"
        )
    return "give more rides"


def get_numbers(block: pd.DataFrame, name: str) -> Floats:
    """Return a column as float.

    Returns
    -------
    (n,) float
        NaN where the value is unknown.
    """
    try:
        return block[name].to_numpy(dtype=np.float64, na_value=np.nan)
    except (TypeError, ValueError) as error:
        raise ModelError(f"column {name!r} of the ride table is no number: {error}: make the tables again") from error


def get_numbers_if_present(block: pd.DataFrame, name: str, absent: float = np.nan) -> Floats:
    """Return a column as float, filled with `absent` where the table does not have it."""
    return get_numbers(block, name) if name in block else np.full(len(block), absent)


def parse_ride_date(text: str) -> date:
    """Return the date of a ride."""
    try:
        return date.fromisoformat(text)
    except ValueError as error:
        raise ModelError(
            f"column 'date' of the ride table holds {text!r}, no date such as 2018-11-20: make the tables again"
        ) from error


def get_names(block: pd.DataFrame, column: str) -> list[str]:
    """Return a column of text."""
    return _read_names(block, column).tolist() if column in block else [""] * len(block)


def _read_names(block: pd.DataFrame, column: str) -> NDArray[np.object_]:
    """Return a column of text, empty where it is unknown; few names occur many times."""
    place, names = pd.factorize(block[column])  # place -1 where unknown
    return np.array([*map(str, names), ""], dtype=object)[place]


def group_by_name(names: Sequence[str] | NDArray[Any]) -> dict[str, Ints]:
    """Return the rows of each name, such as a vehicle model, with the names in their order."""
    code, known = pd.factorize(np.asarray(names, dtype=object), sort=True)
    return {name: np.flatnonzero(code == i) for i, name in enumerate(known)}


def convert_to_arrays(block: pd.DataFrame, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return columns of rides as arrays, which take less time to read than those of a table."""
    numbers = {name: get_numbers(block, name) for name in columns if name not in NAMES}
    return numbers | {name: _read_names(block, name) for name in NAMES if name in block}


def assign_vehicle_days(rides: pd.DataFrame, day: str = "date") -> Ints:
    """Return the cluster of each ride: one code per vehicle and day.

    Returns
    -------
    (n,) int64
        Codes from 0, in the order of first appearance; rows of unknown vehicle or day form clusters, too.
    """
    return np.asarray(rides.groupby(["vehicle_id", day], sort=False, dropna=False).ngroup(), dtype=np.int64)
