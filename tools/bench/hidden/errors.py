"""How much of the error goes with what was named, against a model that knows the truth, on vehicle-days held out."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from core.batch import Floats, Ints
from core.diagnose.dataset import Windows
from core.fit.fitting import build_design
from core.fit.ride_blocks import get_names, get_numbers
from core.models import ANY, LinearModel, Term
from core.models.features import ACCESSORIES_COLUMN, Columns

FOLDS: Final = 5
HEATING: Final = 18.0
COOLING: Final = 21.0
"""Below which accessories heat and above which they cool. [°C]"""
RANK: Final = 1e-9


class Errors(NamedTuple):
    """Mean absolute error of rides that a model was not fitted to. [kWh]

    Parameters
    ----------
    before : Of the model as it is.
    after : With what was named added.
    truth : With what is hidden known, window by window.
    """

    before: float
    after: float
    truth: float


def compute_errors(
    windows: Windows, model: LinearModel, hidden: Floats, named: Sequence[Sequence[str]], seed: int = 0
) -> Errors:
    """Return the error before and after, everything refitted by least squares to the windows of other vehicle-days.

    Parameters
    ----------
    windows : Windows
    model : LinearModel
    hidden : (n,) float
        Energy of what is hidden. [kWh]
    named : sequence of sequence of str
        Columns of the term of each effect that was named.
    seed : int
        Of the folds.

    Notes
    -----
    For each vehicle model. In place of the accessory curve stand a standby power, one that grows with the cold and one
    that grows with the heat, so that all three are linear and none is better for a search that went otherwise.
    """
    kinds = np.array(get_names(windows.table, "vehicle_model"), dtype=object)
    days = int(windows.day.max()) + 1
    fold = (np.random.default_rng([seed, 8]).permutation(days) % FOLDS)[windows.day]
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
    """Return the predictions of each fold by least squares of the others, (n,)."""
    out = np.empty(len(energy))
    for part in np.unique(fold):
        inside = fold == part
        out[inside] = columns[inside] @ solve_least_squares(columns[~inside], energy[~inside])
    return out


def solve_least_squares(columns: Floats, energy: Floats) -> Floats:
    """Return the coefficients of least squares; of columns that tell the same, the shortest."""
    size = np.sqrt((columns**2).sum(axis=0))
    scale = np.where(size > 0.0, size, 1.0)
    return np.asarray(np.linalg.lstsq(columns / scale, energy, rcond=RANK)[0] / scale)


def _base(windows: Windows, model: LinearModel, kind: str, rows: Ints) -> Floats:
    """Return a model's own columns for one vehicle model, (rows, k)."""
    fit = model.fits.get(kind) or model.fits[ANY]
    terms = tuple(term for term in model.terms if ACCESSORIES_COLUMN not in term.columns)
    own = np.nan_to_num(build_design(terms, Columns(windows.table, fit.fills, None, rows), len(rows)))
    if len(terms) == len(model.terms):
        return own
    hours = get_numbers(windows.table, "duration_s")[rows] / 3600.0
    ambient = np.nan_to_num(get_numbers(windows.table, "ambient_c")[rows], nan=15.0)
    power = np.column_stack(
        [np.ones(len(hours)), np.maximum(HEATING - ambient, 0.0), np.maximum(ambient - COOLING, 0.0)]
    )
    return np.column_stack([own, power * hours[:, np.newaxis]])


def _term(columns: Sequence[str]) -> Term:
    return Term(name=", ".join(columns), columns=tuple(columns), unit="1")
