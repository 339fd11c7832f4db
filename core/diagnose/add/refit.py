"""Refit a model with one more effect: first the coefficient of the effect, then all other terms around it.

The coefficient is estimated as in the diagnosis (`socast.core.diagnose.projection`): with the measurement weights, on
what the terms of the model cannot explain. All vehicle models share one coefficient unless theirs differ by more than
chance. Then each has its own, shrunk towards the common one in proportion to its uncertainty. The other terms are then
fitted to the energy less that of the effect, with priors where the model had them. The same holds for effects that were
added before, all beside each other.
"""

from collections.abc import Collection, Mapping, Sequence
from math import nan, sqrt
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.diagnose.candidates import compute_least_coefficients
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.gains import compute_held_out_gain
from socast.core.diagnose.projection import BaseProjection, orthonormalise
from socast.core.fit.block_sums import build_design, limit_to_one_thread
from socast.core.fit.fitting import fit_terms
from socast.core.fit.recipes import LinearRecipe
from socast.core.fit.ride_blocks import ENERGY, RideFrame, assign_vehicle_days, get_names, get_numbers
from socast.core.fit.window_fit import fit_rows
from socast.core.models import ANY, VEHICLE_MODEL, Fit, LinearModel, Term
from socast.core.models.features import Columns
from socast.core.stats.evidence import ClusterSums, compute_worst_case_evidence
from socast.core.stats.random_effects import estimate_variance_between
from socast.core.stats.scores import Estimate

LEAST_LEFT: Final = 1e-5
"""Share of a column that must remain off the terms of the model for the column to have a coefficient."""
LEAST_FREEDOM: Final = 2.0
"""Degrees of freedom below which the estimate of a vehicle model is not used."""

REFITTED: Final = "diagnosed"
"""Name of the recipe of a model that is refitted to test a term."""

Rows = NDArray[np.int64]


class TermAddition(NamedTuple):
    """Hold a term to be added to a model.

    Parameters
    ----------
    base : tuple of Term
        Original terms of the model, fitted freely.
    effects : tuple of Term
        Effects that were added to the model before.
    has_priors : bool
        Whether the original terms are fitted to windows with priors and within their ranges
        (`socast.core.fit.window_fit`), as those of the recipe `road_load`; otherwise by least squares.
    """

    base: tuple[Term, ...]
    effects: tuple[Term, ...]
    added: Term
    has_priors: bool = False


class RefittedPair(NamedTuple):
    """Hold a model without and with a term, fitted to the same rows.

    Parameters
    ----------
    before, after : LinearModel
        The model without and with the term.
    coefficients : dict of str to Estimate
        Coefficients of the added term by vehicle model, `*` for all.
    """

    before: LinearModel
    after: LinearModel
    coefficients: dict[str, Estimate]


def refit(change: TermAddition, rows: pd.DataFrame, *, covariance: bool = False) -> LinearModel:
    """Return the original terms of a model fitted to windows or rides, in the way in which they were fitted before."""
    if change.has_priors:
        return fit_rows(REFITTED, change.base, rows)[0]
    return fit_terms(LinearRecipe(REFITTED, "", change.base), RideFrame(rows), covariance=covariance)


def refit_with(
    change: TermAddition, rows: pd.DataFrame, *, pooled: Collection[str] = (), covariance: bool = False
) -> RefittedPair:
    """Return a model fitted without and with a term.

    Returns
    -------
    RefittedPair
        Its coefficient is 0 with an unknown error where the terms of the model can explain the whole term.
    """
    visible = hide_vehicle_models(rows, pooled)
    with limit_to_one_thread():
        plain = refit(change, visible)
        base = BaseProjection(convert_to_windows(rows), plain)
        before = plain
        if change.effects:
            before = _around(change, change.effects, visible, _estimates(base, change.effects), covariance=False)
        terms = (*change.effects, change.added)
        base = base.reweight(np.nan_to_num(build_design(terms, Columns(base.windows.table), len(base.windows.table))))
        estimates = _estimates(base, terms)
        after = _around(change, terms, visible, estimates, covariance=covariance)
    return RefittedPair(before, msgspec.structs.replace(after, training=plain.training), estimates[-1])


def hide_vehicle_models(rows: pd.DataFrame, kinds: Collection[str]) -> pd.DataFrame:
    """Return rows in which some vehicle models are unknown."""
    if not kinds:
        return rows
    return rows.assign(**{VEHICLE_MODEL: rows[VEHICLE_MODEL].where(~rows[VEHICLE_MODEL].isin(list(kinds)), "")})


