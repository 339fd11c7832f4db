"""Sum what a fit needs over each block of rides, apart from all other blocks.

A fit makes three passes (`socast.core.fit.fitting`). Each maps every block to a part and adds the parts in the order of
the blocks. Parts may therefore be made anywhere, in any order, and the sums stay the same to the bit.

The fits of a block share the columns that are equal for all of them: those of terms without unknown values that do not
depend on the accessory curve.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import prod
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from socast.core.batch import Floats
from socast.core.fit.accessory_curve import CURVE_NUMBERS, TemperatureBins, compute_slopes
from socast.core.fit.regression import Influence, Moments, Scores, assign_groups, sum_scores
from socast.core.fit.ride_blocks import ENERGY, NAMES, RideSource, ThinnedRides, convert_to_arrays, select_trainable
from socast.core.models import ANY, BASIC_PHYSICAL, VEHICLE, VEHICLE_MODEL, Term
from socast.core.models.features import ACCESSORIES_COLUMN, Columns, list_raw_columns
from socast.core.models.limit import LIMIT_NEEDS, sum_training
from socast.core.vehicles import AccessoryCurve

BLOCKS_OF_TASK: Final = 8
"""Number of blocks of rides in a task."""

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
    groups: Mapping[str, GroupContext]


class GroupSurvey(NamedTuple):
    """Hold what a block tells of a group.

    Parameters
    ----------
    sums, squares : dict of str to float
        Their sums, and the sums of their squares.
    taken : (3,) float
        Sums for the limit of predictions, see `socast.core.models.limit.sum_training`.
    """

    rides: int
    known: dict[str, int]
    sums: dict[str, float]
    squares: dict[str, float]
    taken: Floats
    temperatures: TemperatureBins | None


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


class PassRunner(Protocol):
    """Run the tasks of a pass."""

    def __call__(
        self, stage: str, function: Callable[..., TaskSums], tasks: Sequence[tuple[Any, ...]], /
    ) -> Iterator[TaskSums]:
        """Yield the result of each task, in their order."""


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
    if VEHICLE_MODEL in block:
        code, kinds = pd.factorize(block[VEHICLE_MODEL], sort=True)
        for i, kind in enumerate(kinds):
            if kind not in {"", ANY}:
                yield kind, np.flatnonzero(code == i)
    yield ANY, slice(None)


def _survey_group(context: FitContext, columns: Columns) -> GroupSurvey:
    """Return the counts and sums of the rides of a group."""
    known, sums, squares = {}, {}, {}
    for name in context.filled:
        values = columns[name]
        there = np.isfinite(values)
        values = values if there.all() else values[there]
        known[name], sums[name], squares[name] = len(values), float(values.sum()), float(values @ values)
    energy, temperatures = columns[ENERGY], None
    taken = sum_training(energy, *(columns[name] for name in LIMIT_NEEDS))
    if context.curved:
        time = columns["duration_s"] * columns["accessory_scale"] / 3.6e6
        left = energy if context.road else energy - BASIC_PHYSICAL.predict_energy(columns)
        road = build_design(context.road, columns, len(energy)).T
        temperatures = TemperatureBins(len(context.road))
        temperatures.add(columns["ambient_c"], time, left, list(road))
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
