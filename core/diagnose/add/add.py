"""An effect added to a model: refitted to windows, judged on what it had not seen, and written into its history.

The model that comes out is fitted to all windows. An effect helps if it is there beyond chance, if on vehicle-days
that its coefficient was not fitted to it explains some least share of what the model cannot take up, and if there the
error of whole rides does not clearly grow. The error is told, too, with everything refitted without the days or the
vehicles that are judged (`core.diagnose.add.holdout`): of few days a model then extrapolates, and errs much with and without.

Of many dates every fifth is set apart, and all this is found without them: their error is told once a step, and decides
nothing. To look at it and then to go back and choose otherwise is to cheat oneself.
"""

from collections.abc import Sequence
from math import isnan
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from core import effects
from core.diagnose.add.coefficients import describe_coefficient, put_in_words, warn_if_implausible
from core.diagnose.add.holdout import (
    Mask,
    RideRows,
    compare_by_condition,
    compare_errors,
    compute_noise_floor,
    group_rows_by_ride,
    list_sparse_vehicle_models,
    predict_held_out,
    select_final_days,
    split_into_day_folds,
    split_into_vehicle_folds,
)
from core.diagnose.add.refit import (
    RefittedPair,
    TermAddition,
    assess_addition,
    predict_with_effects_held_out,
    refit_with,
)
from core.diagnose.add.terms import build_effect_term, describe_scope, is_additive
from core.diagnose.ranking import LEAST_GAIN, LEVEL
from core.effects import Effect
from core.errors import ModelError
from core.evaluate.paper.results import to_json_values
from core.fit.calibration import add_interval
from core.fit.fitting import build_design
from core.fit.ride_blocks import ENERGY, get_names, get_numbers, select_trainable
from core.formatting import rounded
from core.models import ANY, VEHICLE_MODEL, LinearModel, Term, stamp
from core.models.features import EFFECT_PREFIX, VEHICLE_SCOPE, Columns, is_scope, list_raw_columns

ADDED: Final = "add"
REFUSED: Final = "refused"
"""Actions of the history."""
MOST_APART: Final = 0.5
"""Share of the rides at which an effect is at work that may be set apart; where it would be more, none is."""

BESIDE: Final = ("conditions", "words_by_vehicle_model", "warnings")
"""What a trial has and the history has not."""


class AdditionTrial(NamedTuple):
    """An effect that was tried.

    Parameters
    ----------
    model : LinearModel
        With the effect, refitted, its history one entry longer; also where the trial speaks against it.
    trial : dict
        That entry, and beside it `conditions` (the comparison by temperature, distance, speed and vehicle),
        `words_by_vehicle_model` and `warnings`. `accepted` tells whether the effect helps, `reason` why.
    """

    model: LinearModel
    trial: dict[str, Any]


def add_effect(
    model: LinearModel,
    effect: str,
    columns: Sequence[str],
    joined: pd.DataFrame,
    *,
    rides: pd.DataFrame | None = None,
    floor: float | None = None,
    seed: int = 0,
    least: float = LEAST_GAIN,
) -> AdditionTrial:
    """Return a model with one more effect, and what came of it.

    Parameters
    ----------
    model : LinearModel
        A sum of terms, without trees and factors of cars.
    effect : str
        Name of an effect, or of a variant of one.
    columns : sequence of str
        Of its term, see `core.diagnose.add.terms.scoped`.
    joined : DataFrame
        Windows, as `core.diagnose.dataset.joined` makes them.
    rides : DataFrame, optional
        The ride table: for the model's interval, and needed by a model whose terms hold for whole rides only.
    floor : float, optional
        Mean absolute error of a ride by the measurement's own noise; else that of the tables' uncertainties. [kWh]
    seed : int
        Of the folds.
    least : float
        Fall of the error below which the effect is not accepted.

    Raises
    ------
    EffectError, ModelError
        Where the effect is unknown, in the model already, not in the tables, or nowhere at work in these rides; where
        the model is no sum of terms, and where there is too little to hold out.
    """
    declared = effects.get(effect)
    term = build_effect_term(model, effect, tuple(columns))
    found = group_rows_by_ride(_rows(model, term, joined, rides), rides)
    at_work = _at_work(declared, term, found)
    change = _change(model, term)
    made = _refitted(model, change, found, seed)
    judged, by_condition = _judged(change, found, _apart(model, found, at_work), seed, declared.sign)
    judged["noise_floor_kwh"] = compute_noise_floor(get_numbers(found.table, "sd")) if floor is None else floor
    judged |= _verdict(judged, least)
    grown = _named(made.after, model, found)
    entry = to_json_values(
        {
            "action": ADDED if judged["accepted"] else REFUSED,
            "effect": effect,
            "columns": list(columns),
            "scope": describe_scope(columns),
            **judged,
            **_coefficients(declared, made),
            "least_gain": least,
            "seed": seed,
            "fingerprint": grown.training.fingerprint if grown.training else "",
            "from_version": model.version,
        }
    )
    grown = msgspec.structs.replace(grown, history=(*model.history, entry))
    if rides is not None:
        grown = add_interval(grown, rides)
    notes = [
        f"{key}: {line}" for key, value in made.coefficients.items() if (line := warn_if_implausible(declared, value))
    ]
    words = {key: put_in_words(declared, value) for key, value in entry["by_vehicle_model"].items()}
    beside = {"conditions": by_condition, "words_by_vehicle_model": words, "warnings": notes}
    return AdditionTrial(stamp(grown), entry | beside)


