"""The diagnosis: where a model fails, which effects it lacks, how sure that is, and what remains.

The procedure, each step in its own module: windows and their weights (`windows`, `noise`); what the model could take up
if it were refitted is projected off (`base`); every effect of the library is tested and ranked on held-out days
(`asked`, `evidence`, `ranking`); the best are named, beside each other (`search`) and in places (`scopes`); what is
left is looked at without the library (`structure`, `free_form`); and rides are sliced by what they have in common
(`slices`).
"""

from collections.abc import Collection
from typing import Any, Final

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from core import effects
from core.batch import Floats
from core.diagnose import residual_structure
from core.diagnose.add.refit import CoefficientEstimate
from core.diagnose.add.terms import describe_coefficient
from core.diagnose.candidates import Candidates, build_candidates
from core.diagnose.dataset import Windows, gather_windows, is_metered
from core.diagnose.evidence import ClusterSums
from core.diagnose.forward_selection import ForwardSelection, MissingEffect, SelectionSettings
from core.diagnose.free_form.search import Suggestion, suggest_term
from core.diagnose.local_effects import select_local_effects
from core.diagnose.noise import compute_ride_noise_floor
from core.diagnose.projection import BaseProjection
from core.diagnose.ranking import LEAST_GAIN, LEVEL, Ranking
from core.diagnose.residual_structure import ResidualStructure
from core.diagnose.slices.search import find_slices
from core.fit.ride_blocks import get_names, get_numbers
from core.models import LinearModel
from core.models.features import EFFECT_PREFIX

WORTH_A_TERM: Final = 0.005
"""Share of the squared error that a free-form term must explain to be suggested."""
MAX_EFFECTS: Final = 6
"""Effects that are named at most."""
FEW_DAYS: Final = 12
"""Vehicle-days below which places are not asked of one by one."""
MAINLY: Final = 0.95
"""Share of the windows from which on one way of measuring is named for all."""
ONE_WAY: Final = 0.8
"""Share of what an effect moves that must be of one sign for it to be told with that sign."""
SURELY: Final = 3.0
"""Standard errors from which on a coefficient of the sign that physics forbids is told as such."""
NORMAL: Final = 1.96
"""Half width of a 95 % interval of a normal estimate. [standard errors]"""


def diagnose(
    rides: pd.DataFrame,
    windows: pd.DataFrame,
    model: LinearModel,
    *,
    without: Collection[str] = (),
    least_gain: float = LEAST_GAIN,
    places: bool = True,
    seed: int = 0,
) -> dict[str, Any]:
    """Return what a model lacks.

    Parameters
    ----------
    rides, windows : DataFrame
        As `socast tables` makes them.
    model : LinearModel
        That is diagnosed.
    without : collection of str
        Effects of the library that are not asked of.
    least_gain : float
        Share of the squared error, of rides or of windows, whichever is larger, that an effect must explain on held-out
        days to be named.
    places : bool
        Whether to ask too what holds for one vehicle, or from a date on.
    seed : int
        Of the dealing of vehicle-days into folds and halves.

    Returns
    -------
    dict
        `model`, `data`, `error`, `slices`, `missing` (best first, each beside the others), `candidates`, `verdict`,
        `structure_remains`, `structure`, `suggestion`, `suggestion_file`, `steps`. Plain values; a figure that is not
        known is NaN or None.

    Raises
    ------
    ModelError
        Where there is too little to diagnose, see `core.diagnose.dataset.gather`.
    """
    with threadpool_limits(1):  # matrices are small: threads would wait for each other, and sums depend on their number
        return _diagnosed(gather_windows(rides, windows, model), model, without, least_gain, places=places, seed=seed)


def _diagnosed(
    seen: Windows, model: LinearModel, without: Collection[str], least_gain: float, *, places: bool, seed: int
) -> dict[str, Any]:
    """Return what a model lacks, see `diagnose`."""
    base, asked = BaseProjection(seen, model), build_candidates(seen, model, without)
    clusters = [ClusterSums(seen.day), ClusterSums(seen.date)]
    selection = ForwardSelection(base, asked, clusters, SelectionSettings(least_gain, MAX_EFFECTS, seed))
    first = selection.rank()
    selection.select_all()
    if places and int(seen.day.max()) + 1 >= FEW_DAYS:
        select_local_effects(selection, keep_declared_values(build_candidates(seen, model, without, scopes=True)))
    base = selection.base
    found = selection.list_missing_effects()
    remains = residual_structure.measure_residual_structure(selection, found)
    unknown = set(remains.signs) - {"better"}
    suggested = _suggested(base, selection, selection.compute_residual(selection.build_basis())) if unknown else None
    floor = compute_ride_noise_floor(seen)
    verdict = found[0].selected.effect if found else None
    return {
        "model": {"name": model.name, "version": model.version, "recipe": model.recipe},
        "data": _data(seen),
        "error": _error(seen, base, floor),
        "slices": find_slices(seen.rides, seen.by_ride(seen.predicted - seen.measured), seed=seed),
        "missing": [_missing(finding, seen) for finding in found],
        "candidates": _candidates(first, found),
        "verdict": verdict,
        "structure_remains": remains.exists,
        "structure": _structure(remains),
        "suggestion": None if suggested is None else suggested.formula,
        "suggestion_file": None if suggested is None else suggested.file,
        "steps": _steps(selection, found, floor),
    }


