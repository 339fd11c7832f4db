"""Fit terms to a ride table in passes over its blocks: for each vehicle model, and for all rides together.

The first pass reads and converts the table, and keeps the converted rides for the other passes in a temporary file. It
determines the fills and the accessory curve, the latter by least squares in the model that contains it.
Where all coefficients are 1, the curve explains the residual of the basic physical model. Where coefficients are
fitted, the curve is fitted together with the coefficients of the road load. A curve fitted to the residual alone would
take the error of the road load for standby power, and would bias the coefficients.

The second pass sums the normal equations. The third pass sums the residuals for the covariance. No pass keeps more than
one block, so memory does not grow with the number of rides.

Rides do not determine some physical terms. An example is the kinetic energy of a ride that begins and ends at rest: it
is zero except for gaps, but it differs from zero in the middle of a ride. Such a term is one whose standard deviation
is below `_RESOLUTION` of that of the energy. One additional observation with the standard uncertainty `_PRIOR_SD` holds
its coefficient near the physical value 1. The coefficient of an interaction is held near 0, and the uncertainty is then
`_PRIOR_SD` over the size of the other columns of the product. All other coefficients are ordinary least squares.

A column that does not vary has no coefficient, and neither has an interaction whose column is nothing but the rounding
of the energies that it sums. Such terms are dropped, and the fit names them.

Coefficients of gained and lost altitude satisfy one constraint: a mean ride that gains as much as it loses takes no
less than on a level road. Least squares alone may regain more downhill than it spends uphill.

The covariance admits that the errors of rides of one vehicle on one day depend on each other. It treats the accessory
curve as fitted together with the coefficients. The variance of the accessories' own coefficient holds for the given
shape of the curve.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from hashlib import sha256
from math import prod
from typing import Any, Final, Protocol

import numpy as np
from msgspec import UNSET

from socast.core.batch import Floats
from socast.core.effects import ROAD_LOAD
from socast.core.errors import ModelError
from socast.core.fit.accessory_curve import CURVE_NUMBERS
from socast.core.fit.block_sums import (
    BLOCKS_OF_TASK,
    BlockFile,
    BlockFunction,
    FitContext,
    GroupContext,
    GroupSurvey,
    PassRunner,
    TrainableRides,
    convert_blocks,
    limit_to_one_thread,
    sum_blocks,
    sum_moments,
    sum_residuals,
    survey_block,
)
from socast.core.fit.records import FitStep
from socast.core.fit.regression import LEAST_GROUPS, NO_VARIATION, ClusterScores, Influence, Moments, Solution, solve
from socast.core.fit.ride_blocks import ENERGY, RideSource, ThinnedRides, word_too_few_rides
from socast.core.models import ANY, BASIC_PHYSICAL, VEHICLE_MODEL, Fit, LinearModel, Term, Training, stamp
from socast.core.models.features import (
    ACCESSORIES_COLUMN,
    ACCESSORY_NEEDS,
    DERIVED_COLUMNS,
    EFFECT_PREFIX,
    FEATURES,
    list_raw_columns,
)
from socast.core.models.limit import LIMIT_NEEDS, EnergyLimit
from socast.core.vehicles import AccessoryCurve
from socast.core.vehicles.fleet import CarParameters

_RIDES_PER_COEFFICIENT: Final = 2
"""Fewest rides for each coefficient of a fit."""
_RESOLUTION: Final = 0.01
_PRIOR_SD: Final = 0.5
ROUNDING: Final = 1e-9
"""Size of an energy over that of the measured one, below which it is rounding: sums of kinetic energies leave 1e-16."""
_ALTITUDES: Final = ("gained_m", "lost_m")
PHYSICS: Final = (*(effect.energy_name for effect in ROAD_LOAD), ACCESSORIES_COLUMN)
"""First columns of the terms whose dimensionless coefficient is 1 where physics holds."""


class FitPlan(Protocol):
    """Describe what to fit, see `socast.core.fit.recipes.LinearRecipe`."""

    @property
    def name(self) -> str:
        """Return the name of the recipe."""

    @property
    def terms(self) -> tuple[Term, ...]:
        """Return the terms, in the order of the model."""

    @property
    def free(self) -> bool:
        """Return whether the coefficients are fitted; otherwise each is 1."""


@dataclass
class _GroupFit:
    """Collect the sums and results of the rides of one vehicle model, or of all rides.

    Parameters
    ----------
    fills, sizes : dict of str to float
        Mean and root mean square of each column that is filled; 0 and 1 where it is unknown in all rides.
    """

    survey: GroupSurvey
    fills: dict[str, float]
    sizes: dict[str, float]
    curve: AccessoryCurve | None
    moments: Moments = field(default_factory=lambda: Moments(0))
    solution: Solution | None = None
    influence: Influence | None = None
    held: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    scores: ClusterScores | None = None
    absolute: float = 0.0
    squared: float = 0.0


def fit_terms(
    plan: FitPlan, rides: RideSource, *, covariance: bool = True, run: PassRunner | None = None
) -> LinearModel:
    """Return the model of a plan, fitted to a ride table.

    Parameters
    ----------
    covariance : bool
        Compute the covariance and the in-sample error in another pass over the rides. A fit without it is faster.
    run : callable, optional
        Runs the tasks of each pass elsewhere, with the same result; each pass then reads the table.

    Returns
    -------
    LinearModel
        Model with a fit for each vehicle model that has enough rides, and the fit `*` over all rides together.
    """
    fitting = _Fitting(plan, rides, covariance=covariance, run=run)
    with limit_to_one_thread(), closing(fitting.kept):
        fitting.survey()
        fitting.solve()
        if covariance:
            fitting.residuals()
        return fitting.model()


class _Fitting:
    """Run the passes over the blocks, and keep their results."""

    def __init__(self, plan: FitPlan, rides: RideSource, *, covariance: bool, run: PassRunner | None) -> None:
        self.plan, self.rides, self.run = plan, rides, run
        read = dict.fromkeys(column for term in plan.terms for column in term.columns)
        curved = ACCESSORIES_COLUMN in read
        raw = dict.fromkeys(name for column in read for name in list_raw_columns(column))
        basic = BASIC_PHYSICAL.needs if curved else ()
        filled = dict.fromkeys((*read, *(ACCESSORY_NEEDS if curved else ())))
        place = next((i for i, term in enumerate(plan.terms) if not term.columns), None)
        sloped = [i for i in range(len(plan.terms)) if i != place]
        self.order = sloped if place is None else [*sloped, place]
        self.context = FitContext(
            terms=tuple(plan.terms[i] for i in sloped),
            columns=tuple(dict.fromkeys((*raw, *basic, *LIMIT_NEEDS, ENERGY))),
            filled=tuple(
                c for c in filled if (c in FEATURES and c not in CarParameters._fields) or c in DERIVED_COLUMNS
            ),
            road=tuple(t for t in plan.terms if plan.free and t.columns and t.columns[0].startswith(EFFECT_PREFIX)),
            curved=curved,
            covariance=covariance,
            constant=place is not None,
        )
        self.kept = BlockFile((*raw, ENERGY))
        self.surveys: dict[str, GroupSurvey] = {}
        self.groups: dict[str, _GroupFit] = {}
        self.only: str | None = None
        self.left_out: Counter[str] = Counter()
        self.dates: list[str] = []
        self.digests = {name: sha256() for name in (*self.context.columns, VEHICLE_MODEL)}

    def survey(self) -> None:
        """Pass over the rides for the fills, the accessory curves and the description of the training."""
        for survey in self._pass_over("survey", survey_block):
            self.left_out.update(survey.left_out)
            self.dates += survey.dates
            for name, content in survey.content.items():
                self.digests[name].update(content)
            for key, own in survey.groups.items():
                if key in self.surveys:
                    self.surveys[key].add(own)
                else:
                    self.surveys[key] = own
        fitted = len(self.plan.terms) if self.plan.free else CURVE_NUMBERS if self.context.curved else 1
        least, rides = _RIDES_PER_COEFFICIENT * fitted, self.surveys[ANY].rides if self.surveys else 0
        if rides < least:
            raise ModelError(word_too_few_rides(self.plan.name, rides, least, self.left_out))
        # with one vehicle model, its fit equals that of all rides
        self.only = next((key for key, own in self.surveys.items() if own.rides == rides and key != ANY), None)
        for key, own in self.surveys.items():
            if own.rides >= least and key != self.only:
                known = np.maximum(own.known, 1)
                sizes = np.where(own.known > 0, np.sqrt(own.squares / known), 1.0)
                fills = dict(zip(self.context.filled, (own.sums / known).tolist(), strict=True))
                curve = own.temperatures.fit() if self.context.curved else None
                self.groups[key] = _GroupFit(own, fills, dict(zip(fills, sizes.tolist(), strict=True)), curve)

    def solve(self) -> None:
        """Pass over the rides for the normal equations, and solve them."""
        if not self.plan.free:
            return
        for moments in self._pass_over("moments", sum_moments):
            for key, own in moments.items():
                group = self.groups[key]
                if not group.moments.rows:
                    group.moments = Moments(len(own.mean))
                group.moments.merge(own)
        self._check_varies()
        for group in self.groups.values():
            self._solve(group)

    def residuals(self) -> None:
        """Pass over the rides for the residuals of the fits."""
        for residuals in self._pass_over("residuals", sum_residuals):
            for key, own in residuals.items():
                group = self.groups[key]
                group.absolute += own.absolute
                group.squared += own.squared
                if own.scores is not None:
                    group.scores = group.scores or ClusterScores(own.scores.sums.shape[1])
                    group.scores.add(own.scores)

    def model(self) -> LinearModel:
        """Return the model that the passes have determined."""
        every = self.surveys[ANY]
        digest = sha256()
        for name, part in sorted(self.digests.items()):
            digest.update(name.encode() + part.digest())
        filled = zip(self.context.filled, (every.rides - every.known).tolist(), strict=True)
        training = Training(
            rides=every.rides,
            first_date=min(self.dates, default=""),
            last_date=max(self.dates, default=""),
            vehicle_models={key: own.rides for key, own in sorted(self.surveys.items()) if key != ANY},
            fingerprint=digest.hexdigest(),
            filled={name: unknown for name, unknown in filled if unknown},
            left_out=dict(sorted(self.left_out.items())),
        )
        errors = {key: own.absolute / own.survey.rides for key, own in sorted(self.groups.items()) if own.absolute}
        fits = {key: self._fit(group) for key, group in sorted(self.groups.items())}
        if self.only is not None:
            fits[self.only] = fits[ANY]
            errors |= {self.only: errors[ANY]} if errors else {}
        step = FitStep(action="fit", recipe=self.plan.name, mae_in_sample_kwh=errors)
        model = LinearModel(
            name=self.plan.name,
            version="",
            recipe=self.plan.name,
            terms=self.plan.terms,
            fits=fits,
            training=training,
            history=(step.to_json(),) if errors else (),
        )
        return stamp(model)

    def _pass_over(self, stage: str, function: BlockFunction) -> Iterator[Any]:
        """Yield the parts of a pass in the order of the blocks; the first one keeps the rides for the others."""
        context = replace(self.context, groups={key: self._describe(group) for key, group in self.groups.items()})
        if self.run is not None:
            tasks = [(context, function, part) for part in self.rides.divide(BLOCKS_OF_TASK)]
            for sums in self.run(stage, sum_blocks, tasks):
                if isinstance(self.rides, ThinnedRides):
                    self.rides.kept += sums.kept
                yield from sums.parts
        elif function is survey_block:
            for block in convert_blocks(context, self.rides):
                yield function(context, block)
                if block.table:
                    self.kept.append(block.table)
        else:
            yield from (function(context, TrainableRides(table, Counter())) for table in self.kept)

    @staticmethod
    def _describe(group: _GroupFit) -> GroupContext:
        """Return what the next pass needs to know of a group."""
        if group.solution is None:
            return GroupContext(group.fills, group.curve)
        coefficients, constant = group.solution.coefficients, group.solution.constant or 0.0
        return GroupContext(group.fills, group.curve, coefficients, constant, group.influence)

    def _check_varies(self) -> None:
        """Raise ModelError if all rides are alike."""
        moments = self.groups[ANY].moments
        size = np.sqrt(np.diag(moments.sums(centred=False)))
        varies = np.sqrt(np.maximum(np.diag(moments.scatter), 0.0)) > NO_VARIATION * size
        if not varies[: len(self.context.terms)].any():
            raise ModelError(f"recipe {self.plan.name}: all {moments.rows:,} rides are alike: nothing can be learned")
        if not varies[-1]:
            raise ModelError(
                f"recipe {self.plan.name}: {ENERGY} is {moments.mean[-1]:g} in all {moments.rows:,} rides: "
                "nothing can be learned"
            )

    def _solve(self, group: _GroupFit) -> None:
        """Solve a group's normal equations, and hold coefficients near physics that the rides do not determine."""
        constant, terms = self.context.constant, self.context.terms
        empty = self._find_empty(group)
        group.moments.clear(empty)
        group.dropped = tuple(terms[i].name for i in empty)
        moments = group.moments.only([*range(len(terms)), -1])
        hills = self._build_hills(group)
        solution = solve(moments, constant=constant, least=hills)
        weight, toward, group.held = self._make_prior(group, moments, solution)
        if group.held:
            solution = solve(moments, constant=constant, weight=weight, toward=toward, least=hills)
        group.solution = solution
        if self.context.covariance:
            beside = next((i for i, term in enumerate(terms) if term.columns == (ACCESSORIES_COLUMN,)), None)
            group.influence = Influence(group.moments, solution, beside)

    def _find_empty(self, group: _GroupFit) -> list[int]:
        """Return the positions of the terms whose column is constant or nothing but rounding, except physical ones."""
        size, root = self._measure_columns(group.moments), np.sqrt(group.moments.rows)
        empty = []
        for i, term in enumerate(self.context.terms):
            least = NO_VARIATION * np.hypot(size[i], root * group.moments.mean[i])
            for main in self._physical:
                if (by := self._measure_factors(group, term, main)) is not None:
                    least = max(least, ROUNDING * by * size[-1])
            if term not in self._physical and size[i] <= least:
                empty.append(i)
        return empty

    def _make_prior(self, group: _GroupFit, moments: Moments, free: Solution) -> tuple[Floats, Floats, tuple[str, ...]]:
        """Return the weights, the targets and the names of the coefficients that the rides do not determine."""
        size = self._measure_columns(moments)
        weight, toward, held = np.zeros(len(size) - 1), np.zeros(len(size) - 1), []
        least = max(free.variance, 1e-9 * size[-1] ** 2 / moments.rows) if free.freedom > 0 else size[-1] ** 2
        terms = self.context.terms
        for main in self._physical:
            of_main = size[terms.index(main)]
            for i, term in enumerate(terms):
                by = self._measure_factors(group, term, main)
                if by is None or by == 0.0 or term.name in group.dropped:
                    continue
                if min(of_main, size[i] / by) < _RESOLUTION * size[-1]:
                    weight[i], toward[i] = least * (by / _PRIOR_SD) ** 2, float(term == main)
                    held.append(term.name)
        return weight, toward, tuple(held)

    def _build_hills(self, group: _GroupFit) -> Floats | None:
        """Return what a hill, up and down, adds to each column of a mean ride, linearly and by its square; or None."""
        mean = dict(zip([term.columns for term in self.context.terms], group.moments.mean, strict=False))
        hills = np.zeros((2, len(self.context.terms)))
        for i, term in enumerate(self.context.terms):
            others = tuple(column for column in term.columns if column not in _ALTITUDES)
            power = len(term.columns) - len(others)
            if power and "effect_climbing" not in others and term.name not in group.dropped:
                by = mean.get(others) if others else 1.0
                hills[min(power, 2) - 1, i] = prod(group.fills.get(c, 1.0) for c in others) if by is None else by
        hills = hills[hills.any(axis=1)]
        return hills if len(hills) else None

    def _measure_columns(self, moments: Moments) -> Floats:
        """Return the root of the sum of squares of each column, about its mean where there is a constant."""
        return np.sqrt(np.maximum(np.diag(moments.sums(centred=self.context.constant)), 0.0))

    @property
    def _physical(self) -> list[Term]:
        """Return the terms whose coefficient is 1 where physics holds."""
        return [term for term in self.context.terms if term.unit == "1" and term.columns[0] in PHYSICS]

    @staticmethod
    def _measure_factors(group: _GroupFit, term: Term, main: Term) -> float | None:
        """Return the size of what a term multiplies a physical term by, None where it is no product with this term."""
        others = len(term.columns) - len(main.columns)
        if term.columns[others:] != main.columns:
            return None
        return prod(group.sizes.get(c, 1.0) for c in term.columns[:others])

    def _fit(self, group: _GroupFit) -> Fit:
        """Return the fit of a group as a model file stores it."""
        solution, influence, scores = group.solution, group.influence, group.scores
        values, covariance = np.ones(len(self.order)), None
        squared, freedom = group.squared, group.survey.rides
        if solution is not None:
            squared, freedom = solution.residual, solution.freedom
            values[self.order] = [*solution.coefficients, *([solution.constant] if self.context.constant else [])]
        robust = scores is not None and scores.groups >= LEAST_GROUPS
        if influence is not None:
            found = influence.robust(scores) if robust and scores else influence.classical()
            covariance = np.empty_like(found)
            covariance[np.ix_(self.order, self.order)] = found
        return Fit(
            coefficients=tuple(values.tolist()),
            covariance=None if covariance is None else tuple(map(tuple, covariance.tolist())),
            clusters=scores.groups if robust and scores else None,
            fills=group.fills,
            curve=group.curve,
            rides=group.survey.rides,
            residual_sd_kwh=float(np.sqrt(squared / freedom)) if freedom > 0 and squared else None,
            held=group.held,
            dropped=group.dropped or UNSET,
            limit=EnergyLimit.of_training(*group.survey.taken.tolist()) or UNSET,
        )
