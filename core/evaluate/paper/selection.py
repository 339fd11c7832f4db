"""Find the terms of the hybrid model that can be removed, section 5.2 of the paper.

Recursive elimination ranks the terms: fit, remove the term of smallest standardised coefficient, fit again. RFECV keeps
as many terms as give the least cross-validated error. RFE goes further: it removes terms in that order as long as the
difference score does not find the model worse than the full one.

On few rides hardly any loss is significant, so RFE removes nearly all terms, rolling resistance among them. Beyond the
paper, elimination with a margin therefore asks for evidence that a removal costs little: it removes terms as long as
the one-sided 95 % interval of the loss lies below a share of the error of the full model. It takes the terms in the
same order, those of physics last.

Half of the rides rank the terms. The other half measures the cost of removing them, so no term is chosen and evaluated
on the same rides. Columns are standardised, and fitted for each vehicle model separately, as in the hybrid model. The
rank of a term follows from the root mean square of its coefficients over vehicle models, weighted by their rides.
Collinear terms share what they explain (`socast.core.fit.regression`), so each of them appears weaker than it is, and
one of them can always be removed.

References
----------
Guyon, Weston, Barnhill and Vapnik, Machine Learning 46 (2002) 389, DOI 10.1023/A:1012487302797.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.feature_selection import RFE, RFECV
from sklearn.model_selection import KFold

from socast.core.batch import Floats
from socast.core.evaluate.paper.records import EliminationStep, RemovableTerms, RemovalLoss, TermElimination, TermScore
from socast.core.evaluate.ride_filter import EvaluatedRides
from socast.core.fit.block_sums import build_design
from socast.core.fit.fitting import ROUNDING
from socast.core.fit.recipes import LinearRecipe
from socast.core.fit.regression import Moments, solve
from socast.core.models import ANY, Term
from socast.core.models.features import ACCESSORIES_COLUMN, EFFECT_PREFIX, Columns
from socast.core.stats.multiple_testing import SIGNIFICANCE
from socast.core.stats.scores import Codes, Estimate, average_over_repeats
from socast.core.stats.splits import Positions, Split, split_by_ride

RECIPE: Final = "hybrid_full"
"""Recipe with every term; `hybrid` lacks those that the paper removed."""
MOST_RIDES: Final = 20_000
"""Largest number of rides used; of more, a random sample is drawn."""
RIDES_PER_TERM: Final = 10
"""Rides for each term that a vehicle model needs in either half to take part."""
FOLDS: Final = 5
"""Number of folds of the cross-validation."""
REPEATS: Final = 10
"""Number of splits of the half that measures the cost."""
MARGIN: Final = 0.01
"""Largest loss of elimination with a margin, over the error of the full model. [1]"""
KEPT_IMPORTANCE: Final = 1e100
"""Importance of a column that must not be eliminated."""


class VehicleModelRegression(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Fit least squares with a constant, for each vehicle model separately.

    The first column is the position of the vehicle model; its importance is `KEPT_IMPORTANCE`, so elimination keeps it.
    """

    def fit(self, x: Floats, y: Floats) -> Self:
        """Fit the columns after the first, (n, 1 + p), to (n,) energies."""
        self.coefficients_: dict[int, tuple[Floats, float]] = {}
        squares = np.zeros(x.shape[1] - 1)
        for model in np.unique(x[:, 0]):
            of_model = x[:, 0] == model
            solution = solve(Moments.of(np.column_stack([x[of_model, 1:], y[of_model]])), constant=True)
            self.coefficients_[int(model)] = (solution.coefficients, solution.constant or 0.0)
            squares += np.sum(of_model) * solution.coefficients**2
        self.importance_ = np.append(KEPT_IMPORTANCE, np.sqrt(squares / len(x)))
        return self

    def predict(self, x: Floats) -> Floats:
        """Return energies; NaN for a vehicle model that was not fitted. [kWh]"""
        predicted = np.full(len(x), np.nan)
        for model, (coefficients, constant) in self.coefficients_.items():
            of_model = x[:, 0] == model
            predicted[of_model] = x[of_model, 1:] @ coefficients + constant
        return predicted