def convert_to_windows(rows: pd.DataFrame) -> Windows:
    """Return rows as `socast.core.diagnose.dataset.Windows` with predictions of zero."""
    ride = pd.factorize(rows["ride_key"])[0]
    return Windows(
        table=rows,
        rides=rows.iloc[np.unique(ride, return_index=True)[1]].reset_index(drop=True),
        measured=get_numbers(rows, ENERGY),
        predicted=np.zeros(len(rows)),
        ride=ride.astype(np.int64),
        vehicle=pd.factorize(rows["vehicle_id"])[0].astype(np.int64),
        date=pd.factorize(pd.Series(get_names(rows, "date")), sort=True)[0].astype(np.int64),
        day=assign_vehicle_days(rows),
        left_out={},
    )


def _around(
    change: TermAddition,
    added: tuple[Term, ...],
    rows: pd.DataFrame,
    estimates: Sequence[Mapping[str, Estimate]],
    *,
    covariance: bool,
) -> LinearModel:
    """Return a model whose last coefficients are given, and whose other coefficients are fitted around them."""
    kinds = np.array(get_names(rows, VEHICLE_MODEL), dtype=object)
    columns = build_design(added, Columns(rows), len(rows))
    value = np.array(
        [[of_effect.get(kind, of_effect[ANY]).value for of_effect in estimates] for kind in kinds]
    ).reshape(columns.shape)
    common = np.array([of_effect[ANY].value for of_effect in estimates])
    made = refit(change, _less(rows, (value * columns).sum(axis=1)), covariance=covariance)
    if (value != common).any():
        every = refit(change, _less(rows, columns @ common), covariance=covariance)
        made = msgspec.structs.replace(made, fits={**made.fits, ANY: every.fits[ANY]})
    fits = {}
    for key, fit in made.fits.items():
        at = np.flatnonzero(kinds == key) if key != ANY else np.arange(len(rows))
        fits[key] = _with(
            change.base,
            fit,
            [of_effect.get(key, of_effect[ANY]) for of_effect in estimates],
            rows.iloc[at],
            columns[at],
        )
    return msgspec.structs.replace(made, terms=(*change.base, *added), fits=fits)


def _less(rows: pd.DataFrame, energy: Floats) -> pd.DataFrame:
    """Return rows with an energy subtracted from the measured energy."""
    return rows.assign(**{ENERGY: get_numbers(rows, ENERGY) - energy})


def _estimates(
    base: BaseProjection, terms: tuple[Term, ...], within: NDArray[np.bool_] | None = None
) -> list[dict[str, Estimate]]:
    """Return the coefficients of terms beside each other, each by vehicle model (`*` for all), fitted to some rows."""
    rows = base.windows.table
    at = np.flatnonzero(np.ones(len(rows), np.bool_) if within is None else within)
    columns = build_design(terms, Columns(rows), len(rows))
    left, size = base.project_out(columns), (base.apply_weights(columns) ** 2).sum(axis=0)
    return [_estimate(base, left, place, float(size[place]), at) for place in range(len(terms))]


def _estimate(base: BaseProjection, left: Floats, place: int, size: float, rows: Rows) -> dict[str, Estimate]:
    """Return the coefficient of one of several columns by vehicle model."""
    common = _alone(base, left, place, rows)
    if common is None or float((left[:, place] ** 2).sum()) <= LEAST_LEFT * size:
        return {ANY: Estimate(0.0, nan, 0.0)}
    by_kind = {kind: _alone(base, left, place, np.intersect1d(at, rows)) for kind, at in base.kinds.items()}
    return _pooled(common, {key: each for key, each in by_kind.items() if each and each.freedom >= LEAST_FREEDOM})


def _alone(base: BaseProjection, left: Floats, place: int, at: Rows) -> Estimate | None:
    """Return the coefficient of a column beside the others from some rows, None where it is not identifiable."""
    if not len(at):
        return None
    column, residual = _off(np.delete(left[at], place, axis=1), left[at, place], base.residual[at])
    size = float(column @ column)
    if size <= LEAST_LEFT * float(left[:, place] @ left[:, place]):
        return None
    clusters = [ClusterSums(code[at]) for code in (base.windows.day, base.windows.date)]
    evidence = compute_worst_case_evidence(residual, column[:, np.newaxis], np.zeros(1, dtype=np.int64), clusters)
    found = evidence.get_estimate(0)
    alone = sqrt(float(np.mean((residual - found.value * column) ** 2)) / size)  # the error, were windows independent
    return found._replace(error=max(found.error, alone))


def _off(others: Floats, *columns: Floats) -> list[Floats]:
    """Return columns projected off others."""
    basis = orthonormalise(others) if others.shape[1] else others
    return [column - basis @ (basis.T @ column) for column in columns]


