"""Compare the held-out error before and after adding the named effects with that of a model that knows the truth."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.diagnose.dataset import Windows
from socast.core.fit.block_sums import build_design
from socast.core.fit.ride_blocks import get_names, get_numbers
from socast.core.models import ANY, LinearModel, Term
from socast.core.models.features import ACCESSORIES_COLUMN, Columns
from socast.core.stats.splits import deal_folds

FOLDS: Final = 5
HEATING: Final = 18.0
COOLING: Final = 21.0
"""Temperatures below which accessories heat and above which they cool. [°C]"""
RANK: Final = 1e-9
"""Relative size of singular values that count as zero. [1]"""


class Errors(NamedTuple):
    """Hold the mean absolute errors of rides to which no model was fitted. [kWh]

    Parameters
    ----------
    before : float
        Error of the model as it is.
    truth : float
        Error if the hidden energy of each window is known.
    """

    before: float
    after: float
    truth: float


def compute_errors(
    windows: Windows, model: LinearModel, hidden: Floats, named: Sequence[Sequence[str]], seed: int = 0
) -> Errors:
    """Return the errors before and after, with all terms refitted by least squares to windows of other vehicle-days.

    Units: hidden [kWh].

    Notes
    -----
    Each vehicle model is fitted separately. Three linear terms replace the accessory curve: a constant power, one that
    grows with the cold and one that grows with the heat. So no model benefits from a different search of the curve.
    """
    kinds = np.array(get_names(windows.table, "vehicle_model"), dtype=object)
    days = int(windows.day.max()) + 1
    fold = deal_folds(days, FOLDS, [seed, 8])[windows.day]
    predicted = np.empty((3, len(hidden)))
    for kind in sorted(set(kinds)):
        rows = np.flatnonzero(kinds == kind)
        base = _base(windows, model, str(kind), rows)
        more = build_design(tuple(_term(columns) for columns in named), Columns(windows.table, rows=rows), len(rows))
        energy = windows.measured[rows]
        predicted[0, rows] = predict_held_out(base, energy, fold[rows])
        predicted[1, rows] = predict_held_out(np.column_stack([base, np.nan_to_num(more)]), energy, fold[rows])
        predicted[2, rows] = predict_held_out(base, energy - hidden[rows], fold[rows]) + hidden[rows]
    return Errors(*(float(np.abs(windows.by_ride(windows.measured - each)).mean()) for each in predicted))


def predict_held_out(columns: Floats, energy: Floats, fold: Ints) -> Floats:
    """Return the predictions of each fold by least squares over the other folds.

    Units: energy [kWh], returns [kWh].
    """
    out = np.empty(len(energy))
    for part in np.unique(fold):
        inside = fold == part
        out[inside] = columns[inside] @ solve_least_squares(columns[~inside], energy[~inside])
    return out


def solve_least_squares(columns: Floats, energy: Floats) -> Floats:
    """Return the coefficients of least squares; for collinear columns those of minimum norm.

    Units: energy [kWh].
    """
    size = np.sqrt((columns**2).sum(axis=0))
    scale = np.where(size > 0.0, size, 1.0)
    return np.asarray(np.linalg.lstsq(columns / scale, energy, rcond=RANK)[0] / scale)


def _base(windows: Windows, model: LinearModel, kind: str, rows: Ints) -> Floats:
    """Return the columns of a model for one vehicle model, (rows, k)."""
    fit = model.fits.get(kind) or model.fits[ANY]
    terms = tuple(term for term in model.terms if ACCESSORIES_COLUMN not in term.columns)
    columns = np.nan_to_num(build_design(terms, Columns(windows.table, fit.fills, None, rows), len(rows)))
    if len(terms) == len(model.terms):
        return columns
    hours = get_numbers(windows.table, "duration_s")[rows] / 3600.0
    ambient = np.nan_to_num(get_numbers(windows.table, "ambient_c")[rows], nan=15.0)
    power = np.column_stack(
        [np.ones(len(hours)), np.maximum(HEATING - ambient, 0.0), np.maximum(ambient - COOLING, 0.0)]
    )
    return np.column_stack([columns, power * hours[:, np.newaxis]])


def _term(columns: Sequence[str]) -> Term:
    """Return the term that is the product of columns."""
    return Term(name=", ".join(columns), columns=tuple(columns), unit="1")
