"""Sum what a fit needs over each block of rides, apart from all other blocks.

A fit makes three passes (`socast.core.fit.fitting`). Each maps every block to a part and adds the parts in the order of
the blocks. Parts may therefore be made anywhere, in any order, and the sums stay the same to the bit.

The fits of a block share the columns that are equal for all of them: those of terms without unknown values that do not
depend on the accessory curve.

The first pass keeps the converted rides for the later ones, so that a fit reads and converts a ride table once. Few
rides stay in memory. More rides go to a file in the temporary folder, which the system removes when it is closed, even
after a crash. Ordinary reads bring back one block at a time; a mapped file would count as memory of the process.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import prod
from tempfile import SpooledTemporaryFile
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from socast.core.batch import Floats, Ints
from socast.core.errors import ModelError
from socast.core.fit.accessory_curve import CURVE_NUMBERS, TemperatureBins, compute_slopes
from socast.core.fit.regression import Influence, Moments, Scores, assign_groups, sum_scores
from socast.core.fit.ride_blocks import (
    ENERGY,
    NAMES,
    RideSource,
    ThinnedRides,
    convert_to_arrays,
    group_by_name,
    select_trainable,
)
from socast.core.models import ANY, BASIC_PHYSICAL, VEHICLE, VEHICLE_MODEL, Term
from socast.core.models.features import ACCESSORIES_COLUMN, Columns, list_raw_columns
from socast.core.models.limit import LIMIT_NEEDS, sum_training
from socast.core.vehicles import AccessoryCurve

BLOCKS_OF_TASK: Final = 8
"""Number of blocks of rides in a task."""
IN_MEMORY: Final = 2**23
"""Size up to which converted rides stay in memory: those of one or two blocks. [B]"""

Block = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class GroupContext:
    """Hold what earlier passes found for the rides of one vehicle model, or for all rides.

    Parameters
    ----------
    coefficients : (p,) float, optional
        Coefficients without the constant; None before the normal equations are solved.
    """

    fills: Mapping[str, float]
    curve: AccessoryCurve | None
    coefficients: Floats | None = None
    constant: float = 0.0
    influence: Influence | None = None


@dataclass(frozen=True)
class FitContext:
    """Hold what a pass needs to know besides the rides.

    Parameters
    ----------
    terms : tuple of Term
        Terms without the constant.
    columns, filled : tuple of str
        Columns that are read, and those whose unknown values are replaced by their mean.
    road : tuple of Term
        Terms that are fitted together with the accessory curve.
    curved, covariance, constant : bool
        Whether a term reads the accessory curve, whether the covariance is wanted, and whether there is a constant.
    groups : mapping of str to GroupContext
        Groups by vehicle model and `*`; empty in the first pass.
    """

    terms: tuple[Term, ...]
    columns: tuple[str, ...]
    filled: tuple[str, ...]
    road: tuple[Term, ...]
    curved: bool
    covariance: bool
    constant: bool
    groups: Mapping[str, GroupContext] = field(default_factory=dict)


@dataclass
class GroupSurvey:
    """Hold what blocks tell of a group.

    Parameters
    ----------
    known, sums, squares : (filled,) int64, float, float
        Number of known values of each column that is filled, their sums, and the sums of their squares.
    taken : (3,) float
        Sums for the limit of predictions, see `socast.core.models.limit.sum_training`.
    temperatures : TemperatureBins
        Rides by outside temperature; empty where no term reads the accessory curve.
    """

    rides: int
    known: Ints
    sums: Floats
    squares: Floats
    taken: Floats
    temperatures: TemperatureBins

    def add(self, other: "GroupSurvey") -> None:
        """Add what other blocks tell."""
        self.rides += other.rides
        self.known += other.known
        self.sums += other.sums
        self.squares += other.squares
        self.taken += other.taken
        self.temperatures.merge(other.temperatures)


class Survey(NamedTuple):
    """Hold the first pass over a block.

    Parameters
    ----------
    left_out : Counter of str
        Number of rides left out, by reason.
    dates : tuple of str
        First and last date; empty if no ride has one.
    content : dict of str to bytes
        Content of each column, for the fingerprint.
    """

    left_out: Counter[str]
    dates: tuple[str, ...]
    content: dict[str, bytes]
    groups: dict[str, GroupSurvey]


class Residuals(NamedTuple):
    """Hold the residuals of a group in a block: sums of absolute values and of squares, and scores of the clusters."""

    absolute: float
    squared: float
    scores: Scores | None


class TrainableRides(NamedTuple):
    """Hold the rides of a block that are trained on, converted, and the number of the others by reason."""

    table: Block
    left_out: Counter[str]


class TaskSums(NamedTuple):
    """Hold what a task returns: the parts of its blocks, and the rides that the first pass keeps."""

    parts: list[Any]
    kept: list[pd.DataFrame]


BlockFunction = Callable[[FitContext, TrainableRides], Any]


PassRunner = Callable[[str, Callable[..., TaskSums], Sequence[tuple[Any, ...]]], Iterator[TaskSums]]
"""Runs the tasks of a pass, given its name, a function and its arguments, and yields their results in their order."""


def sum_blocks(context: FitContext, function: BlockFunction, rides: RideSource) -> TaskSums:
    """Return the parts of all blocks of rides."""
    with limit_to_one_thread():
        parts = [function(context, block) for block in convert_blocks(context, rides)]
    return TaskSums(parts, rides.kept if function is survey_block and isinstance(rides, ThinnedRides) else [])


def convert_blocks(context: FitContext, rides: RideSource) -> Iterator[TrainableRides]:
    """Yield the trainable rides of each block."""
    for block in rides.blocks(context.columns):
        good, left_out = select_trainable(block, context.columns)
        yield TrainableRides(convert_to_arrays(good, context.columns) if len(good) else {}, left_out)


def survey_block(context: FitContext, block: TrainableRides) -> Survey:
    """Return the counts and sums of a block that determine fills and accessory curves, and describe the training."""
    table = block.table
    if not table:
        return Survey(block.left_out, (), {}, {})
    dates = [date for date in table.get("date", ()) if date]
    groups = {key: _survey_group(context, Columns(table, rows=rows)) for key, rows in _split_rows(table)}
    return Survey(block.left_out, (min(dates), max(dates)) if dates else (), _encode_content(context, table), groups)


def sum_moments(context: FitContext, block: TrainableRides) -> dict[str, Moments]:
    """Return the moments of a block, of each group."""
    rides = _tabulate(context, block.table, slopes=context.curved and context.covariance)
    return {key: Moments.of(table) for key, table, _ in rides}


def sum_residuals(context: FitContext, block: TrainableRides) -> dict[str, Residuals]:
    """Return the residuals of a block, of each group."""
    sums, whole = {}, block.table
    days = assign_groups(whole[VEHICLE], whole["date"]) if VEHICLE in whole and "date" in whole else None
    slopes = context.curved and context.groups[ANY].influence is not None
    for key, table, rows in _tabulate(context, whole, slopes=slopes):
        group, scores = context.groups[key], None
        coefficients = np.ones(len(context.terms)) if group.coefficients is None else group.coefficients
        left = table[:, -1] - table[:, : len(coefficients)] @ coefficients - group.constant
        if group.influence is not None and days is not None:
            centred = table[:, :-1]
            centred -= group.influence.mean  # in place, as the table is as large as a block
            shares = left / (1.0 - group.influence.leverage(centred))
            scores = sum_scores(centred, shares, days[rows], constant=context.constant)
        sums[key] = Residuals(float(np.abs(left).sum()), float(left @ left), scores)
    return sums


def build_design(terms: tuple[Term, ...], columns: Columns, rows: int) -> Floats:
    """Return the design matrix: the product of the columns of each term."""
    out = np.empty((rows, len(terms)))
    for j, term in enumerate(terms):
        out[:, j] = prod(columns[name] for name in term.columns)
    return out


def limit_to_one_thread() -> Any:
    """Return a context that limits the linear algebra of numpy to one thread.

    The matrices are small, and the results become equal on any number of cores.
    """
    return _find_blas().limit(limits=1)


@cache
def _find_blas() -> Any:
    """Return the controller of the linear algebra of numpy; cached, as the search for it is slow."""
    return ThreadpoolController().select(user_api="blas")


def _split_rows(block: Block) -> Iterator[tuple[str, Any]]:
    """Yield the rows of each vehicle model, then all rows together."""
    kinds = group_by_name(block[VEHICLE_MODEL]) if VEHICLE_MODEL in block else {}
    yield from ((kind, rows) for kind, rows in kinds.items() if kind not in {"", ANY})
    yield ANY, slice(None)


def _survey_group(context: FitContext, columns: Columns) -> GroupSurvey:
    """Return the counts and sums of the rides of a group."""
    values = [columns[name] for name in context.filled]
    values = [column[np.isfinite(column)] for column in values]
    known, sums = np.array([len(column) for column in values]), np.array([column.sum() for column in values])
    energy, temperatures = columns[ENERGY], TemperatureBins(len(context.road))
    if context.curved:
        time = columns["duration_s"] * columns["accessory_scale"] / 3.6e6
        left = energy if context.road else energy - BASIC_PHYSICAL.predict_energy(columns)
        road = build_design(context.road, columns, len(energy)).T
        temperatures.add(columns["ambient_c"], time, left, list(road))
    taken = sum_training(energy, *(columns[name] for name in LIMIT_NEEDS))
    squares = np.array([column @ column for column in values])
    return GroupSurvey(len(energy), known, sums, squares, taken, temperatures)


def _encode_content(context: FitContext, table: Block) -> dict[str, bytes]:
    """Return the content of the columns as bytes."""
    rows = len(table[ENERGY])
    return {
        name: "\n".join([*table.get(name, [""] * rows), ""]).encode() if name in NAMES else table[name].tobytes()
        for name in (*context.columns, VEHICLE_MODEL)
    }


def _tabulate(context: FitContext, block: Block, *, slopes: bool) -> Iterator[tuple[str, Floats, Any]]:
    """Yield the key of each group, its rides of a block as a table, and their rows in the block.

    The columns of the table are the terms, with `slopes` the derivatives of the energy by each number of the accessory
    curve, and the energy. Terms that depend on no fill and no curve are computed once for all groups.
    """
    if not block:
        return
    columns = Columns(block)
    sources = [
        {source for name in term.columns for source in (name, *list_raw_columns(name))} for term in context.terms
    ]
    numbers = set().union(*sources) - {ACCESSORIES_COLUMN, *NAMES}
    apart = {ACCESSORIES_COLUMN, *(name for name in numbers if np.isnan(columns[name]).any())}
    shared = [i for i, names in enumerate(sources) if apart.isdisjoint(names)]
    others = [i for i, names in enumerate(sources) if not apart.isdisjoint(names)]
    whole = np.empty((len(block[ENERGY]), len(sources) + slopes * CURVE_NUMBERS + 1))
    _multiply(context, shared, columns, whole)
    whole[:, -1] = block[ENERGY]
    for key, rows in _split_rows(block):
        if (group := context.groups.get(key)) is not None:
            table = whole if key == ANY else whole[rows]
            columns = Columns(block, group.fills, group.curve, rows)
            _multiply(context, others, columns, table)
            if slopes and group.curve is not None:
                time = columns["duration_s"] * columns["accessory_scale"] / 3.6e6
                table[:, len(sources) : -1] = compute_slopes(group.curve, columns["ambient_c"]) * time[:, np.newaxis]
            yield key, table, rows


def _multiply(context: FitContext, terms: Sequence[int], columns: Columns, table: Floats) -> None:
    """Write the product of the columns of each of these terms to its column of a table."""
    for i in terms:
        table[:, i] = prod(columns[name] for name in context.terms[i].columns)


class BlockFile:
    """Append blocks of converted rides, and iterate over them in their order any number of times.

    Parameters
    ----------
    columns : sequence of str
        Columns of numbers to keep, besides those of `socast.core.fit.ride_blocks.NAMES` that a block has.
    """

    def __init__(self, columns: Sequence[str]) -> None:
        self._columns = [name for name in columns if name not in NAMES]
        self._file: SpooledTemporaryFile[bytes] = SpooledTemporaryFile(max_size=IN_MEMORY)  # noqa: SIM115 - see `close`
        self._sizes: list[tuple[int, int]] = []  # rows, and bytes of the names, of each block

    def append(self, block: Mapping[str, NDArray[Any]]) -> None:
        """Add a block."""
        numbers = np.stack([block[name] for name in self._columns])
        names = msgspec.msgpack.encode({name: _pack(block[name]) for name in NAMES if name in block})
        self._sizes.append((numbers.shape[1], len(names)))
        try:
            self._file.write(names)
            self._file.write(numbers.data)
        except OSError as error:
            size = sum(8 * rows * len(self._columns) + packed for rows, packed in self._sizes)
            raise ModelError(
                f"a fit needs {size / 1e6:,.1f} MB or more for a temporary file: {error.strerror}; "
                "set TMPDIR to a folder with more room"
            ) from error

    def __iter__(self) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the blocks as they were appended, with the columns to keep."""
        self._file.seek(0)
        for rows, packed in self._sizes:
            names = msgspec.msgpack.decode(self._file.read(packed), type=dict[str, tuple[bytes, list[str]]])
            content = self._file.read(8 * rows * len(self._columns))
            numbers = np.frombuffer(content).reshape(len(self._columns), rows)
            yield dict(zip(self._columns, numbers, strict=True)) | {
                name: np.array(values, dtype=object)[np.frombuffer(place, np.int32)]
                for name, (place, values) in names.items()
            }

    def close(self) -> None:
        """Remove the blocks and their file."""
        self._file.close()


def _pack(names: NDArray[Any]) -> tuple[bytes, list[str]]:
    """Return the place of each name among the distinct names, and these."""
    place, distinct = pd.factorize(names)
    return place.astype(np.int32).tobytes(), distinct.tolist()
