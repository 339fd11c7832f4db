"""Compare the result of diagnosis on a data set with the effects that are hidden in it, also by held-out errors."""

import time
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.diagnose.projection import BaseProjection
from socast.core.fit.block_sums import build_design
from socast.core.fit.recipes import fit_to_windows
from socast.core.fit.ride_blocks import get_names, get_numbers
from socast.core.models import ANY, LinearModel, Term
from socast.core.models.features import ACCESSORIES_COLUMN, Columns
from socast.core.stats.splits import deal_folds
from socast.tools.bench.hidden.baselines import build_columns, fit_stlsq, rank_by_baselines
from socast.tools.bench.hidden.cases import Case
from socast.tools.bench.hidden.grading import Record, grade_names
from socast.tools.bench.hidden.recording import Tables
from socast.tools.bench.hidden.visibility import measure_visibility, project_products
from socast.tools.simulator.right_names import get_right_names

Diagnose = Callable[..., dict[str, Any]]

FOLDS: Final = 5
HEATING: Final = 18.0
COOLING: Final = 21.0
"""Temperatures below which accessories heat and above which they cool. [°C]"""
RANK: Final = 1e-9
"""Relative size of singular values that count as zero. [1]"""


def evaluate_case(case: Case, tables: Tables, diagnose: Diagnose, *, timed: bool = False) -> Record:
    """Return the record of a data set: what was hidden, what was named, and whether that is right."""
    rides, table, truth = tables
    model = fit_to_windows(case.recipe, rides, table)
    began = time.perf_counter()
    result = diagnose(rides, table, model, **({"without": case.without} if case.without else {}))
    seconds = time.perf_counter() - began
    windows = gather_windows(rides, table, model)
    hidden = compute_true_energy(windows, truth)
    named = [name["columns"] for name in result["missing"]]
    base, candidates = BaseProjection(windows, model), build_candidates(windows, model)
    visibility: Record = dict.fromkeys(("left", "alike", "z", "ratios", "visible"))
    if case.hidden:
        visibility = measure_visibility(case, base, candidates, hidden)
    record = {
        **describe_case(case),
        "rides": len(windows.rides),
        "samples": int(rides["samples"].sum()),
        "windows": len(windows.measured),
        **grade_names(case, result),
        "missing": [_short(name) for name in result["missing"]],
        **visibility,
        "intervals": compare_intervals(case, result["missing"], base, hidden) if case.hidden else [],
        "baselines": rank_by_baselines(base, candidates) if is_for_baselines(case, visibility) else {},
        "errors": compute_errors(windows, model, hidden.sum(axis=1), named, case.seed)._asdict(),
        "noise_floor_kwh": result["error"]["noise_floor_kwh"],
        "seconds": seconds,
    }
    if timed:
        columns = build_columns(windows, model)
        began = time.perf_counter()
        fit_stlsq(columns, windows.measured)
        record["stlsq_seconds"] = time.perf_counter() - began
    return record


def is_for_baselines(case: Case, visibility: Record) -> bool:
    """Return whether the baselines are judged on a data set: one visible effect of the library is hidden."""
    return len(case.hidden) == 1 and not case.without and bool(visibility["visible"])


def describe_case(case: Case) -> Record:
    """Return the description of a data set as JSON holds it."""
    return {
        "seed": case.seed,
        "hidden": [list(each) for each in case.hidden],
        "measurement": case.measurement,
        "weather": case.weather,
        "vehicle": case.where.vehicle,
        "since": case.where.since,
        "without": list(case.without),
    }


def compute_true_energy(windows: Windows, truth: pd.DataFrame) -> Floats:
    """Return the energy of each hidden effect in each window. [kWh]

    Units: truth [kWh].
    """
    of_window = truth.set_index(["ride_key", "window"])
    of_ride = truth.drop(columns="window").groupby("ride_key").sum()
    ride, window = windows.table["ride_key"], windows.table["window"]
    whole = window.isna().to_numpy()
    places = pd.MultiIndex.from_arrays([ride[~whole], window[~whole].astype(np.int64)])
    out = np.empty((len(ride), of_window.shape[1]))
    out[~whole] = of_window.loc[places].to_numpy(dtype=np.float64)
    out[whole] = of_ride.loc[ride[whole]].to_numpy(dtype=np.float64)
    return out


def compare_intervals(
    case: Case, missing: Sequence[dict[str, Any]], base: BaseProjection, hidden: Floats
) -> list[Record]:
    """Return the interval of the coefficient of each name, and the coefficient that it should contain.

    Units: hidden [kWh].

    Notes
    -----
    The true coefficient is the one that comes closest to the hidden energy. It follows from least squares with the
    weights of diagnosis, of the true energies on the columns of all names together, orthogonal to the terms of the
    model.
    """
    if not missing:
        return []
    off = project_products(base, [name["columns"] for name in missing])
    truth = base.project_out(hidden.sum(axis=1)[:, np.newaxis])[:, 0]
    names = {right for effect, _ in case.hidden for right in get_right_names(effect)}
    out = []
    for name, value in zip(missing, solve_least_squares(off, truth).tolist(), strict=True):
        low, high = name["coefficient"]["ci95"]
        out.append(
            {
                "effect": name["effect"],
                "right": name["effect"] in names,
                "value": name["coefficient"]["value"],
                "ci95": [low, high],
                "truth": value,
                "holds": bool(low <= value <= high),
            }
        )
    return out


def _short(name: dict[str, Any]) -> Record:
    """Return the fields of a name that a record keeps."""
    kept = ("effect", "variant", "probability", "credible_set", "gain", "energy_share", "z")
    return {key: name.get(key) for key in kept}


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
