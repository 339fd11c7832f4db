"""Add an effect to a model: refit it to windows, evaluate it on held-out rides, and record the trial in its history.

The resulting model is fitted to all windows. An effect is added if all of the following hold:

- its evidence is beyond chance;
- on vehicle-days to which its coefficient was not fitted, it explains a least share of the squared error that the
  other terms of the model cannot explain, and the 95 % interval of that share is above zero;
- on these vehicle-days, the mean error of whole rides falls, also with everything refitted.

It is refused where the data show that it does not help: it explains less than that share at the upper end of the
interval, or the error clearly grows, also with everything refitted without the held-out days or vehicles
(`socast.core.diagnose.add.holdout`). Otherwise the trial is undecided: nothing is added, and the reason says how many
vehicle-days would decide.

A model that is refitted without the held-out days may err more on them than the model as given, which may have seen
them. The trial has both errors.

With many dates, every fifth date is a final hold-out. The decision does not use these dates; each step reports their
error once. Evaluate on the final hold-out once; do not tune on it.
"""

from collections.abc import Callable, Sequence
from math import isnan
from typing import Final, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.diagnose.add.holdout import (
    Mask,
    RideRows,
    compare_by_condition,
    compare_errors,
    group_rows_by_ride,
    list_sparse_vehicle_models,
    predict_held_out,
    select_final_days,
    split_into_day_folds,
    split_into_vehicle_folds,
)
from socast.core.diagnose.add.records import (
    ADDED,
    REFUSED,
    UNDECIDED,
    EffectTrial,
    ErrorFall,
    FinalErrorFall,
    list_attempts,
)
from socast.core.diagnose.add.refit import (
    RefittedPair,
    TermAddition,
    assess_addition,
    predict_with_effects_held_out,
    project_plain,
    refit_with,
)
from socast.core.diagnose.add.terms import (
    build_effect_term,
    describe_coefficient,
    explain_coefficient,
    is_additive,
    warn_if_implausible,
)
from socast.core.diagnose.candidates import find_coefficient_limits
from socast.core.diagnose.gains import LEAST_GAIN, LEVEL
from socast.core.effects import Effect
from socast.core.errors import ModelError
from socast.core.evaluate.records import hold_estimate
from socast.core.fit.block_sums import build_design
from socast.core.fit.calibration import add_interval
from socast.core.fit.recipes import RECIPES
from socast.core.fit.ride_blocks import ENERGY, get_names, get_numbers, select_trainable
from socast.core.fit.window_recipe import WindowRecipe
from socast.core.formatting import format_minus, rounded
from socast.core.models import ANY, VEHICLE_MODEL, LinearModel, Term, stamp
from socast.core.models.features import EFFECT_PREFIX, VEHICLE_SCOPE, Columns, list_raw_columns, list_scope

MAX_FINAL_SHARE: Final = 0.5
"""Share of the rides with the effect that may be in the final hold-out; above it, there is no final hold-out."""
MOST_DAYS: Final = 1e5
"""Number of vehicle-days beyond which nobody waits for a decision."""


class AdditionTrial(NamedTuple):
    """Hold the trial of an effect that was added to a model.

    Parameters
    ----------
    model : LinearModel
        The refitted model with the effect and with the trial in its history, also if the trial refuses the effect.
    """

    model: LinearModel
    trial: EffectTrial


