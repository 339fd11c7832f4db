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
its coefficient near the physical value 1, and the coefficients of its interactions near 0. All other coefficients are
ordinary least squares.

The covariance admits that the errors of rides of one vehicle on one day depend on each other. It treats the accessory
curve as fitted together with the coefficients. The variance of the accessories' own coefficient holds for the given
shape of the curve.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from math import prod
from typing import Any, Final, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from core.batch import Floats
from core.effects.road_load import ROAD_LOAD
from core.errors import ModelError
from core.fit.accessory_curve import TemperatureBins, compute_slopes
from core.fit.block_file import BlockFile
from core.fit.regression import (
    LEAST_GROUPS,
    NO_VARIATION,
    ClusterScores,
    Influence,
    Moments,
    Solution,
    assign_groups,
    solve,
)
from core.fit.ride_blocks import ENERGY, NAMES, RideSource, convert_to_arrays, select_trainable, suggest_rides
from core.models import ANY, BASIC_PHYSICAL, VEHICLE, VEHICLE_MODEL, Fit, LinearModel, Term, Training, stamp
from core.models.derived_features import DERIVED_COLUMNS
from core.models.features import ACCESSORIES_COLUMN, ACCESSORY_NEEDS, EFFECT_PREFIX, FEATURES, Columns, list_raw_columns
from core.vehicles import AccessoryCurve
from core.vehicles.fleet import CarParameters

_RIDES_PER_COEFFICIENT: Final = 2
"""Fewest rides for each coefficient of a fit."""
_CURVE_NUMBERS: Final = 7
"""Number of parameters of an accessory curve."""
_RESOLUTION: Final = 0.01
_PRIOR_SD: Final = 0.5
PHYSICS: Final = (*(effect.energy_name for effect in ROAD_LOAD), ACCESSORIES_COLUMN)
"""First columns of the terms whose dimensionless coefficient is 1 where physics holds."""


class FitPlan(Protocol):
    """Describe what to fit, see `core.fit.recipes.LinearRecipe`."""

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
    temperatures: TemperatureBins = field(default_factory=TemperatureBins)
    fills: dict[str, float] = field(default_factory=dict)
    curve: AccessoryCurve | None = None
    moments: Moments = field(default_factory=lambda: Moments(0))
    solution: Solution | None = None
    influence: Influence | None = None
    held: tuple[str, ...] = ()
    scores: ClusterScores | None = None
    absolute: float = 0.0
    squared: float = 0.0


def build_design(terms: tuple[Term, ...], columns: Columns, rows: int) -> Floats:
    """Return the design matrix: the product of the columns of each term.

    Parameters
    ----------
    terms : tuple of Term
        Terms of the model.
    columns : Columns
        Columns of the rides.
    rows : int
        Number of rides.

    Returns
    -------
    (rows, terms) float
        1 in the column of a constant.
    """
    out = np.empty((rows, len(terms)))
    for j, term in enumerate(terms):
        out[:, j] = prod(columns[name] for name in term.columns)
    return out


def fit_terms(plan: FitPlan, rides: RideSource, *, covariance: bool = True) -> LinearModel:
    """Return the model of a plan, fitted to a ride table.

    Parameters
    ----------
    plan : FitPlan
        Terms to fit.
    rides : RideSource
        Ride table to fit them to.
    covariance : bool
        Compute the covariance and the in-sample error in another pass over the rides. A fit without it is faster.

    Returns
    -------
    LinearModel
        Model with a fit for each vehicle model that has enough rides, and the fit `*` over all rides together.

    Raises
    ------
    ModelError
        If a column is missing, if too few rides can be used for training, or if the rides do not vary.
    """
    fitting = _Fitting(plan, rides, covariance=covariance)
    with limit_to_one_thread(), closing(fitting.kept):
        fitting.survey()
        fitting.solve()
        if covariance:
            fitting.residuals()
        return fitting.model()


def limit_to_one_thread() -> Any:
    """Return a context that limits the linear algebra of numpy to one thread.

    The matrices are small, and the results become equal on any number of cores.

    Returns
    -------
    context manager
        The limit holds within its `with` block.
    """
    return _find_blas().limit(limits=1)


