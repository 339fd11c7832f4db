"""Compare the result of diagnosis on a data set with the effects that are hidden in it.

No diagnosis can name an effect that leaves no trace, or one whose trace another effect of the library fits as well. The
oracle knows the true energy of the hidden effect in each window. An effect is visible where the likelihood of the
oracle exceeds that of every form of every other effect by the factor `RATIO`. Errors are those of held-out rides.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from math import log
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.diagnose.candidates import Candidates, build_candidates
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.diagnose.gains import LEAST_LEFT
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.records import NONE
from socast.core.fit.block_sums import build_design
from socast.core.fit.recipes import fit_to_windows
from socast.core.fit.ride_blocks import get_names, get_numbers
from socast.core.models import ANY, LinearModel, Term
from socast.core.models.features import ACCESSORIES_COLUMN, Columns
from socast.core.stats.splits import deal_folds
from socast.tools.bench.hidden.baselines import LONGEST, RANKED, build_columns, fit_stlsq, rank_by_baselines
from socast.tools.bench.hidden.cases import Case
from socast.tools.bench.hidden.recording import Tables
from socast.tools.simulator.hidden_shapes import get_right_names

Record = dict[str, Any]

LIKELY: Final = 0.5
"""Probability from which on a name counts as a claim. [1]"""
RATIO: Final = 20.0
"""Likelihood ratio from which on the true energy of an effect is distinct from every other effect."""
LARGEST_SHARE: Final = 0.999
"""Largest share of a vehicle-day in a sum from which it is left out. [1]"""
FOLDS: Final = 5
HEATING: Final = 18.0
COOLING: Final = 21.0
"""Temperatures below which accessories heat and above which they cool. [°C]"""
RANK: Final = 1e-9
"""Relative size of singular values that count as zero. [1]"""


def grade_names(case: Case, result: Mapping[str, Any]) -> Record:
    """Return whether the names and the credible set of a diagnosis are right.

    Returns
    -------
    Record
        `outcome` of the first name: `right`, `wrong`, or `none` without a name. `names`: every name in the order of the
        diagnosis, its probability that it is missing, whatever else is, and whether it is right. What a cause outside
        the library resembles is no name, as the diagnosis says that it is another cause. `cause`: the most
        probable cause of the first name. `set_size` and `set_holds`: size of the credible set of the first name, and
        whether a hidden effect is in it; None without a name. `found`: number of hidden effects among the names with a
        probability of `LIKELY` or more. `deviations`: single cars, groups and dates that the diagnosis blames.
    """
    wanted = list_truths(case)
    hidden = {name for names in wanted for name in names} - {NONE}
    names = [
        {"effect": name["effect"], "probability": name["probability"], "right": name["effect"] in hidden}
        for name in result["missing"]
    ]
    outcome = "none" if not names else "right" if names[0]["right"] else "wrong"
    likely = {name["effect"] for name in names if name["probability"] >= LIKELY}
    credible = result["credible_set"] if names else None
    return {
        "outcome": outcome,
        "names": names,
        "cause": result["causes"][0]["effect"] if result["causes"] else NONE,
        "set_size": None if credible is None else len(credible),
        "set_holds": None if credible is None else not hidden.isdisjoint(credible),
        "found": sum(not likely.isdisjoint(each) for each in wanted),
        "deviations": [
            {key: one[key] for key in ("who", "of", "kind", "effect", "since", "q")} for one in result["deviations"]
        ],
        "verdict": result["verdict"],
        "unknown": bool(result["unknown"]),
    }


def list_truths(case: Case) -> list[tuple[str, ...]]:
    """Return the right names of each hidden effect; `none` where no effect of the library is missing."""
    names = [get_right_names(effect) for effect, _ in case.hidden]
    return [(NONE,) if set(each) <= set(case.without) else each for each in names] or [(NONE,)]


def measure_visibility(case: Case, base: BaseProjection, candidates: Candidates, hidden: Floats) -> dict[str, Any]:
    """Return how much of the hidden energy is visible to diagnosis.

    Units: hidden [kWh].

    Returns
    -------
    dict
        `left`: share of the size of the hidden energy that the terms of the model cannot explain. `alike`: correlation
        of that remainder with the best variant of the right effect of the library; 1 means the same shape. `z`: number
        of standard errors by which the hidden energy itself would differ from zero as a candidate, from sums over
        vehicle-days, each with that day left out. `ratios`: logarithm of the likelihood ratio of each effect, see
        `compare_with_rivals`. `visible`: whether all of them reach `RATIO`.
    """
    energy = hidden.sum(axis=1)[:, np.newaxis]
    off = base.project_out(energy)[:, 0]
    size, whole = float(np.sqrt(off @ off)), float(np.sqrt((base.apply_weights(energy) ** 2).sum()))
    scope = [f"vehicle={case.where.vehicle}"] if case.where.vehicle else []
    scope += [f"since={case.where.since}"] if case.where.since else []
    library = [effects.get(name) for effect, _ in case.hidden for name in get_right_names(effect)]
    columns = [[each.energy_name, *scope] for effect in library for each in (effect, *effect.variants)]
    orthogonal = project_products(base, columns)
    sizes = np.sqrt((orthogonal**2).sum(axis=0))
    alike = np.divide(off @ orthogonal, size * sizes, out=np.zeros(len(sizes)), where=size * sizes > 0.0)
    ratios = [compare_with_rivals(case, base, candidates, hidden, number) for number in range(len(case.hidden))]
    return {
        "left": size / whole if whole > 0.0 else 0.0,
        "alike": float(alike.max()),
        "z": compute_z(off, base.residual, base.windows.day),
        "ratios": ratios,
        "visible": min(ratios) >= log(RATIO),
    }


def compare_with_rivals(case: Case, base: BaseProjection, candidates: Candidates, hidden: Floats, number: int) -> float:
    """Return by how much the true energy of a hidden effect is more likely than the best form of any other effect.

    Units: hidden [kWh].

    Parameters
    ----------
    number : int
        Number of the effect. The true energies of the others are known to both sides.

    Returns
    -------
    float
        Logarithm of the likelihood ratio: half the difference of the falls of the weighted squared error, divided by
        the variance that the true energies leave. [1]
    """
    off = base.project_out(np.column_stack([hidden, candidates.columns]))
    others = [i for i in range(hidden.shape[1]) if i != number]
    known, own = off[:, others], off[:, number]
    if others:
        off = off - known @ np.linalg.lstsq(known, off, rcond=None)[0]
        own = off[:, number]
    residual = base.residual - known.sum(axis=1)
    forms = off[:, hidden.shape[1] :]
    sizes, match = (forms**2).sum(axis=0), forms.T @ residual
    right = get_right_names(case.hidden[number].effect)
    names = np.array(candidates.names, dtype=object)[candidates.effects]
    seen = sizes > LEAST_LEFT * (base.apply_weights(candidates.columns) ** 2).sum(axis=0)
    rival = seen & ~np.isin(names, right) & (candidates.sign * match >= 0.0)
    falls = np.divide(match**2, sizes, out=np.zeros(len(sizes)), where=rival)
    size, along = float(own @ own), float(own @ residual)
    fall = max(along, 0.0) ** 2 / size if size > 0.0 else 0.0
    noise = (float(residual @ residual) - fall) / max(len(residual) - base.rank, 1)
    return (fall - float(falls.max(initial=0.0))) / (2.0 * noise)


def compute_z(orthogonal: Floats, residual: Floats, cluster: Ints) -> float:
    """Return the coefficient of a column divided by its standard error."""
    total = float(orthogonal @ orthogonal)
    if total <= 0.0:
        return 0.0
    value = float(orthogonal @ residual) / total
    share = np.bincount(cluster, orthogonal**2) / total
    scores = np.bincount(cluster, orthogonal * (residual - orthogonal * value)) / (
        1.0 - np.minimum(share, LARGEST_SHARE)
    )
    return value * total / float(np.sqrt((scores**2).sum()))


def project_products(base: BaseProjection, columns: list[list[str]]) -> Floats:
    """Return weighted products of columns, orthogonal to the terms of the model, (n, products)."""
    terms = tuple(Term(name=str(i), columns=tuple(each), unit="1") for i, each in enumerate(columns))
    table = base.windows.table
    return base.project_out(np.nan_to_num(build_design(terms, Columns(table), len(table))))


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
        "baselines": {RANKED: rank_candidates(result)} | rank_by_baselines(base, candidates)
        if is_for_baselines(case, visibility)
        else {},
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


def rank_candidates(result: Mapping[str, Any]) -> list[str]:
    """Return the names of a diagnosis, then the other effects by their probability, the first `LONGEST`."""
    names = [each["effect"] for each in (*result["missing"], *result["candidates"])]
    return list(dict.fromkeys(names))[:LONGEST]


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
        more = build_design(
            tuple(Term(name=", ".join(columns), columns=tuple(columns), unit="1") for columns in named),
            Columns(windows.table, rows=rows),
            len(rows),
        )
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