class Design(NamedTuple):
    """Hold rides as a linear model reads them.

    Parameters
    ----------
    table : (n, 1 + p) float
        Position of the vehicle model, and the terms, standardised within it.
    energy : (n,) float
        Measured energy. [kWh]
    """

    table: Floats
    energy: Floats
    strata: list[tuple[str, int]]

    def part(self, rows: Positions) -> "Design":
        """Return the design of some rides."""
        return Design(self.table[rows], self.energy[rows], [self.strata[i] for i in rows.tolist()])


def plan_selection(
    evaluated: EvaluatedRides, recipes: Mapping[str, Any], seed: int, margin: float = MARGIN
) -> dict[str, Callable[[], Any]]:
    """Return the call that finds removable terms, by recipe; empty where the recipe is not evaluated."""
    recipe = recipes.get(RECIPE)
    if not isinstance(recipe, LinearRecipe):
        return {}
    return {RECIPE: partial(find_removable_terms, recipe, evaluated, seed, margin)}


def find_removable_terms(
    recipe: LinearRecipe, evaluated: EvaluatedRides, seed: int, margin: float = MARGIN
) -> RemovableTerms:
    """Return the terms that can be removed from a recipe.

    Parameters
    ----------
    margin : float
        Largest loss of elimination with a margin, over the error of the full model. [1]
    """
    terms = tuple(term for term in recipe.terms if term.columns)
    rides, halves = _halves(evaluated, len(terms), seed)
    if not len(rides):
        return RemovableTerms()
    whole = _design(recipe, terms, evaluated, rides, halves)
    varies = np.ptp(whole.table[:, 1:], axis=0) > 0.0
    whole = whole._replace(table=whole.table[:, np.append(True, varies)])
    names = np.array([term.name for term in terms])
    physical = np.array([term.columns[0].startswith((EFFECT_PREFIX, ACCESSORIES_COLUMN)) for term in terms])[varies]
    order, cut, scores = rank_terms(whole.part(halves.train), seed)
    varying = names[varies]
    last = order[np.argsort(physical[order], kind="stable")]
    # the cost is measured on the rides that did not rank the terms
    error, (price, *steps) = compute_losses(whole.part(halves.test), [cut, *_nest(order), *_nest(last)], seed)
    by_order, by_margin = steps[: len(order)], steps[len(order) :]
    worse = [loss.value > 0.0 and loss.p < SIGNIFICANCE for loss in by_order]
    too_much = [not loss.upper95 <= margin * error for loss in by_margin]
    return RemovableTerms(
        constant=names[~varies].tolist(),
        rfecv=TermElimination(removed=varying[cut].tolist(), scores=scores, loss=_hold_loss(price)),
        rfe=TermElimination(**_tabulate_steps(varying[order], by_order, worse)),
        margin=TermElimination(
            share=margin, largest=margin * error, error=error, **_tabulate_steps(varying[last], by_margin, too_much)
        ),
    )


def rank_terms(rides: Design, seed: int) -> tuple[Codes, Codes, list[TermScore]]:
    """Return the order of elimination, the terms that cross-validation cuts, and its error by number of terms."""
    options: dict[str, Any] = {"importance_getter": "importance_"}
    order = RFE(VehicleModelRegression(), n_features_to_select=2, **options).fit(rides.table, rides.energy)
    folds = KFold(FOLDS, shuffle=True, random_state=seed)
    score = "neg_mean_absolute_error"
    tried = RFECV(VehicleModelRegression(), cv=folds, scoring=score, min_features_to_select=2, **options)
    tried.fit(rides.table, rides.energy)
    results = tried.cv_results_
    eliminated = np.argsort(-order.ranking_[1:], kind="stable")[: rides.table.shape[1] - 2]
    pairs = zip(results["n_features"], results["mean_test_score"], strict=True)
    scores = [TermScore(terms=int(n) - 1, mae=-float(mean)) for n, mean in pairs]
    return eliminated, np.flatnonzero(~tried.support_[1:]), scores


def _nest(order: Codes) -> list[Codes]:
    """Return the terms that are gone after each step."""
    return [order[: i + 1] for i in range(len(order))]


def _tabulate_steps(names: NDArray[np.str_], steps: Sequence[Estimate], refused: Sequence[bool]) -> dict[str, Any]:
    """Return the fields of a `TermElimination` that ends before the first refused step."""
    gone = next((i for i, applies in enumerate(refused) if applies), len(steps))
    return {
        "removed": names[:gone].tolist(),
        "loss": _hold_loss(steps[gone - 1]) if gone else None,
        "steps": [
            EliminationStep(term=str(name), loss=_hold_loss(loss)) for name, loss in zip(names, steps, strict=True)
        ],
    }