def log_attempt(model: LinearModel, trial: dict[str, Any]) -> LinearModel:
    """Return a model whose history has an attempt that changed nothing of it."""
    entry = {key: value for key, value in trial.items() if key not in BESIDE}
    return msgspec.structs.replace(model, history=(*model.history, entry))


def force_addition(added: AdditionTrial) -> AdditionTrial:
    """Return an effect that was refused as one that was added all the same."""
    last = {**added.model.history[-1], "action": ADDED, "forced": True}
    model = msgspec.structs.replace(added.model, history=(*added.model.history[:-1], last))
    return AdditionTrial(stamp(model), added.trial | {"action": ADDED, "forced": True})


def _change(model: LinearModel, term: Term) -> TermAddition:
    """Return the model's own terms, the effects that were added to it, and the one that is to be."""
    before = [tuple(entry.get("columns", ())) for entry in model.history if entry.get("action") == ADDED]
    own = tuple(each for each in model.terms if each.columns not in before)
    return TermAddition(own, tuple(each for each in model.terms if each.columns in before), term)


def _rows(model: LinearModel, term: Term, joined: pd.DataFrame, rides: pd.DataFrame | None) -> pd.DataFrame:
    """Return what terms are fitted to: windows, or rides where only of these they hold."""
    rows = joined
    if not is_additive(model.terms):
        if rides is None:
            raise ModelError(f"model {model.name} has terms that hold for whole rides only: give the ride table too")
        rows = rides
    raw = dict.fromkeys(
        name for each in (*model.terms, term) for column in each.columns for name in list_raw_columns(column)
    )
    if missing := [name for name in raw if name not in rows]:
        effect = missing[0].removeprefix(EFFECT_PREFIX)
        own = ", with --effects FILE if it is your own" if missing[0].startswith(EFFECT_PREFIX) else ""
        raise ModelError(f"{effect} is not in the tables: make them anew, with `socast tables`{own}")
    good, _ = select_trainable(rows, [*raw, ENERGY])
    return good.reset_index(drop=True)


def _at_work(declared: Effect, term: Term, found: RideRows) -> Mask:
    """Return at which rides the effect is at work, where it is at any."""
    own = found.by_ride(np.abs(build_design((term,), Columns(found.rows), len(found.rows))[:, 0]))
    at_work: Mask = own > 0.0
    if at_work.any():
        return at_work
    for column in filter(is_scope, term.columns):
        if not Columns(found.rows)[column].any():
            raise ModelError(f"no ride is within the scope {column}: rides are of {_reach(found, column)}")
    shown = f"; it shows in {declared.shown_by}" if declared.shown_by else ""
    raise ModelError(f"{declared.name} is nowhere at work in these {len(at_work):,} rides{shown}")


def _reach(found: RideRows, column: str) -> str:
    """Return which vehicles, or days, there are."""
    if column.startswith(VEHICLE_SCOPE):
        return ", ".join(sorted(set(found.table["vehicle_id"])))
    return f"{min(found.dates)} to {max(found.dates)}"


def _refitted(model: LinearModel, change: TermAddition, found: RideRows, seed: int) -> RefittedPair:
    """Return the model without and with the effect, where there is enough to judge it by."""
    if not split_into_day_folds(found, seed):
        raise ModelError(
            f"all {len(found.table):,} rides are of one vehicle on one day, and none can be held out: give more days"
        )
    made = refit_with(change, found.rows, covariance=True)
    if isnan(made.coefficients[ANY].error):
        raise ModelError(
            f"model {model.name} can take up all of {change.added.name} with the terms that it has: nothing tells it "
            "from them; give it a --scope, or choose another"
        )
    return made


def _coefficients(declared: Effect, made: RefittedPair) -> dict[str, Any]:
    """Return the coefficient of the effect, what it means, and those of vehicle models that have their own."""
    values = {key: describe_coefficient(declared, estimate) for key, estimate in made.coefficients.items()}
    own = {key: value for key, value in values.items() if key != ANY}
    return {"coefficient": values[ANY], "words": put_in_words(declared, values[ANY]), "by_vehicle_model": own}


