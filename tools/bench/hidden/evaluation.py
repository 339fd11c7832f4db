"""What diagnosis says of a data set, held against what is hidden in it."""

import time
from collections.abc import Callable, Sequence
from datetime import date
from typing import Any, Final

import numpy as np
import pandas as pd

from core import effects
from core.batch import Floats, Ints
from core.diagnose.dataset import Windows, fit_to_windows, gather_windows
from core.diagnose.projection import BaseProjection
from core.fit.fitting import build_design
from core.models import Term
from core.models.features import Columns
from tools.bench.hidden.cases import Case, get_right_names
from tools.bench.hidden.errors import compute_errors, solve_least_squares
from tools.bench.hidden.recording import Tables
from tools.bench.hidden.stlsq import build_columns, fit_stlsq

Record = dict[str, Any]
Diagnose = Callable[..., dict[str, Any]]

DATE_ERROR: Final = 28
"""A date that is off by so much is right. [d]"""


def evaluate_case(case: Case, tables: Tables, diagnose: Diagnose, *, timed: bool = False) -> Record:
    """Return a record of one data set: what was hidden, what was named, and how far it is right.

    Parameters
    ----------
    case : Case
    tables : Tables
    diagnose : callable
        Of rides, windows and a model, as `core.diagnose.diagnosis.diagnose`.
    timed : bool
        Measure beside it what sparse regression takes for the same windows and candidates.
    """
    rides, table, truth = tables
    model = fit_to_windows(case.recipe, rides, table)
    began = time.perf_counter()
    result = diagnose(rides, table, model, **({"without": case.without} if case.without else {}))
    seconds = time.perf_counter() - began
    windows = gather_windows(rides, table, model)
    hidden = compute_true_energy(windows, truth)
    named = [found["columns"] for found in result["missing"]]
    told: Record = {"intervals": [], "left": None, "alike": None, "z": None}
    if case.hidden:
        base = BaseProjection(windows, model)
        told = {
            "intervals": compare_intervals(case, result["missing"], base, hidden),
            **measure_visibility(case, base, hidden),
        }
    record = {
        **describe_case(case),
        "rides": len(windows.rides),
        "samples": int(rides["samples"].sum()),
        "windows": len(windows.measured),
        **grade_names(case, result),
        "missing": [_short(found) for found in result["missing"]],
        **told,
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
    """Return what a data set is, as JSON has it."""
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
    """Return the energy of each hidden effect in each window, or in the ride where that stands for all of its windows.

    (n, effects). [kWh]
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
    """Return how far the names are right.

    Keys: `outcome` of the first name (`right`, `group` where a group that holds the right one goes by another, `wrong`,
    `none`), `scope_right`, `found` (hidden effects among as many first names as there are), `names`, `doubt` (the first
    name comes in a group, structure remains, or its coefficient is not plausible), `structure_remains`.
    """
    missing = result["missing"]
    wanted = [get_right_names(effect) for effect, _ in case.hidden]
    outcome = "none"
    if missing:
        outcome = max((_matches(missing[0], names) for names in wanted), key=_OUTCOMES.index, default="wrong")
    first = missing[: len(wanted)]
    found = sum(any(_matches(each, names) != "wrong" for each in first) for names in wanted)
    doubt = bool(missing) and (
        len(set(missing[0]["group"]) | {missing[0]["effect"]}) > 1
        or result["structure_remains"]
        or not missing[0]["coefficient"]["plausible"]
    )
    return {
        "outcome": outcome,
        "scope_right": bool(missing) and is_scope_right(case, missing[0]["columns"]),
        "found": found,
        "names": len(missing),
        "doubt": doubt,
        "verdict": result["verdict"],
        "structure_remains": result["structure_remains"],
    }


_OUTCOMES: Final = ("wrong", "group", "right")


def _matches(found: dict[str, Any], names: Sequence[str]) -> str:
    """Return whether a name is right, stands for a group that holds the right one, or is wrong."""
    if found["effect"] in names:
        return "right"
    return "group" if any(name in names for name in found["group"]) else "wrong"


def is_scope_right(case: Case, columns: Sequence[str]) -> bool:
    """Tell whether a term holds where the effect is hidden; a date may be off by four weeks."""
    said = dict(column.split("=", 1) for column in columns if "=" in column and "@" not in column)
    if said.get("vehicle") != case.where.vehicle:
        return False
    if case.where.since is None or "since" not in said:
        return case.where.since == said.get("since")
    return abs((date.fromisoformat(said["since"]) - date.fromisoformat(case.where.since)).days) <= DATE_ERROR


def compare_intervals(
    case: Case, missing: Sequence[dict[str, Any]], base: BaseProjection, hidden: Floats
) -> list[Record]:
    """Return of each name the interval of its coefficient, and the coefficient that it is to hold.

    That is the one which comes closest to what is hidden: of least squares, in the weights of diagnosis, of the true
    energies on the columns of all names together, off what the model's own terms can take up. `right` tells whether
    the name is.
    """
    if not missing:
        return []
    off = _off(base, [found["columns"] for found in missing])
    truth = base.project_out(hidden.sum(axis=1)[:, np.newaxis])[:, 0]
    names = {name for effect, _ in case.hidden for name in get_right_names(effect)}
    out = []
    for found, value in zip(missing, solve_least_squares(off, truth).tolist(), strict=True):
        low, high = found["coefficient"]["ci95"]
        out.append(
            {
                "effect": found["effect"],
                "right": found["effect"] in names,
                "value": found["coefficient"]["value"],
                "ci95": [low, high],
                "truth": value,
                "holds": bool(low <= value <= high),
            }
        )
    return out


def measure_visibility(case: Case, base: BaseProjection, hidden: Floats) -> Record:
    """Return how much of what is hidden there is to be seen.

    Keys: `left`, the share of its size that the model's own terms cannot take up; `alike`, the correlation of that with
    the right effect of the library, at the best of its variants: 1 where the library has its very shape; `z`, by how
    many standard errors the energy itself, were it asked of, would stand out: of sums over vehicle-days, each as if it
    were left out.
    """
    energy = hidden.sum(axis=1)[:, np.newaxis]
    off = base.project_out(energy)[:, 0]
    size, whole = float(np.sqrt(off @ off)), float(np.sqrt((base.apply_weights(energy) ** 2).sum()))
    scope = [f"vehicle={case.where.vehicle}"] if case.where.vehicle else []
    scope += [f"since={case.where.since}"] if case.where.since else []
    library = [effects.get(name) for effect, _ in case.hidden for name in get_right_names(effect)]
    columns = [[each.energy_name, *scope] for effect in library for each in (effect, *effect.variants)]
    own = _off(base, columns)
    sizes = np.sqrt((own**2).sum(axis=0))
    alike = np.divide(off @ own, size * sizes, out=np.zeros(len(sizes)), where=size * sizes > 0.0)
    left = size / whole if whole > 0.0 else 0.0
    return {"left": left, "alike": float(alike.max()), "z": _z(off, base.residual, base.windows.day)}


def _z(own: Floats, residual: Floats, cluster: Ints) -> float:
    """Return the coefficient of a column over its standard error."""
    total = float(own @ own)
    if total <= 0.0:
        return 0.0
    value = float(own @ residual) / total
    share = np.bincount(cluster, own**2) / total
    scores = np.bincount(cluster, own * (residual - own * value)) / (1.0 - np.minimum(share, _ALL_OF_IT))
    return value * total / float(np.sqrt((scores**2).sum()))


_ALL_OF_IT: Final = 0.999


def _off(base: BaseProjection, columns: Sequence[Sequence[str]]) -> Floats:
    """Return products of columns, weighted, off what the model's own terms can take up."""
    terms = tuple(Term(name=str(i), columns=tuple(each), unit="1") for i, each in enumerate(columns))
    table = base.windows.table
    return base.project_out(np.nan_to_num(build_design(terms, Columns(table), len(table))))


def _short(found: dict[str, Any]) -> Record:
    """Return what is kept of a name."""
    kept = ("effect", "variant", "group", "scope", "gain", "energy_share", "q")
    return {key: found.get(key) for key in kept}
