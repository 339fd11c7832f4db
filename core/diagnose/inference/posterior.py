"""Infer which effects are missing, where and since when, with a probability and a size for each.

1. Alternatives are compared at the usual spreads of rides, days and cars, so that variation between days does not take
   up what an effect explains before the effect is known.
2. Variances and spreads are learned beside what was found, and the alternatives are compared again.
3. The odds of each finding are those of two models, with and without it, whose spreads are learned each time. The
   windows have the weights of the model without it.

Beforehand, a coefficient lies between zero and its largest plausible value, or between plus and minus that value where
both signs are plausible, as within a scope. Expected effects have a normal distribution. So a cause that only an
implausible coefficient would explain is left to other effects, or to forms outside the library.

The size of a finding has a standard error that allows its column to act differently on different dates, and its formula
to differ from that of the car.

References
----------
O'Hara and Sillanpää, Bayesian Analysis 4 (2009) 85, DOI 10.1214/09-BA403: selection of variables. Dickey, Annals of
Mathematical Statistics 42 (1971) 204, DOI 10.1214/aoms/1177693507: the odds of an expected effect.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import exp, hypot, inf, log, log1p, sqrt
from typing import Final, NamedTuple

import numpy as np

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.diagnose.forms.suggestion import format_formula
from socast.core.diagnose.forms.terms import FormTerm
from socast.core.diagnose.inference.alternatives import Alternatives, log_share_within, select_alternatives
from socast.core.diagnose.inference.events import KnownEvent
from socast.core.diagnose.inference.form_search import FormSearch
from socast.core.diagnose.inference.sampler import normalise, sample_alternatives, weigh_further
from socast.core.diagnose.inference.scopes import (
    PRIOR_EFFECT,
    Family,
    Timing,
    list_families,
    list_unknown,
)
from socast.core.diagnose.inference.window_columns import Expected, WindowColumns
from socast.core.diagnose.inference.window_model import WindowModel
from socast.core.diagnose.records import UNKNOWN
from socast.core.effects.declaration import VARIANT
from socast.core.stats.scores import Estimate

LIKELY: Final = 0.5
"""Probability from which a finding is reported."""
BESIDE: Final = (0.03, 0.2)
"""Probabilities above which alternatives are known effects while spreads are learned, in the order of the rounds."""
LEAST: Final = 0.02
"""Probability below which a family is not examined further."""
MOST: Final = 12
"""Largest number of families that are examined."""
RELEARNED: Final = 15
"""Number of steps of the search for the spreads with and without a finding."""
PRIOR_DAYS: Final = 4.0
"""Dates that the expected variance between dates counts as."""
FORM_ERROR: Final = 0.1
"""Relative standard error of a size because the formula of an effect is not that of the car. [1]

Typical of two formulas of one phenomenon, put into the drives of a Tesla Model 3.
"""


class Size(NamedTuple):
    """Hold the coefficient of an effect.

    Parameters
    ----------
    estimate : Estimate
        Its standard error allows for differences between dates.
    spread : float
        Variance between dates over the expected one, at least 1. [1]
    """

    estimate: Estimate
    spread: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the 95 % interval of the coefficient excludes zero."""
        low, high = self.estimate.interval
        return low * high > 0.0

    def reaches(self, limits: tuple[float, float]) -> bool:
        """Return whether the 95 % interval of the coefficient reaches a range. [unit of the coefficient]"""
        low, high = self.estimate.interval
        return low <= limits[1] and high >= limits[0]