def add_effect(
    model: LinearModel,
    effect: str,
    columns: Sequence[str],
    joined: pd.DataFrame,
    *,
    rides: pd.DataFrame | None = None,
    seed: int = 0,
    least: float = LEAST_GAIN,
    report: Callable[[float, str], None] = lambda *_: None,
) -> AdditionTrial:
    """Return a model with one more effect, and the trial of this effect.

    Parameters
    ----------
    rides : DataFrame, optional
        The ride table. The interval of the model needs it, and so does a model with terms that hold for whole rides
        only.
    least : float
        Least gain of an accepted effect, as a share of the squared error. [1]
    report : callable
        Function that receives, before each step, the share of the work that is done, and the step in words.
    """
    declared = effects.get(effect)
    term = build_effect_term(model, effect, tuple(columns))
    data = group_rows_by_ride(_select_rows(model, term, joined, rides), rides)
    active = _find_active_rides(declared, term, data)
    addition = _split_terms(model, term)
    report(0.05, "fitting without and with the effect")
    pair = _refit(model, addition, data, seed)
    final = _choose_final_days(model, data, active)
    limits = find_coefficient_limits(effect, declared.sign)
    evaluated = _evaluate(addition, data, final, seed, declared.sign, limits, report)
    outcome, reason = _judge(evaluated, least)
    grown = _name_model(pair.after, model, data)
    coefficients = {key: describe_coefficient(declared, estimate) for key, estimate in pair.coefficients.items()}
    words = {key: explain_coefficient(declared, estimate) for key, estimate in pair.coefficients.items()}
    doubts = {key: warn_if_implausible(declared, estimate) for key, estimate in pair.coefficients.items()}
    trial = msgspec.structs.replace(
        evaluated,
        action=outcome,
        effect=effect,
        columns=tuple(columns),
        mae_given_kwh=_compute_given_error(model, data, final),
        outcome=outcome,
        accepted=outcome == ADDED,
        reason=reason,
        coefficient=coefficients.pop(ANY),
        words=words.pop(ANY),
        by_vehicle_model=coefficients,
        least_gain=least,
        seed=seed,
        fingerprint=grown.training.fingerprint if grown.training else "",
        from_version=model.version,
        words_by_vehicle_model=words,
        warnings=[f"{key}: {doubt}" for key, doubt in doubts.items() if doubt],
    )
    grown = log_attempt(msgspec.structs.replace(grown, history=model.history), trial)
    if rides is not None:
        report(0.9, "calibrating the interval of the model")
        grown = add_interval(grown, rides)
    return AdditionTrial(stamp(grown), trial)


def log_attempt(model: LinearModel, trial: EffectTrial) -> LinearModel:
    """Return a model that is unchanged except for a trial in its history."""
    return msgspec.structs.replace(model, history=(*model.history, trial.to_entry()))


def force_addition(added: AdditionTrial) -> AdditionTrial:
    """Return the trial of an effect that was refused or undecided as one that added the effect by force."""
    trial = msgspec.structs.replace(added.trial, action=ADDED, forced=True)
    model = msgspec.structs.replace(added.model, history=added.model.history[:-1])
    return AdditionTrial(stamp(log_attempt(model, trial)), trial)


def _split_terms(model: LinearModel, term: Term) -> TermAddition:
    """Return the original terms of a model, the effects that were added to it, and the term to add."""
    added = [attempt.columns for attempt in list_attempts(model.history) if attempt.action == ADDED]
    original = tuple(each for each in model.terms if each.columns not in added)
    has_priors = isinstance(RECIPES.get(model.recipe), WindowRecipe)
    return TermAddition(original, tuple(each for each in model.terms if each.columns in added), term, has_priors)


def _select_rows(model: LinearModel, term: Term, joined: pd.DataFrame, rides: pd.DataFrame | None) -> pd.DataFrame:
    """Return the rows to fit to: windows, or rides if a term holds for whole rides only."""
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
        remedy = ", with --effects FILE for an effect of your own" if missing[0].startswith(EFFECT_PREFIX) else ""
        raise ModelError(f"{effect} is not in the tables: make them again with `socast tables`{remedy}")
    good, _ = select_trainable(rows, [*raw, ENERGY])
    return good.reset_index(drop=True)


def _find_active_rides(declared: Effect, term: Term, data: RideRows) -> Mask:
    """Return the rides in which an effect is active; raise where there is none."""
    size = data.by_ride(np.abs(build_design((term,), Columns(data.rows), len(data.rows))[:, 0]))
    active: Mask = size > 0.0
    if active.any():
        return active
    for column in list_scope(term.columns):
        if not Columns(data.rows)[column].any():
            raise ModelError(f"no ride is within the scope {column}: the rides are of {_describe_reach(data, column)}")
    shown = f"; record {declared.shown_by}" if declared.shown_by else ""
    raise ModelError(f"{declared.name} is never active in these {len(active):,} rides{shown}")


def _describe_reach(data: RideRows, column: str) -> str:
    """Return the vehicles or the dates of the rides, whichever a scope limits."""
    if column.startswith(VEHICLE_SCOPE):
        return ", ".join(sorted(set(data.table["vehicle_id"])))
    return f"{min(data.dates)} to {max(data.dates)}"