@cache
def _find_blas() -> Any:
    """Return the controller of the linear algebra of numpy; cached, as the search for it is slow."""
    return ThreadpoolController().select(user_api="blas")


class _Fitting:
    """Run the passes over the blocks, and keep their results."""

    def __init__(self, plan: FitPlan, rides: RideSource, *, covariance: bool) -> None:
        self.plan = plan
        self.covariance = covariance
        self.rides = rides
        self.terms = plan.terms
        read = dict.fromkeys(column for term in plan.terms for column in term.columns)
        self.curved = ACCESSORIES_COLUMN in read
        raw = dict.fromkeys(name for column in read for name in list_raw_columns(column))
        basic = BASIC_PHYSICAL.needs if self.curved else ()
        self.columns = list(dict.fromkeys((*raw, *basic, ENERGY)))
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
        for block in self._read_blocks():
            self.kept.append(block)
            for key, rows in _split(block):
                self._note(self.groups.setdefault(key, self._make_group()), Columns(block, rows=rows))
        least = _RIDES_PER_COEFFICIENT * (len(self.terms) if self.plan.free else _CURVE_NUMBERS if self.curved else 1)
        rides = self.groups[ANY].rides
        if rides < least:
            why = ", ".join(f"{n:,} {reason}" for reason, n in sorted(self.left_out.items()))
            reasons = f" ({why} left out)" if why else ""
            raise ModelError(
                f"recipe {self.plan.name}: {rides:,} rides to fit to{reasons}, and it needs {least}: "
                f"{suggest_rides(self.left_out)}"
            )
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
        for block in self.kept:
            for group, columns, _ in self._split_parts(block):
                table = np.column_stack(
                    [self._design(columns), *self._differentiate_curve(group, columns), columns[ENERGY]]
                )
                if not group.moments.rows:
                    group.moments = Moments(table.shape[1])
                group.moments.add(table)
        self._check_varies()
        for group in self.groups.values():
            self._solve(group)

    def residuals(self) -> None:
        """Pass over the rides for the residuals of the fits."""
        for block in self.kept:
            days = assign_groups(block[VEHICLE], block["date"]) if VEHICLE in block and "date" in block else None
            for group, columns, rows in self._split_parts(block):
                table = self._design(columns)
                coefficients, constant = self._solve_group(group)
                left = columns[ENERGY] - table @ coefficients - constant
                group.absolute += float(np.abs(left).sum())
                group.squared += float(left @ left)
                if group.influence is not None and days is not None:
                    if group.scores is None:
                        group.scores = ClusterScores(group.influence.mean, constant=self.place is not None)
                    table = np.column_stack([table, *self._differentiate_curve(group, columns)])
                    group.scores.add(table, left / (1.0 - group.influence.leverage(table)), days[rows])

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
        history = ({"action": "fit", "recipe": self.plan.name, "mae_in_sample_kwh": errors},) if errors else ()
        fits = {key: self._fit(group) for key, group in sorted(self.groups.items())}
        model = LinearModel(
            name=self.plan.name,
            version="",
            recipe=self.plan.name,
            terms=self.terms,
            fits=fits if self.only is None else fits | {self.only: fits[ANY]},
            training=training,
            history=history,
        )
        return stamp(model)

    def _make_group(self) -> _GroupFit:
        """Return an empty group of rides."""
        return _GroupFit(temperatures=TemperatureBins(len(self.road)))

    def _read_blocks(self) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the trainable rides of each block, and record the rides left out, dates and fingerprint."""
        for block in self.rides.blocks(self.columns):
            good, left_out = select_trainable(block, self.columns)
            self.left_out.update(left_out)
            if len(good):
                table = convert_to_arrays(good, self.columns)
                self._digest(table)
                yield table

    def _digest(self, block: dict[str, NDArray[Any]]) -> None:
        """Add rides to the fingerprint, and record their first and last dates."""
        for name, digest in self.digests.items():
            if name in NAMES:
                digest.update("\n".join([*block.get(name, [""] * len(block[ENERGY])), ""]).encode())
            else:
                digest.update(block[name].tobytes())
        dates = [date for date in block.get("date", ()) if date]
        if dates:
            first, last = self.dates
            self.dates = (min(first or min(dates), *dates), max(last, *dates))

    def _split_parts(self, block: dict[str, NDArray[Any]]) -> Iterator[tuple[_GroupFit, Columns, Any]]:
        """Yield each group, its rides of a block with the columns as the fit uses them, and their rows."""
        for key, rows in _split(block):
            group = self.groups.get(key)
            if group is not None:
                yield group, Columns(block, group.fills, group.curve, rows), rows

    def _note(self, group: _GroupFit, columns: Columns) -> None:
        """Count rides, and add them to the means that fill unknown values and to the bins of the accessory curve."""
        group.rides += len(columns[ENERGY])
        for name in self.filled:
            values = columns[name]
            known = np.isfinite(values)
            group.known[name] += int(known.sum())
            group.sums[name] = group.sums.get(name, 0.0) + float(values[known].sum())
        if self.curved:
            energy, time = columns[ENERGY], columns["duration_s"] * columns["accessory_scale"] / 3.6e6
            left = energy if self.road else energy - BASIC_PHYSICAL.predict(columns)
            road = build_design(tuple(self.road), columns, len(energy)).T
            group.temperatures.add(columns["ambient_c"], time, left, list(road))

    def _design(self, columns: Columns) -> Floats:
        """Return the design matrix without the constant."""
        return build_design(tuple(self.terms[i] for i in self.sloped), columns, len(columns[ENERGY]))

    def _differentiate_curve(self, group: _GroupFit, columns: Columns) -> list[Floats]:
        """Return the derivative of the energy by each number of the accessory curve."""
        if not self.covariance or group.curve is None:
            return []
        time = columns["duration_s"] * columns["accessory_scale"] / 3.6e6
        return list((compute_slopes(group.curve, columns["ambient_c"]) * time[:, np.newaxis]).T)

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
        moments = group.moments.only([*range(len(self.sloped)), -1])
        solution = solve(moments, constant=constant)
        weight, toward, group.held = self._make_prior(moments, solution)
        if group.held:
            solution = solve(moments, constant=constant, weight=weight, toward=toward)
        group.solution = solution
        if self.covariance:
            terms = [self.terms[i].columns for i in self.sloped]
            beside = terms.index((ACCESSORIES_COLUMN,)) if (ACCESSORIES_COLUMN,) in terms else None
            group.influence = Influence(group.moments, solution, beside)

    def _make_prior(self, moments: Moments, free: Solution) -> tuple[Floats, Floats, tuple[str, ...]]:
        """Return the weights, the targets and the names of the coefficients that the rides do not determine."""
        sums = moments.sums(centred=free.constant is not None)
        size = np.sqrt(np.maximum(np.diag(sums), 0.0))
        weight, toward, held = np.zeros(len(size) - 1), np.zeros(len(size) - 1), []
        least = max(free.variance, 1e-9 * sums[-1, -1] / moments.rows) if free.freedom > 0 else sums[-1, -1]
        terms = [self.terms[i] for i in self.sloped]
        for k, main in enumerate(terms):
            if main.unit != "1" or main.columns[0] not in PHYSICS or size[k] >= _RESOLUTION * size[-1]:
                continue
            for i, term in enumerate(terms):
                if term.columns[-len(main.columns) :] == main.columns:
                    sd = _PRIOR_SD * (size[k] / size[i] if size[i] > 0.0 and size[k] > 0.0 else 1.0)
                    weight[i], toward[i] = least / sd**2, float(i == k)
                    held.append(term.name)
        return weight, toward, tuple(held)

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


def _split(block: dict[str, NDArray[Any]]) -> Iterator[tuple[str, Any]]:
    """Yield the rows of each vehicle model, then all rows together."""
    if VEHICLE_MODEL in block:
        code, kinds = pd.factorize(block[VEHICLE_MODEL], sort=True)
        for i, kind in enumerate(kinds):
            if kind not in {"", ANY}:
                yield kind, np.flatnonzero(code == i)
    yield ANY, slice(None)