@dataclass(frozen=True)
class LikelyCause:
    """Hold a family of which one alternative is probably true.

    Parameters
    ----------
    probability : float
        That one of the family is true, whatever else is. [1]
    evidence : float
        Logarithm of the Bayes factor of the best alternative against none, over the spread between dates of its size,
        so that a few dates do not decide. [1]
    variant : str
        Effect, or its variant, of the best alternative; the formula of a form outside the library.
    size : Size
        Its coefficient.
    causes : dict of str to float
        Effects that could explain the same, each with its share of the probability, the largest first; `UNKNOWN`
        stands for forms outside the library. [1]
    dates : dict of int to float
        Probability of each place of the family, given that one is true. [1]
    place : int
        Index in `family.places` of the timing of the best alternative.
    column : (n,) float
        Energy of the best alternative per unit of its coefficient. [kWh]
    form : FormTerm, optional
        The form outside the library.
    forms : dict of str to float
        Formulas of the forms that could explain the same, each with its share of the probability. [1]
    """

    family: Family
    probability: float
    evidence: float
    variant: str
    size: Size
    causes: dict[str, float]
    dates: dict[int, float]
    place: int
    column: Floats
    form: FormTerm | None = None
    forms: dict[str, float] = field(default_factory=dict)

    @property
    def effect(self) -> str:
        """Name of the effect."""
        return self.variant.partition(VARIANT)[0]

    @property
    def when(self) -> Timing:
        """When the best alternative acts."""
        return self.family.places[self.place]

    @property
    def is_supported(self) -> bool:
        """Whether the data support it: it is likely, its 95 % interval excludes zero, and no form is more probable."""
        doubtful = self.form is None and self.causes.get(UNKNOWN, 0.0) >= LIKELY
        return self.probability >= LIKELY and self.size.excludes_zero and not doubtful

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest plausible coefficient of the effect where it acts. [unit of the coefficient]"""
        largest = effects.get(self.effect).largest
        return self.family.lowest * largest, largest

    @property
    def is_plausible(self) -> bool:
        """Whether its 95 % interval reaches these limits; forms have none."""
        return self.form is not None or self.size.reaches(self.limits)

    @property
    def is_likely(self) -> bool:
        """Whether it is named: the data support it, and its size is plausible."""
        return self.is_supported and self.is_plausible


@dataclass(frozen=True)
class ExpectedCause:
    """Hold what the data tell of an effect that physics expects in every car, and a model lacks."""

    effect: str
    probability: float
    evidence: float
    size: Size
    column: Floats

    @property
    def is_supported(self) -> bool:
        """Whether the data support it: it is likely, and its 95 % interval excludes zero."""
        return self.probability >= LIKELY and self.size.excludes_zero

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest plausible coefficient. [unit of the coefficient]"""
        return 0.0, effects.get(self.effect).largest

    @property
    def is_plausible(self) -> bool:
        """Whether its 95 % interval reaches these limits."""
        return self.size.reaches(self.limits)

    @property
    def is_likely(self) -> bool:
        """Whether it is named: the data support it, and its size is plausible."""
        return self.is_supported and self.is_plausible


@dataclass(frozen=True)
class Inference:
    """Hold the posterior of what is missing.

    Parameters
    ----------
    findings : tuple of LikelyCause
        Families whose probability exceeds `LEAST`, the most probable first.
    expected : tuple of ExpectedCause
        Effects that physics expects.
    alone : dict of str to (str, float)
        Effects tested in all cars -> best variant alone, before any effect is known, and its coefficient over its
        standard error. [1]
    chances : dict of str to float
        The same effects -> probability that they are missing. [1]
    unidentified : frozenset of str
        Effects that the base can imitate.
    scoped : int
        Number of families within scopes: cars, groups and dates.
    model : WindowModel
        The windows beside all likely findings.
    known : tuple of LikelyCause
        Those findings, in the order of the known columns of the model.
    """

    findings: tuple[LikelyCause, ...]
    expected: tuple[ExpectedCause, ...]
    alone: dict[str, tuple[str, float]]
    chances: dict[str, float]
    unidentified: frozenset[str]
    scoped: int
    model: WindowModel
    known: tuple[LikelyCause, ...]

    @property
    def columns(self) -> WindowColumns:
        """Columns of the windows."""
        return self.model.columns