def project_plain(change: TermAddition, rows: pd.DataFrame) -> tuple[LinearModel, BaseProjection]:
    """Return the original terms of a model fitted to rows, and the projection off them."""
    with limit_to_one_thread():
        plain = refit(change, rows)
        return plain, BaseProjection(convert_to_windows(rows), plain)


def predict_with_effects_held_out(
    change: TermAddition, plain: LinearModel, base: BaseProjection, folds: Sequence[NDArray[np.bool_]]
) -> tuple[Floats, Floats]:
    """Return predictions for which only the coefficients of effects are fitted without the predicted rows.

    Parameters
    ----------
    plain, base : LinearModel, BaseProjection
        Fit of the original terms to n windows or rides, and the projection off them, from `project_plain`.

    Returns
    -------
    before, after : (n,) float
        Predictions without and with the term; NaN for rows that are in no fold. [kWh]
    """
    terms, rows = (*change.effects, change.added), base.windows.table
    before, after = (np.full(len(rows), np.nan) for _ in range(2))
    with limit_to_one_thread():
        for fold in folds:
            estimates = _estimates(base, terms, ~fold)
            known = plain
            if change.effects:
                of_effects = _estimates(base, change.effects, ~fold)
                known = _around(change, change.effects, rows, of_effects, covariance=False)
            before[fold] = known.predict_energy(rows.loc[fold])
            after[fold] = _around(change, terms, rows, estimates, covariance=False).predict_energy(rows.loc[fold])
    return before, after


class AdditionEvidence(NamedTuple):
    """Hold the evidence for a term.

    Parameters
    ----------
    p : float
        Probability of this evidence or more without the term, with the sign that physics demands. [1]
    gain : Estimate
        On rides of vehicle-days to which the coefficient was not fitted; its interval is NaN where there are none.
    """

    p: float
    gain: Estimate


def assess_addition(
    change: TermAddition, base: BaseProjection, *, sign: int, limits: tuple[float, float], seed: int
) -> AdditionEvidence:
    """Return the p-value and the held-out gain, in rows, of a term that a model lacks."""
    windows = base.windows
    rows = windows.table
    with limit_to_one_thread():
        columns = build_design((*change.effects, change.added), Columns(rows), len(rows))
        left = base.project_out(columns)
        column, residual = _off(left[:, :-1], left[:, -1], base.residual)
    clusters = [ClusterSums(windows.day), ClusterSums(windows.date)]
    if clusters[0].count < 2 or not column.any():
        return AdditionEvidence(1.0, Estimate(0.0, nan, 0.0))
    worth = compute_least_coefficients(columns[:, -1:], windows.measured)
    evidence = compute_worst_case_evidence(residual, column[:, np.newaxis], np.array([sign]), clusters, worth)
    gain = compute_held_out_gain(base, column, residual, limits, clusters[0], seed)
    return AdditionEvidence(float(evidence.p[0]), gain)


def _pooled(common: Estimate, by_kind: dict[str, Estimate]) -> dict[str, Estimate]:
    """Return the common coefficient, and for vehicle models that differ by more than chance their own, shrunk to it."""
    if len(by_kind) < 2:
        return {ANY: common}
    value, variance = np.array([(e.value, e.error**2) for e in by_kind.values()]).T
    between = estimate_variance_between(value, 1.0 / variance)
    if between == 0.0:
        return {ANY: common}
    weight = 1.0 / (variance + between)
    mean = float(weight @ value / weight.sum())
    freedom = min(e.freedom for e in by_kind.values())
    pooled = {ANY: Estimate(mean, float(1.0 / np.sqrt(weight.sum())), max(len(by_kind) - 1.0, freedom))}
    for kind, each in by_kind.items():
        share = between / (between + each.error**2)
        pooled[kind] = Estimate(mean + share * (each.value - mean), float(np.sqrt(share)) * each.error, each.freedom)
    return pooled


def _with(terms: tuple[Term, ...], fit: Fit, added: Sequence[Estimate], rows: pd.DataFrame, columns: Floats) -> Fit:
    """Return a fit extended by the coefficients that were subtracted from its energy, with its covariance."""
    covariance: Any = None
    if fit.covariance is not None:
        table = build_design(terms, Columns(rows, fit.fills, fit.curve), len(rows))
        moved = -np.linalg.lstsq(table, columns, rcond=1e-9)[0]
        change = np.vstack([moved, np.eye(len(added))])
        whole = np.pad(np.array(fit.covariance), (0, len(added)))
        whole += change * np.array([np.nan_to_num(each.error) ** 2 for each in added]) @ change.T
        covariance = tuple(tuple(row) for row in whole.tolist())
    values = tuple(each.value for each in added)
    return msgspec.structs.replace(fit, coefficients=(*fit.coefficients, *values), covariance=covariance)