def _refit(model: LinearModel, addition: TermAddition, data: RideRows, seed: int) -> RefittedPair:
    """Return the model refitted without and with the effect; raise where the data cannot test it."""
    if not split_into_day_folds(data, seed):
        raise ModelError(
            f"all {len(data.table):,} rides are of one vehicle on one day, and none can be held out: give more days"
        )
    pair = refit_with(addition, data.rows, covariance=True)
    if isnan(pair.coefficients[ANY].error):
        raise ModelError(
            f"model {model.name} can reproduce all of {addition.added.name} with its own terms, so the effect is not "
            "identifiable: give it a --scope, or choose another effect"
        )
    return pair


def _evaluate(
    addition: TermAddition,
    data: RideRows,
    final: tuple[str, ...],
    seed: int,
    sign: int,
    limits: tuple[float, float],
    report: Callable[[float, str], None],
) -> EffectTrial:
    """Return the errors of the trial, without its outcome and its coefficient."""
    development = data.only(~_are_on_days(data, final))
    folds = split_into_day_folds(development, seed)
    report(0.15, "evaluating the effect on held-out days")
    plain, base = project_plain(addition, development.rows)
    predictions = predict_with_effects_held_out(addition, plain, base, [fold[development.ride] for fold in folds])
    before, after = map(development.by_ride, predictions)
    of_effect = compare_errors(development.table, before, after)
    evidence = assess_addition(addition, base, sign=sign, limits=limits, seed=seed)
    report(0.3, "refitting all terms and evaluating on held-out days")
    on_days = compare_errors(development.table, *predict_held_out(addition, development, folds))
    report(0.6, "refitting all terms and evaluating on held-out vehicles")
    on_vehicles = _compare_on_vehicles(addition, development, seed)
    report(0.8, "evaluating on the final hold-out days")
    return EffectTrial(
        rides=len(data.table),
        windows=len(data.rows),
        vehicles=int(data.table["vehicle_id"].nunique()),
        first_date=min(data.dates),
        last_date=max(data.dates),
        gain=hold_estimate(evidence.gain),
        p=evidence.p,
        mae_before_kwh=of_effect.mae_before_kwh,
        mae_after_kwh=of_effect.mae_after_kwh,
        change_kwh=of_effect.change_kwh,
        noise_floor_kwh=of_effect.noise_kwh,
        of_effect=of_effect,
        on_days=on_days,
        on_vehicles=on_vehicles,
        final=_compare_on_final_days(addition, data, final) if final else None,
        conditions=compare_by_condition(development.table, before, after),
    )


def _compare_on_vehicles(addition: TermAddition, data: RideRows, seed: int) -> ErrorFall | None:
    """Return the comparison on held-out vehicles, or None where the effect is limited to one vehicle."""
    folds = split_into_vehicle_folds(data, seed)
    if not folds or any(column.startswith(VEHICLE_SCOPE) for column in addition.added.columns):
        return None
    pooled = list_sparse_vehicle_models(data.table)
    return compare_errors(data.table, *predict_held_out(addition, data, folds, pooled))


def _choose_final_days(model: LinearModel, data: RideRows, active: Mask) -> tuple[str, ...]:
    """Return the final hold-out days, none where they would contain too many rides with the effect."""
    final = select_final_days(model.history, data.dates)
    return () if (active & _are_on_days(data, final)).sum() > MAX_FINAL_SHARE * active.sum() else final


def _are_on_days(data: RideRows, days: Sequence[str]) -> Mask:
    """Return which rides are on some days."""
    return np.isin(np.asarray(data.dates, dtype=str), list(days))


def _compare_on_final_days(addition: TermAddition, data: RideRows, days: tuple[str, ...]) -> FinalErrorFall:
    """Return the comparison on the final hold-out days."""
    predictions = predict_held_out(addition, data, [_are_on_days(data, days)])
    return FinalErrorFall(dates=days, **msgspec.structs.asdict(compare_errors(data.table, *predictions)))


def _judge(trial: EffectTrial, least: float) -> tuple[str, str]:
    """Return the outcome of a trial, and why."""
    gain, half = trial.gain.value, trial.gain.ci95
    if gain is None or half is None or trial.change_kwh.ci95 is None:
        return UNDECIDED, "there are too few vehicle-days to distinguish a gain from chance; give more days"
    share, low, high = (
        format_minus(f"{round(100.0 * each, 1) + 0.0:.1f}") for each in (gain, gain - half, gain + half)
    )
    statement = f"it explains {share} % (95 % interval {low} % to {high} %) of the squared error on held-out days"
    if growth := _find_growth(trial):
        return REFUSED, growth
    if gain < least:
        below = f"{statement}; below {100.0 * least:g} % it is not worth a term"
        if gain + half < least:
            return REFUSED, below
        return UNDECIDED, below + _count_deciding(trial.of_effect.clusters, least - gain, half)
    doubt = _find_doubt(trial, statement, gain, half)
    return (UNDECIDED, doubt) if doubt else (ADDED, statement)