def infer_missing(
    columns: WindowColumns,
    inside: Sequence[str] = (),
    groups: Sequence[tuple[str, Ints]] = (),
    events: Sequence[KnownEvent] = (),
    *,
    scopes: bool = True,
    forms: FormSearch | None = None,
    seed: int = 0,
    report: Callable[[float], None] = lambda _: None,
) -> Inference:
    """Return what is missing from a model.

    Parameters
    ----------
    inside : sequence of str
        Effects that the model has in all cars.
    groups : sequence of (str, (k,) int64)
        Name and vehicle-days of each group of vehicle-days.
    events : sequence of KnownEvent
        Known events, each a candidate of its own.
    scopes : bool
        Whether single cars, groups and dates are tested.
    forms : FormSearch, optional
        Forms outside the library; without them, only effects of the library may be missing.
    report : callable
        Function that receives the share of the work that is done.
    """
    library = list_families(columns, inside, groups, events, scopes=scopes)
    model, given = WindowModel(columns), None
    first: Alternatives | None = None
    for step, least in enumerate((*BESIDE, None)):
        if forms is not None:
            model = forms.extend(model, inside)
        columns, families = model.columns, [*library, *list_unknown(model.columns)]
        given = select_alternatives(model, families, given)
        first = first or given
        chances, together = sample_alternatives(given, seed)
        report(0.2 * (step + 1))
        of_family = [float(chances[given.family == number].sum()) for number in range(len(families))]
        best = {
            number: int(np.argmax(np.where(given.family == number, chances, -1.0)))
            for number, chance in enumerate(of_family)
            if chance > 0.0
        }
        if least is not None:
            found = [at for number, at in best.items() if of_family[number] > least]
            model = model.add(_stack(given, columns, found)).relearn()
    assert given is not None  # there are several rounds
    assert first is not None
    examiner = _Examiner(model, families, given, chances, best | together, together)
    ranked = sorted(examiner.best, key=lambda number: (number not in examiner.together, -of_family[number]))
    findings = []
    for done, number in enumerate(ranked[:MOST]):
        if of_family[number] > LEAST or number in examiner.together:
            findings.append(examiner.examine(number, of_family[number]))
        report(0.6 + 0.4 * (done + 1) / min(len(ranked), MOST))
    numbers = {id(family): number for number, family in enumerate(families)}
    likely = {examiner.best[numbers[id(one.family)]]: one for one in findings if one.is_likely}
    final = examiner.get_model(list(likely))
    names = columns.names
    everywhere = {family.who: number for number, family in enumerate(library) if not family.is_scoped}
    examined = {one.effect: one.probability for one in findings if one.family.who in everywhere}
    return Inference(
        findings=tuple(sorted(findings, key=lambda one: (-round(one.probability, 3), -one.evidence))),
        expected=tuple(_examine_expected(final, each) for each in columns.expected),
        alone={name: _score_alone(first, number, families[number], names) for name, number in everywhere.items()},
        chances={name: examined.get(name, of_family[number]) for name, number in everywhere.items()},
        unidentified=frozenset(
            name for name, number in everywhere.items() if not first.identified & set(families[number].effects)
        ),
        scoped=sum(family.is_scoped for family in families),
        model=final,
        known=tuple(likely[at] for at in sorted(likely)),
    )


def _stack(given: Alternatives, columns: WindowColumns, chosen: Sequence[int]) -> Floats:
    """Return the columns of alternatives, (n, k)."""
    if not chosen:
        return np.zeros((len(columns.residual), 0))
    return np.column_stack([given.build_column(columns, at) for at in chosen])


def _score_alone(given: Alternatives, number: int, family: Family, names: tuple[str, ...]) -> tuple[str, float]:
    """Return the variant of a family with the largest score alone, and that score in standard errors."""
    rows = np.flatnonzero(given.family == number)
    if not len(rows):
        return names[family.effects[0]], 0.0
    own = np.diag(given.own)[rows]
    score = given.match[rows] / np.sqrt(np.maximum(own, 1e-300))
    best = int(np.argmax(np.abs(score)))
    return names[int(given.effect[rows[best]])], float(score[best])


