"""Compare the result of diagnosis on a data set with the effects that are hidden in it."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.diagnose.projection import BaseProjection
from socast.core.fit.recipes import fit_to_windows
from socast.tools.bench.hidden.baselines import rank_by_baselines
from socast.tools.bench.hidden.cases import Case, get_right_names
from socast.tools.bench.hidden.errors import compute_errors, solve_least_squares
from socast.tools.bench.hidden.grading import Record, grade_names
from socast.tools.bench.hidden.recording import Tables
from socast.tools.bench.hidden.stlsq import build_columns, fit_stlsq
from socast.tools.bench.hidden.visibility import measure_visibility, project_products

Diagnose = Callable[..., dict[str, Any]]


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