def _judged(
    change: TermAddition, found: RideRows, final: tuple[str, ...], seed: int, sign: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what the trial tells, and the comparison by conditions."""
    own = found.only(~_on(found, final))
    folds = split_into_day_folds(own, seed)
    alone = predict_with_effects_held_out(change, own.rows, [fold[own.ride] for fold in folds])
    before, after = map(own.by_ride, alone)
    of_effect = compare_errors(own.table, before, after)
    shown = assess_addition(change, own.rows, sign=sign, seed=seed)
    judged = {
        "rides": len(found.table),
        "windows": len(found.rows),
        "vehicles": int(found.table["vehicle_id"].nunique()),
        "first_date": min(found.dates),
        "last_date": max(found.dates),
        "gain": {"value": shown.gain, "ci95": shown.half},
        "p": shown.p,
        **{key: of_effect[key] for key in ("mae_before_kwh", "mae_after_kwh", "change_kwh")},
        "of_effect": of_effect,
        "on_days": compare_errors(own.table, *predict_held_out(change, own, folds)),
        "on_vehicles": _on_vehicles(change, own, seed),
        "final": _final(change, found, final) if final else None,
    }
    return judged, compare_by_condition(own.table, before, after)


def _on_vehicles(change: TermAddition, own: RideRows, seed: int) -> dict[str, Any] | None:
    """Return the comparison on vehicles that were held out; nothing where an effect is one vehicle's own."""
    folds = split_into_vehicle_folds(own, seed)
    if not folds or any(column.startswith(VEHICLE_SCOPE) for column in change.added.columns):
        return None
    return compare_errors(own.table, *predict_held_out(change, own, folds, list_sparse_vehicle_models(own.table)))


def _apart(model: LinearModel, found: RideRows, at_work: Mask) -> tuple[str, ...]:
    """Return the days that are set apart, none where too little of the effect would be left."""
    final = select_final_days(model.history, found.dates)
    return () if (at_work & _on(found, final)).sum() > MOST_APART * at_work.sum() else final


def _on(found: RideRows, days: Sequence[str]) -> Mask:
    """Return which rides are of some days."""
    return np.isin(np.asarray(found.dates, dtype=str), list(days))


def _final(change: TermAddition, found: RideRows, days: tuple[str, ...]) -> dict[str, Any]:
    """Return the comparison on the days that were set apart."""
    said = predict_held_out(change, found, [_on(found, days)])
    return {"dates": list(days), **compare_errors(found.table, *said)}


def _verdict(judged: dict[str, Any], least: float) -> dict[str, Any]:
    """Return whether the effect helps, and why."""
    gain, half = judged["gain"]["value"], judged["gain"]["ci95"]
    worse = judged["change_kwh"]["value"] - judged["change_kwh"]["ci95"]
    said = f"a gain of {rounded(100.0 * gain, 100.0 * half)} % on held-out vehicle-days"
    if isnan(half):
        reason = "there are too few vehicle-days to tell a gain from chance"
    elif judged["p"] >= LEVEL:
        reason = f"what these rides show of it may be chance, p = {judged['p']:.2g}"
    elif gain < least:
        reason = f"{said}, which is below {100.0 * least:g} %"
    elif worse > 0.0:
        reason = f"the error of held-out rides grows, by at least {worse:.2g} kWh"
    else:
        change = judged["change_kwh"]
        shown = change["value"] + change["ci95"] < 0.0
        told = f"{rounded(1000.0 * change['value'], 1000.0 * change['ci95'])} Wh"
        unsure = "" if shown else f"; the mean error of rides does not show it beyond chance: {told}"
        return {"accepted": True, "reason": said + unsure}
    return {"accepted": False, "reason": reason}


def _named(made: LinearModel, model: LinearModel, found: RideRows) -> LinearModel:
    """Return a fitted model under the name of another, its rides counted as such."""
    count = {str(key): int(n) for key, n in found.table[VEHICLE_MODEL].value_counts().sort_index().items()}
    left = get_numbers(found.table, "measured") - found.by_ride(made.predict(found.rows))
    kinds = np.array(get_names(found.table, VEHICLE_MODEL), dtype=object)
    fits = {}
    for key, fit in made.fits.items():
        own = left if key == ANY else left[kinds == key]
        fits[key] = msgspec.structs.replace(fit, rides=len(own), residual_sd_kwh=float(np.sqrt(np.mean(own**2))))
    training = made.training and msgspec.structs.replace(made.training, rides=len(found.table), vehicle_models=count)
    return msgspec.structs.replace(made, name=model.name, recipe=model.recipe, fits=fits, training=training)