class _Examiner:
    """Compare models with and without each family."""

    def __init__(
        self,
        model: WindowModel,
        families: list[Family],
        given: Alternatives,
        chances: Floats,
        best: dict[int, int],
        together: dict[int, int],
    ) -> None:
        self.model, self.families, self.given, self.chances, self.best = model, families, given, chances, best
        self._models: dict[tuple[int, ...], WindowModel] = {}
        self.together = dict(together)
        for number in together:
            self._prefer_best(number)

    def get_model(self, chosen: Sequence[int]) -> WindowModel:
        """Return the model beside some alternatives, with weights and spreads of its own."""
        key = tuple(sorted(chosen))
        if key not in self._models:
            columns = _stack(self.given, self.model.columns, key)
            self._models[key] = self.model.add(columns).relearn(RELEARNED)
        return self._models[key]

    def examine(self, number: int, sampled: float) -> LikelyCause:
        """Return the odds and the size of the best alternative of a family beside the other likely ones."""
        given, family, at = self.given, self.families[number], self.best[number]
        columns = self.model.columns
        others = [row for other, row in self.together.items() if other != number]
        without = self.get_model(others)
        both = without.add(_stack(given, columns, [*sorted(others), at])).relearn_spreads(RELEARNED)
        size = _measure_size(both, both.locate_known().stop - 1, float(given.size[at]))
        evidence = both.log_density - without.log_density
        unit, limits = float(given.size[at]), given.limits[:, at]
        mean, sd = size.estimate.value / unit, size.estimate.error / unit
        evidence += float(log_share_within(limits, mean, sd) - log_share_within(limits))
        evidence /= size.spread
        rows = np.flatnonzero(given.family == number)
        of_place = np.bincount(given.place[rows], self.chances[rows], len(family.places)) / max(sampled, 1e-12)
        causes, forms, among = self._share_causes(number, others)
        share = among if family.is_unknown else float(self.chances[at]) / max(sampled, 1e-12)
        odds = evidence + float(given.log_odds[at]) - log(max(share, 1e-12))
        effect = int(given.effect[at])
        form = columns.unknown[effect - len(columns.names)].term if family.is_unknown else None
        return LikelyCause(
            family=family,
            probability=_invert_odds(odds),
            evidence=evidence,
            variant=columns.names[effect] if form is None else format_formula(form),
            size=size,
            causes=causes,
            dates={place: float(of_place[place]) for place in np.flatnonzero(of_place > 0.0).tolist()},
            place=int(given.place[at]),
            column=given.build_column(columns, at) / float(given.size[at]),
            form=form,
            forms=forms,
        )

    def _prefer_best(self, number: int) -> None:
        """Replace a family of what is true together by the one that is more probable in its place."""
        others = [at for other, at in self.together.items() if other != number]
        rows, chances = self._weigh_in_place(number, others)
        family = int(np.argmax(np.bincount(self.given.family[rows], chances)))
        best = int(rows[int(np.argmax(np.where(self.given.family[rows] == family, chances, -1.0)))])
        if family != number and not self.families[number].is_scoped:
            del self.together[number]
            self.together[family] = self.best[family] = best

    def _weigh_in_place(self, number: int, others: list[int]) -> tuple[Ints, Floats]:
        """Return what could take the place of a family beside the others, and the probability of each."""
        given, family = self.given, self.families[number]
        known = {int(given.family[at]) for at in others}
        free = [
            other
            for other in range(len(self.families))
            if other == number or (not family.is_scoped and not self.families[other].is_scoped and other not in known)
        ]
        rows = np.flatnonzero(np.isin(given.family, free))
        return rows, normalise(weigh_further(given, sorted(others), rows) + given.log_odds[rows])

    def _share_causes(self, number: int, others: list[int]) -> tuple[dict[str, float], dict[str, float], float]:
        """Return what could take the place of a family beside the others.

        Returns
        -------
        causes : dict of str to float
            Effects, and `UNKNOWN`, with their shares of the probability. [1]
        forms : dict of str to float
            Formulas of the forms outside the library, with their shares of that of all forms. [1]
        among : float
            Share of the best alternative of the family among all forms. [1]
        """
        given, columns = self.given, self.model.columns
        rows, chances = self._weigh_in_place(number, others)
        causes: dict[str, float] = {}
        forms: dict[str, float] = {}
        for row, chance in zip(rows.tolist(), chances.tolist(), strict=True):
            effect, name = int(given.effect[row]), UNKNOWN
            if effect < len(columns.names):
                name = columns.names[effect].partition(VARIANT)[0]
            else:
                forms[format_formula(columns.unknown[effect - len(columns.names)].term)] = chance
            causes[name] = causes.get(name, 0.0) + chance
        unknown = max(causes.get(UNKNOWN, 0.0), 1e-300)
        best = float(chances[rows == self.best[number]][0]) if self.families[number].is_unknown else 0.0
        return _rank(causes), _rank({formula: chance / unknown for formula, chance in forms.items()}), best / unknown