def keep_declared_values(asked: Candidates) -> Candidates:
    """Return the effects of what is asked at the values of their parameters that they are declared with."""
    kept = [i for i, variant in enumerate(asked.variants) if variant == asked.names[int(asked.effects[i])]]
    return Candidates(
        variants=tuple(asked.variants[i] for i in kept),
        effects=np.arange(len(kept), dtype=np.int64),
        names=tuple(asked.variants[i] for i in kept),
        sign=asked.sign[kept],
        columns=asked.columns[:, kept],
        measured=asked.measured,
        scope=asked.scope,
        excluded=asked.excluded,
    )


def _data(seen: Windows) -> dict[str, Any]:
    """Return what was diagnosed."""
    metered = is_metered(seen.table)
    measured = "vi" if metered.mean() > MAINLY else "soc" if metered.mean() < 1.0 - MAINLY else "mixed"
    length = float(np.median(get_numbers(seen.table, "duration_s")))
    resolution = {
        "vi": f"voltage and current, in windows of about {length:.0f} s",
        "soc": f"the state of charge alone, a whole ride at a time, about {length:.0f} s",
        "mixed": "voltage and current in windows of about a minute, or, where they lack, the state of charge by rides",
    }
    dates = sorted(date for date in get_names(seen.table, "date") if date)
    return {
        "rides": len(seen.rides),
        "windows": len(seen.table),
        "vehicles": int(seen.vehicle.max()) + 1,
        "days": int(seen.day.max()) + 1,
        "first_date": dates[0] if dates else None,
        "last_date": dates[-1] if dates else None,
        "measured": measured,
        "resolution_s": length,
        "resolution": resolution[measured],
        "left_out": dict(seen.left_out),
    }


def _error(seen: Windows, base: BaseProjection, floor: float) -> dict[str, float]:
    """Return how far off the model is, per ride."""
    error, used = seen.by_ride(seen.predicted - seen.measured), seen.by_ride(seen.measured)
    refitted = seen.by_ride(base.convert_to_energy(base.residual))
    mae = float(np.mean(np.abs(error)))
    return {
        "mae_kwh": mae,
        "relative": mae / float(np.mean(used)) if float(np.mean(used)) > 0.0 else float("nan"),
        "bias_kwh": float(np.mean(error)),
        "mae_refitted_kwh": float(np.mean(np.abs(refitted))),
        "noise_floor_kwh": floor,
    }


def _missing(finding: MissingEffect, seen: Windows) -> dict[str, Any]:
    """Return an effect that is missing."""
    named, evidence = finding.selected, finding.evidence
    effect = effects.get(named.variant)
    value = float(evidence.coefficient[0])
    low, high = evidence.compute_interval(0)
    energy = named.column[:, 0] * value
    half = NORMAL * finding.gain_error
    return {
        "effect": named.effect,
        "variant": named.variant,
        "group": [named.effect, *(name for name, _ in finding.rivals)],
        "scope": " ".join(part.replace("=", " ") for part in named.candidates.scope) or "all",
        "columns": [f"{EFFECT_PREFIX}{named.variant}", *named.candidates.scope],
        "gain": finding.gain,
        "gain_ci95": [finding.gain - half, finding.gain + half],
        "gain_of": finding.of,
        "energy_share": float(np.abs(energy).sum() / seen.measured.sum()),
        "q": named.q,
        "p": float(evidence.p[0]),
        "z": float(evidence.z[0]),
        "coefficient": describe_coefficient(
            effect, CoefficientEstimate(value, float(evidence.error[0]), float(evidence.freedom[0]))
        ),
        "words": effect.in_words(value, (high - low) / 2.0),
        "equivalents": _equivalents(energy, seen),
        "separate": [
            {"effect": name, "correlation": r, "data": effects.get(name).shown_by} for name, r in finding.rivals
        ],
    }


