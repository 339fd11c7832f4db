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
from dataclasses import dataclass, field
from hashlib import sha256
from math import prod, sqrt
from typing import Any, Final, Protocol

import numpy as np
from msgspec import UNSET

from socast.core.batch import Floats
from socast.core.effects import ROAD_LOAD
from socast.core.errors import ModelError
from socast.core.fit.accessory_curve import CURVE_NUMBERS, TemperatureBins
from socast.core.fit.block_file import BlockFile
from socast.core.fit.block_sums import (
    BLOCKS_OF_TASK,
    BlockFunction,
    FitContext,
    GroupContext,
    PassRunner,
    Survey,
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
from socast.core.models.derived_features import DERIVED_COLUMNS
from socast.core.models.features import ACCESSORIES_COLUMN, ACCESSORY_NEEDS, EFFECT_PREFIX, FEATURES, list_raw_columns
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
    """Collect the sums and results of the rides of one vehicle model, or of all rides."""

    rides: int = 0
    known: Counter[str] = field(default_factory=Counter)
    sums: dict[str, float] = field(default_factory=dict)
    squares: dict[str, float] = field(default_factory=dict)
    taken: Floats = field(default_factory=lambda: np.zeros(3))
    temperatures: TemperatureBins = field(default_factory=TemperatureBins)
    fills: dict[str, float] = field(default_factory=dict)
    curve: AccessoryCurve | None = None
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
        self.plan, self.run = plan, run
        self.covariance = covariance
        self.rides = rides
        self.terms = plan.terms
        read = dict.fromkeys(column for term in plan.terms for column in term.columns)
        self.curved = ACCESSORIES_COLUMN in read
        raw = dict.fromkeys(name for column in read for name in list_raw_columns(column))
        basic = BASIC_PHYSICAL.needs if self.curved else ()
        self.columns = list(dict.fromkeys((*raw, *basic, *LIMIT_NEEDS, ENERGY)))
        self.kept = BlockFile((*raw, ENERGY))
        filled = dict.fromkeys((*read, *(ACCESSORY_NEEDS if self.curved else ())))
        self.road = [t for t in plan.terms if plan.free and t.columns and t.columns[0].startswith(EFFECT_PREFIX)]
        self.filled = [c for c in filled if (c in FEATURES and c not in CarParameters._fields) or c in DERIVED_COLUMNS]
        self.place = next((i for i, term in enumerate(plan.terms) if not term.columns), None)
        self.sloped = [i for i in range(len(plan.terms)) if i != self.place]
        self.groups: dict[str, _GroupFit] = {ANY: self._make_group()}
        self.counts: dict[str, int] = {}
        self.only: str | None = None
        self.left_out: Counter[str] = Counter()
        self.dates: tuple[str, str] = ("", "")
        self.digests = {name: sha256() for name in (*self.columns, VEHICLE_MODEL)}

    def survey(self) -> None:
        """Pass over the rides for the fills, the accessory curves and the description of the training."""
        for survey in self._survey_blocks() if self.run is None else self._run_tasks("survey", survey_block):
            self._take_survey(survey)
        least = _RIDES_PER_COEFFICIENT * (len(self.terms) if self.plan.free else CURVE_NUMBERS if self.curved else 1)
        rides = self.groups[ANY].rides
        if rides < least:
            raise ModelError(word_too_few_rides(self.plan.name, rides, least, self.left_out))
        self.counts = {key: group.rides for key, group in sorted(self.groups.items()) if key != ANY}
        self.groups = {key: group for key, group in self.groups.items() if group.rides >= least}
        if max(self.counts.values(), default=0) == rides:  # with one vehicle model, its fit equals that of all rides
            self.only = self.groups.popitem()[0]
        for group in self.groups.values():
            group.fills = {c: group.sums[c] / group.known[c] if group.known[c] else 0.0 for c in self.filled}
            group.curve = group.temperatures.fit() if self.curved else None

    def solve(self) -> None:
        """Pass over the rides for the normal equations, and solve them."""
        if not self.plan.free:
            return
        for moments in self._sum_blocks("moments", sum_moments):
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
        for residuals in self._sum_blocks("residuals", sum_residuals):
            for key, own in residuals.items():
                group = self.groups[key]
                group.absolute += own.absolute
                group.squared += own.squared
                if own.scores is not None:
                    group.scores = group.scores or ClusterScores(own.scores.sums.shape[1])
                    group.scores.add(own.scores)

    def model(self) -> LinearModel:
        """Return the model that the passes have determined."""
        every = self.groups[ANY]
        digest = sha256()
        for name, part in sorted(self.digests.items()):
            digest.update(name.encode() + part.digest())
        training = Training(
            rides=every.rides,
            first_date=self.dates[0],
            last_date=self.dates[1],
            vehicle_models=self.counts,
            fingerprint=digest.hexdigest(),
            filled={c: n for c in self.filled if (n := every.rides - every.known[c])},
            left_out=dict(sorted(self.left_out.items())),
        )
        errors = {key: group.absolute / group.rides for key, group in sorted(self.groups.items()) if group.absolute}
        if self.only is not None and errors:
            errors[self.only] = errors[ANY]
        step = FitStep(action="fit", recipe=self.plan.name, mae_in_sample_kwh=errors)
        fits = {key: self._fit(group) for key, group in sorted(self.groups.items())}
        model = LinearModel(
            name=self.plan.name,
            version="",
            recipe=self.plan.name,
            terms=self.terms,
            fits=fits if self.only is None else fits | {self.only: fits[ANY]},
            training=training,
            history=(step.to_json(),) if errors else (),
        )
        return stamp(model)

    def _make_group(self) -> _GroupFit:
        """Return an empty group of rides."""
        return _GroupFit(temperatures=TemperatureBins(len(self.road)))

    def _survey_blocks(self) -> Iterator[Survey]:
        """Yield the first pass over each block, and keep the rides for the other passes."""
        context = self._make_context()
        for block in convert_blocks(context, self.rides):
            yield survey_block(context, block)
            if block.table:
                self.kept.append(block.table)

    def _sum_blocks(self, stage: str, function: BlockFunction) -> Iterator[Any]:
        """Yield the parts of a later pass in the order of the blocks."""
        if self.run is None:
            context = self._make_context()
            return (function(context, TrainableRides(table, Counter())) for table in self.kept)
        return self._run_tasks(stage, function)

    def _run_tasks(self, stage: str, function: BlockFunction) -> Iterator[Any]:
        """Yield the parts of a pass by tasks, in the order of the blocks."""
        context, run = self._make_context(), self.run
        tasks = [(context, function, part) for part in self.rides.divide(BLOCKS_OF_TASK)]
        for sums in run(stage, sum_blocks, tasks) if run else ():
            if isinstance(self.rides, ThinnedRides):
                self.rides.kept += sums.kept
            yield from sums.parts

    def _make_context(self) -> FitContext:
        """Return what the next pass needs to know."""
        return FitContext(
            tuple(self.terms[i] for i in self.sloped),
            tuple(self.columns),
            tuple(self.filled),
            tuple(self.road),
            self.curved,
            self.covariance,
            self.place is not None,
            {key: self._describe(group) for key, group in self.groups.items()},
        )

    def _describe(self, group: _GroupFit) -> GroupContext:
        """Return what the next pass needs to know of a group."""
        if group.solution is None:
            return GroupContext(group.fills, group.curve)
        coefficients, constant = self._solve_group(group)
        return GroupContext(group.fills, group.curve, coefficients, constant, group.influence)

    def _take_survey(self, survey: Survey) -> None:
        """Add a block to the fingerprint, the dates, the means that fill unknown values and the accessory curves."""
        self.left_out.update(survey.left_out)
        for name, content in survey.content.items():
            self.digests[name].update(content)
        if survey.dates:
            first, last = self.dates
            self.dates = (min(first or survey.dates[0], survey.dates[0]), max(last, survey.dates[1]))
        for key, own in survey.groups.items():
            group = self.groups.setdefault(key, self._make_group())
            group.rides += own.rides
            group.known.update(own.known)
            for name, total in own.sums.items():
                group.sums[name] = group.sums.get(name, 0.0) + total
                group.squares[name] = group.squares.get(name, 0.0) + own.squares[name]
            group.taken = group.taken + own.taken
            if own.temperatures is not None:
                group.temperatures.merge(own.temperatures)

    def _check_varies(self) -> None:
        """Raise ModelError if all rides are alike."""
        moments = self.groups[ANY].moments
        size = np.sqrt(np.diag(moments.sums(centred=False)))
        varies = np.sqrt(np.maximum(np.diag(moments.scatter), 0.0)) > NO_VARIATION * size
        if not varies[: len(self.sloped)].any():
            raise ModelError(f"recipe {self.plan.name}: all {moments.rows:,} rides are alike: nothing can be learned")
        if not varies[-1]:
            raise ModelError(
                f"recipe {self.plan.name}: {ENERGY} is {moments.mean[-1]:g} in all {moments.rows:,} rides: "
                "nothing can be learned"
            )

    def _solve(self, group: _GroupFit) -> None:
        """Solve a group's normal equations, and hold coefficients near physics that the rides do not determine."""
        constant = self.place is not None
        empty = self._find_empty(group)
        group.moments.clear(empty)
        group.dropped = tuple(self.terms[self.sloped[i]].name for i in empty)
        moments = group.moments.only([*range(len(self.sloped)), -1])
        hills = self._build_hills(group)
        solution = solve(moments, constant=constant, least=hills)
        weight, toward, group.held = self._make_prior(group, moments, solution)
        if group.held:
            solution = solve(moments, constant=constant, weight=weight, toward=toward, least=hills)
        group.solution = solution
        if self.covariance:
            terms = [self.terms[i].columns for i in self.sloped]
            beside = terms.index((ACCESSORIES_COLUMN,)) if (ACCESSORIES_COLUMN,) in terms else None
            group.influence = Influence(group.moments, solution, beside)

    def _find_empty(self, group: _GroupFit) -> list[int]:
        """Return the positions of the terms whose column is constant or nothing but rounding, except physical ones."""
        size, root = self._measure_columns(group.moments), np.sqrt(group.moments.rows)
        empty = []
        for i, term in enumerate(self._sloped_terms):
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
        terms = self._sloped_terms
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
        mean = dict(zip([term.columns for term in self._sloped_terms], group.moments.mean, strict=False))
        hills = np.zeros((2, len(self.sloped)))
        for i, term in enumerate(self._sloped_terms):
            others = tuple(column for column in term.columns if column not in _ALTITUDES)
            power = len(term.columns) - len(others)
            if power and "effect_climbing" not in others and term.name not in group.dropped:
                by = mean.get(others) if others else 1.0
                hills[min(power, 2) - 1, i] = prod(group.fills.get(c, 1.0) for c in others) if by is None else by
        hills = hills[hills.any(axis=1)]
        return hills if len(hills) else None

    def _measure_columns(self, moments: Moments) -> Floats:
        """Return the root of the sum of squares of each column, about its mean where there is a constant."""
        return np.sqrt(np.maximum(np.diag(moments.sums(centred=self.place is not None)), 0.0))

    @property
    def _sloped_terms(self) -> list[Term]:
        """Return the terms without the constant."""
        return [self.terms[i] for i in self.sloped]

    @property
    def _physical(self) -> list[Term]:
        """Return the terms whose coefficient is 1 where physics holds."""
        return [term for term in self._sloped_terms if term.unit == "1" and term.columns[0] in PHYSICS]

    @staticmethod
    def _measure_factors(group: _GroupFit, term: Term, main: Term) -> float | None:
        """Return the size of what a term multiplies a physical term by, None where it is no product with this term."""
        others = len(term.columns) - len(main.columns)
        if term.columns[others:] != main.columns:
            return None
        known, squares = group.known, group.squares
        return prod(sqrt(squares[c] / known[c]) if known.get(c) else 1.0 for c in term.columns[:others])

    def _solve_group(self, group: _GroupFit) -> tuple[Floats, float]:
        """Return the coefficients and the constant of a group."""
        if group.solution is None:
            return np.ones(len(self.sloped)), 0.0
        return group.solution.coefficients, group.solution.constant or 0.0

    def _fit(self, group: _GroupFit) -> Fit:
        """Return the fit of a group as a model file stores it."""
        solution, influence, scores = group.solution, group.influence, group.scores
        coefficients, constant = self._solve_group(group)
        values = np.empty(len(self.terms))
        values[self._order] = [*coefficients, *([] if self.place is None else [constant])]
        robust = scores is not None and scores.groups >= LEAST_GROUPS
        covariance = None
        if influence is not None:
            covariance = influence.robust(scores) if robust and scores else influence.classical()
        squared = solution.residual if solution is not None else group.squared
        freedom = solution.freedom if solution is not None else group.rides
        return Fit(
            coefficients=tuple(values.tolist()),
            covariance=None if covariance is None else self._reorder(covariance),
            clusters=scores.groups if robust and scores else None,
            fills=group.fills,
            curve=group.curve,
            rides=group.rides,
            residual_sd_kwh=float(np.sqrt(squared / freedom)) if freedom > 0 and squared else None,
            held=group.held,
            dropped=group.dropped or UNSET,
            limit=EnergyLimit.of_training(*group.taken.tolist()) or UNSET,
        )

    @property
    def _order(self) -> list[int]:
        """Return the positions of the solution's coefficients, and of its constant, among the terms."""
        return [*self.sloped, *([] if self.place is None else [self.place])]

    def _reorder(self, covariance: Floats) -> tuple[tuple[float, ...], ...]:
        """Return a covariance reordered to the order of the terms."""
        out = np.empty_like(covariance)
        out[np.ix_(self._order, self._order)] = covariance
        return tuple(tuple(row) for row in out.tolist())