def _find_doubt(trial: EffectTrial, statement: str, gain: float, half: float) -> str:
    """Return why a gain may be due to chance and what would decide, empty where it is beyond chance."""
    p = 1.0 if trial.p is None else trial.p
    if p >= LEVEL or gain - half <= 0.0:
        by_chance = f"its evidence in these rides may be due to chance, p = {p:.2g}"
        doubt = by_chance if p >= LEVEL else f"{statement}, which may be due to chance"
        return doubt + _count_deciding(trial.of_effect.clusters, gain, half)
    growing = _list_growing(trial)
    return f"{statement}, but the mean error of rides grows: {growing}; give more days" if growing else ""


def _find_growth(trial: EffectTrial) -> str:
    """Return on which held-out rides the error clearly grows, empty where it does so on none."""
    held_out = {
        "held-out rides": trial.of_effect,
        "held-out rides, with all terms refitted,": trial.on_days,
        "held-out vehicles, with all terms refitted,": trial.on_vehicles,
    }
    for what, fall in held_out.items():
        limits = fall.change_kwh.interval if fall else None
        if limits and limits[0] > 0.0:
            return f"the error of {what} grows by at least {limits[0]:.2g} kWh"
    return ""


def _list_growing(trial: EffectTrial) -> str:
    """Return on which held-out days the mean error of rides grows, though perhaps by chance, and by how much."""
    found = []
    for fall, what in ((trial.of_effect, "on held-out days"), (trial.on_days, "with all terms refitted")):
        change = fall.change_kwh
        if change.value is not None and change.value > 0.0:
            half = None if change.ci95 is None else 1000.0 * change.ci95
            found.append(f"by {rounded(1000.0 * change.value, half)} Wh {what}")
    return " and ".join(found)


def _count_deciding(days: int, distance: float, half: float) -> str:
    """Return how many vehicle-days would decide if the gain stays as far from the limit as it is.

    Examples
    --------
    >>> _count_deciding(100, 0.01, 0.02), _count_deciding(100, 0.03, 0.02)
    ('; about 400 vehicle-days would decide, 100 are given', '; give more days')
    >>> _count_deciding(100, 0.00001, 0.02)
    '; even 100,000 vehicle-days would not decide'
    """
    if distance <= 0.0:
        return "; with more days, it may turn out not to help"
    needed = days * (half / distance) ** 2
    if needed > MOST_DAYS:
        return f"; even {MOST_DAYS:,.0f} vehicle-days would not decide"
    if needed <= days:
        return "; give more days"
    return f"; about {needed:,.0f} vehicle-days would decide, {days:,} are given"


def _compute_given_error(model: LinearModel, data: RideRows, final: Sequence[str]) -> float:
    """Return the mean absolute error of the model as given on the rides that are held out in turn. [kWh]"""
    development = data.only(~_are_on_days(data, final))
    error = get_numbers(development.table, "measured") - development.by_ride(model.predict_energy(development.rows))
    return float(np.mean(np.abs(error)))


def _name_model(fitted: LinearModel, model: LinearModel, data: RideRows) -> LinearModel:
    """Return a fitted model under the name of another, with counts and residuals of rides instead of windows."""
    count = {str(key): int(n) for key, n in data.table[VEHICLE_MODEL].value_counts().sort_index().items()}
    residual = get_numbers(data.table, "measured") - data.by_ride(fitted.predict_energy(data.rows))
    kinds = np.array(get_names(data.table, VEHICLE_MODEL), dtype=object)
    fits = {}
    for key, fit in fitted.fits.items():
        of_kind = residual if key == ANY else residual[kinds == key]
        sd = float(np.sqrt(np.mean(of_kind**2)))
        fits[key] = msgspec.structs.replace(fit, rides=len(of_kind), residual_sd_kwh=sd)
    training = fitted.training and msgspec.structs.replace(fitted.training, rides=len(data.table), vehicle_models=count)
    return msgspec.structs.replace(fitted, name=model.name, recipe=model.recipe, fits=fits, training=training)