def _equivalents(energy: Floats, seen: Windows) -> list[str]:
    """Return what would have taken as much energy, where the effect acts: power, mass, headwind.

    Of an effect that takes here and gives there, as a wind along the road, either is counted, and marked with ±.
    """
    table = seen.table
    acts = np.abs(energy) > 0.0
    net, total = float(energy.sum()), float(np.abs(energy).sum())
    hours = float(get_numbers(table, "duration_s")[acts].sum()) / 3600.0
    if hours <= 0.0:
        return []
    sign = "±" if abs(net) < ONE_WAY * total else "+" if net > 0.0 else "-"
    said = [f"{sign}{1000.0 * total / hours:,.0f} W"]
    mass = get_numbers(table, "mass_kg")
    road = get_numbers(table, "effect_rolling") * get_numbers(table, "rolling_resistance") + get_numbers(
        table, "effect_climbing"
    )
    per_kg = float(np.nansum((road / mass)[acts]))
    if per_kg > 0.0:
        said.append(f"{sign}{total / per_kg:,.0f} kg")
    drag, speed = get_numbers(table, "effect_aero_drag"), get_numbers(table, "average_speed_kmh") / 3.6
    per_wind = float(np.nansum((2.0 * drag * get_numbers(table, "drag_area_m2") / np.maximum(speed, 1.0))[acts]))
    if per_wind > 0.0:
        said.append(f"{sign}{total / per_wind:.1f} m/s of headwind")
    return said


def _candidates(first: Ranking, found: list[MissingEffect]) -> list[dict[str, Any]]:
    """Return all effects that were asked of everywhere, as they stood before any was named."""
    rows: list[dict[str, Any]] = []
    for e, (name, at) in enumerate(zip(first.candidates.names, first.best.tolist(), strict=True)):
        row = {"effect": name, "variant": name, "scope": "all", **dict.fromkeys(("z", "p", "q", "gain"))}
        if at >= 0:
            row |= {
                "variant": first.candidates.variants[at],
                "z": float(first.evidence.z[at]),
                "p": float(first.evidence.p[at]),
                "q": float(first.q[e]),
                "gain": first.compute_gain(at)[0],
            }
        rows.append(row | {"status": _status(name, row, int(first.candidates.sign[at]), found)})
    rows.sort(key=lambda row: -(row["gain"] if row["gain"] is not None else -1.0))
    empty = dict.fromkeys(("z", "p", "q", "gain"))
    absent = [
        {"effect": name, "variant": name, "scope": "all", **empty, "status": why}
        for name, why in first.candidates.excluded.items()
    ]
    return rows + absent


def _status(name: str, row: dict[str, Any], sign: int, found: list[MissingEffect]) -> str:
    """Return what became of a candidate."""
    if name in {finding.selected.effect for finding in found}:
        return "missing"
    if row["z"] is None:
        return "cannot be told from the model"
    for finding in found:
        if name in {rival for rival, _ in finding.rivals}:
            return f"cannot be told from {finding.selected.effect}"
    if sign * row["z"] < -SURELY:
        return "wrong sign"
    return "not needed" if row["q"] < LEVEL else "not there"


def _structure(remains: ResidualStructure) -> dict[str, Any]:
    """Return what is left after the named effects."""
    return {
        "before": remains.before,
        "after": remains.after,
        "taken": remains.taken,
        "least": residual_structure.LEAST_TAKEN,
        "shape": remains.shape,
        "q": remains.q,
        "gain": remains.gain,
        "better": remains.better,
        "signs": remains.signs,
        "days": remains.days,
        "most_days": remains.most_days,
        "shapes": remains.shapes,
    }


def _suggested(base: BaseProjection, selection: ForwardSelection, left: Floats) -> Suggestion | None:
    """Return a free-form term for what is left, where one explains enough."""
    seen = base.windows
    columns = np.column_stack([base.get_unweighted_columns(), *(named.column for named in selection.selected)])
    return suggest_term(
        seen.table, base.convert_to_energy(left), base.weight, seen.day, columns, least_gain=WORTH_A_TERM
    )


def _steps(selection: ForwardSelection, found: list[MissingEffect], floor: float) -> list[dict[str, Any]]:
    """Return the error per ride as effects are added one by one, each fitted to other vehicle-days."""
    base, seen = selection.base, selection.base.windows
    named, selection.selected = selection.selected, []
    rows = []
    for finding in (None, *found):
        if finding is not None:
            selection.selected = [*selection.selected, finding.selected]
        off = selection.build_basis()
        left = selection.compute_held_out_residual(off)
        error = seen.by_ride(base.convert_to_energy(left))
        rows.append(
            {
                "effect": None if finding is None else finding.selected.effect,
                "scope": "all"
                if finding is None
                else " ".join(finding.selected.candidates.scope).replace("=", " ") or "all",
                "mae_kwh": float(np.mean(np.abs(error))),
                "noise_floor_kwh": floor,
            }
        )
    selection.selected = named
    return rows