def compute_losses(design: Design, removed: Sequence[Codes], seed: int) -> tuple[float, list[Estimate]]:
    """Return the error of the full model, and its increase when terms are removed, over splits of these rides. [kWh]"""
    p = design.table.shape[1] - 1
    kept = [np.arange(p), *(np.setdiff1d(np.arange(p), gone) for gone in removed)]
    splits = split_by_ride(design.strata, seed, REPEATS)
    errors = np.array([_errors(design, kept, split) for split in splits])  # (repeats, sets of terms)
    overlap = float(np.mean([len(s.test) / len(s.train) for s in splits]))
    losses = [average_over_repeats(errors[:, i] - errors[:, 0], overlap) for i in range(1, len(kept))]
    return float(errors[:, 0].mean()), losses


def _errors(design: Design, kept: Sequence[Codes], split: Split) -> Floats:
    """Return the mean absolute error with each set of terms; all sets share one sum of the normal equations."""
    errors = np.zeros(len(kept))
    train, test = design.part(split.train), design.part(split.test)
    for model in np.unique(train.table[:, 0]):
        of_model, tested = train.table[:, 0] == model, test.table[:, 0] == model
        moments = Moments.of(np.column_stack([train.table[of_model, 1:], train.energy[of_model]]))
        for i, columns in enumerate(kept):
            solution = solve(moments.only([*columns.tolist(), -1]), constant=True)
            predicted = test.table[tested][:, 1 + columns] @ solution.coefficients + (solution.constant or 0.0)
            errors[i] += float(np.sum(np.abs(predicted - test.energy[tested])))
    return errors / len(test.energy)


def _halves(evaluated: EvaluatedRides, terms: int, seed: int) -> tuple[Positions, Split]:
    """Return the rides that take part, with the half that ranks (`train`) and the half that measures (`test`)."""
    enough = np.bincount(evaluated.model) >= 2 * RIDES_PER_TERM * terms
    rides = np.flatnonzero(enough[evaluated.model])
    rides = np.sort(np.random.default_rng(seed).permutation(rides)[:MOST_RIDES])
    strata = [(evaluated.vehicle_models[evaluated.model[i]], int(evaluated.cluster[i])) for i in rides.tolist()]
    return rides, split_by_ride(strata, seed, repeats=1, test_share=0.5)[0]


def _design(
    recipe: LinearRecipe, terms: tuple[Term, ...], evaluated: EvaluatedRides, rides: Positions, halves: Split
) -> Design:
    """Return rides as the recipe's fit to the ranking half reads them."""
    table = evaluated.rides.iloc[rides]
    fits = recipe.fit(table.iloc[halves.train]).fits
    model = evaluated.model[rides]
    ranks = np.isin(np.arange(len(rides)), halves.train)
    columns, energies = np.empty((len(rides), len(terms))), np.array([term.unit == "1" for term in terms])
    for code in np.unique(model).tolist():
        of_model = np.flatnonzero(model == code)
        name = evaluated.vehicle_models[code]
        fit = fits.get(name, fits[ANY])
        of: Any = table.iloc[of_model]
        used = evaluated.energy[rides[of_model]]
        part = build_design(terms, Columns(of, fit.fills, fit.curve), len(of_model))
        first = part[ranks[of_model]]
        scale = first.std(axis=0)
        varies = scale > 1e-9 * np.abs(first).max(axis=0, initial=0.0)
        varies &= (scale > ROUNDING * used[ranks[of_model]].std()) | ~energies
        columns[of_model] = np.where(varies, (part - first.mean(axis=0)) / np.where(varies, scale, 1.0), 0.0)
    strata = [(evaluated.vehicle_models[code], int(evaluated.cluster[i])) for code, i in zip(model, rides, strict=True)]
    return Design(np.column_stack([model.astype(np.float64), columns]), evaluated.energy[rides], strata)


def _hold_loss(loss: Estimate) -> RemovalLoss:
    """Return a loss as a record."""
    return RemovalLoss(value=loss.value, ci95=loss.ci95, p=loss.p, upper95=loss.upper95)
