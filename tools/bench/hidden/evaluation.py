"""Compare the result of diagnosis on a data set with the effects that are hidden in it."""

import time
from collections.abc import Callable, Sequence
from datetime import date
from typing import Any, Final

import numpy as np
import pandas as pd

from core import effects
from core.batch import Floats, Ints
from core.diagnose.dataset import Windows, gather_windows
from core.diagnose.projection import BaseProjection
from core.fit.fitting import build_design
from core.fit.recipes import fit_to_windows
from core.models import Term
from core.models.features import Columns
from tools.bench.hidden.cases import Case, get_right_names
from tools.bench.hidden.errors import compute_errors, solve_least_squares
from tools.bench.hidden.recording import Tables
from tools.bench.hidden.stlsq import build_columns, fit_stlsq

Record = dict[str, Any]
Diagnose = Callable[..., dict[str, Any]]

DATE_ERROR: Final = 28
"""Largest error of a right date. [d]"""


def evaluate_case(case: Case, tables: Tables, diagnose: Diagnose, *, timed: bool = False) -> Record:
    """Return the record of a data set: what was hidden, what was named, and whether that is right.

    Parameters
    ----------
    case : Case
        The data set.
    tables : Tables
        Its tables.
    diagnose : callable
        Takes rides, windows and a model, as `core.diagnose.diagnosis.diagnose`.
    timed : bool
        Also measure the time of sparse regression over the same windows and candidates.

    Returns
    -------
    Record
    """
    rides, table, truth = tables
    model = fit_to_windows(case.recipe, rides, table)
    began = time.perf_counter()
    result = diagnose(rides, table, model, **({"without": case.without} if case.without else {}))
    seconds = time.perf_counter() - began
    windows = gather_windows(rides, table, model)
    hidden = compute_true_energy(windows, truth)
    named = [name["columns"] for name in result["missing"]]
    visibility: Record = {"intervals": [], "left": None, "alike": None, "z": None}
    if case.hidden:
        base = BaseProjection(windows, model)
        visibility = {
            "intervals": compare_intervals(case, result["missing"], base, hidden),
            **measure_visibility(case, base, hidden),
        }
    record = {
        **describe_case(case),
        "rides": len(windows.rides),
        "samples": int(rides["samples"].sum()),
        "windows": len(windows.measured),
        **grade_names(case, result),
        "missing": [_short(name) for name in result["missing"]],
        **visibility,
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


def describe_case(case: Case) -> Record:
    """Return the description of a data set as JSON holds it.

    Parameters
    ----------
    case : Case
        The data set.
    """
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

    Parameters
    ----------
    windows : Windows
        Windows of diagnosis; one without a number covers its whole ride.
    truth : DataFrame
        `ride_key`, `window`, and the energy of each hidden effect. [kWh]

    Returns
    -------
    (n, effects) float
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


def grade_names(case: Case, result: dict[str, Any]) -> Record:
    """Return whether the names that diagnosis gives are right.

    Parameters
    ----------
    case : Case
        The data set.
    result : dict
        Result of diagnosis.

    Returns
    -------
    Record
        `outcome` of the first name: `right`, `group` (it stands for a group that holds the right name), `wrong` or
        `none`. `scope_right`: whether its cars and dates are right. `found`: number of hidden effects among as many
        first names. `names`: number of names. `doubt`: whether the first name comes in a group, structure remains, or
        its coefficient is implausible. `verdict` and `structure_remains` as in the result.
    """
    missing = result["missing"]
    wanted = [get_right_names(effect) for effect, _ in case.hidden]
    outcome = "none"
    if missing:
        outcome = max((_matches(missing[0], names) for names in wanted), key=_OUTCOMES.index, default="wrong")
    first = missing[: len(wanted)]
    matched = sum(any(_matches(each, names) != "wrong" for each in first) for names in wanted)
    doubt = bool(missing) and (
        len(set(missing[0]["group"]) | {missing[0]["effect"]}) > 1
        or result["structure_remains"]
        or not missing[0]["coefficient"]["plausible"]
    )
    return {
        "outcome": outcome,
        "scope_right": bool(missing) and is_scope_right(case, missing[0]["columns"]),
        "found": matched,
        "names": len(missing),
        "doubt": doubt,
        "verdict": result["verdict"],
        "structure_remains": result["structure_remains"],
    }


_OUTCOMES: Final = ("wrong", "group", "right")


def _matches(name: dict[str, Any], names: Sequence[str]) -> str:
    """Return whether a name is right, stands for a group that holds the right one, or is wrong."""
    if name["effect"] in names:
        return "right"
    return "group" if any(each in names for each in name["group"]) else "wrong"


def is_scope_right(case: Case, columns: Sequence[str]) -> bool:
    """Return whether a term applies where the effect is hidden; a date may be off by four weeks.

    Parameters
    ----------
    case : Case
        The data set.
    columns : sequence of str
        Columns of the term.
    """
    scopes = dict(column.split("=", 1) for column in columns if "=" in column and "@" not in column)
    if scopes.get("vehicle") != case.where.vehicle:
        return False
    if case.where.since is None or "since" not in scopes:
        return case.where.since == scopes.get("since")
    return abs((date.fromisoformat(scopes["since"]) - date.fromisoformat(case.where.since)).days) <= DATE_ERROR


def compare_intervals(
    case: Case, missing: Sequence[dict[str, Any]], base: BaseProjection, hidden: Floats
) -> list[Record]:
    """Return the interval of the coefficient of each name, and the coefficient that it should contain.

    Parameters
    ----------
    case : Case
        The data set.
    missing : sequence of dict
        Names that diagnosis gives.
    base : BaseProjection
        Projection onto the terms of the model.
    hidden : (n, effects) float
        Energy of each hidden effect in each window. [kWh]

    Returns
    -------
    list of Record
        One for each name; `right` is True if the name is right.

    Notes
    -----
    The true coefficient is the one that comes closest to the hidden energy. It follows from least squares with the
    weights of diagnosis, of the true energies on the columns of all names together, orthogonal to the terms of the
    model.
    """
    if not missing:
        return []
    off = _off(base, [name["columns"] for name in missing])
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


def measure_visibility(case: Case, base: BaseProjection, hidden: Floats) -> Record:
    """Return how much of the hidden energy is visible to diagnosis.

    Parameters
    ----------
    case : Case
        The data set.
    base : BaseProjection
        Projection onto the terms of the model.
    hidden : (n, effects) float
        Energy of each hidden effect in each window. [kWh]

    Returns
    -------
    Record
        `left`: share of the size of the hidden energy that the terms of the model cannot explain. `alike`: correlation
        of that remainder with the best variant of the right effect of the library; 1 means the same shape. `z`: number
        of standard errors by which the hidden energy itself would differ from zero as a candidate, from sums over
        vehicle-days, each with that day left out.
    """
    energy = hidden.sum(axis=1)[:, np.newaxis]
    off = base.project_out(energy)[:, 0]
    size, whole = float(np.sqrt(off @ off)), float(np.sqrt((base.apply_weights(energy) ** 2).sum()))
    scope = [f"vehicle={case.where.vehicle}"] if case.where.vehicle else []
    scope += [f"since={case.where.since}"] if case.where.since else []
    library = [effects.get(name) for effect, _ in case.hidden for name in get_right_names(effect)]
    columns = [[each.energy_name, *scope] for effect in library for each in (effect, *effect.variants)]
    orthogonal = _off(base, columns)
    sizes = np.sqrt((orthogonal**2).sum(axis=0))
    alike = np.divide(off @ orthogonal, size * sizes, out=np.zeros(len(sizes)), where=size * sizes > 0.0)
    left = size / whole if whole > 0.0 else 0.0
    return {"left": left, "alike": float(alike.max()), "z": _z(off, base.residual, base.windows.day)}


def _z(orthogonal: Floats, residual: Floats, cluster: Ints) -> float:
    """Return the coefficient of a column divided by its standard error."""
    total = float(orthogonal @ orthogonal)
    if total <= 0.0:
        return 0.0
    value = float(orthogonal @ residual) / total
    share = np.bincount(cluster, orthogonal**2) / total
    scores = np.bincount(cluster, orthogonal * (residual - orthogonal * value)) / (
        1.0 - np.minimum(share, _LARGEST_SHARE)
    )
    return value * total / float(np.sqrt((scores**2).sum()))


_LARGEST_SHARE: Final = 0.999


def _off(base: BaseProjection, columns: Sequence[Sequence[str]]) -> Floats:
    """Return weighted products of columns, orthogonal to the terms of the model."""
    terms = tuple(Term(name=str(i), columns=tuple(each), unit="1") for i, each in enumerate(columns))
    table = base.windows.table
    return base.project_out(np.nan_to_num(build_design(terms, Columns(table), len(table))))


def _short(name: dict[str, Any]) -> Record:
    """Return the fields of a name that a record keeps."""
    kept = ("effect", "variant", "group", "scope", "gain", "energy_share", "q")
    return {key: name.get(key) for key in kept}