def _rank(shares: dict[str, float]) -> dict[str, float]:
    """Return shares, the largest first."""
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _invert_odds(odds: float) -> float:
    """Return the probability of log odds."""
    return 1.0 / (1.0 + exp(-min(max(odds, -700.0), 700.0)))


def _measure_size(model: WindowModel, at: int, unit: float, mean: float = 0.0) -> Size:
    """Return a coefficient of a model, `at` its place, with a standard error that dates show.

    Notes
    -----
    With ψ_d the part of the coefficient that date d adds, the variance is the greater of the posterior one and that
    times Σ ψ_d² over its expectation, which counts as `PRIOR_DAYS` dates. All cars share the weather of a date. The
    error of the formula, `FORM_ERROR`, is added in quadrature.
    """
    scale, inverse = model.scale, model.covariance()[at]
    source, place = model.coordinates
    sums = model.of_days.sums[:, source][:, :, source]
    row = np.append(inverse * scale[:-1], 0.0)[place]
    residual = np.append(-model.coefficients * scale[:-1], 1.0)[place]
    date = model.columns.date_of_day
    parts = np.bincount(date, np.einsum("da,dab,db->d", row, sums, residual))
    expected = np.bincount(date, np.einsum("da,dab,db->d", row, sums, row))
    total = max(float(expected.sum()), 1e-300)
    days = total**2 / max(float((expected**2).sum()), 1e-300)
    spread = max(1.0, (PRIOR_DAYS + days * float((parts**2).sum()) / total) / (PRIOR_DAYS + days))
    value, error = mean + unit * float(model.coefficients[at]), unit * sqrt(spread * float(inverse[at]))
    return Size(Estimate(value, hypot(error, FORM_ERROR * value), inf), spread)


def _examine_expected(model: WindowModel, expected: Expected) -> ExpectedCause:
    """Return the odds of an expected effect: the density of a coefficient of zero before and after the data."""
    at = model.shared + expected.at
    sd = expected.sd * float(model.scale[at])
    size = _measure_size(model, at, sd, expected.mean)
    zero = -expected.mean / sd
    variance, mean = float(model.covariance()[at, at]) * size.spread, float(model.coefficients[at])
    evidence = 0.5 * ((zero - mean) ** 2 / variance + log(variance) - zero**2)
    odds = evidence + log(PRIOR_EFFECT) - log1p(-PRIOR_EFFECT)
    columns = model.columns
    return ExpectedCause(
        effect=expected.effect,
        probability=_invert_odds(odds) if size.estimate.value > 0.0 else 0.0,
        evidence=evidence,
        size=size,
        column=columns.common[:, expected.at] / expected.sd,
    )
