"""Find the cars that deviate from their siblings or change, one after the other, beside those found before."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.diagnose.siblings.causes import average_places
from socast.core.diagnose.siblings.chance import estimate_chance
from socast.core.diagnose.siblings.groups import Group
from socast.core.diagnose.siblings.scan import Scan, make_weights, scan_always, scan_changes, scan_group
from socast.core.diagnose.siblings.spread import SiblingBase, estimate_spread, estimate_spread_without
from socast.core.diagnose.siblings.sums import Siblings
from socast.core.stats.multiple_testing import adjust_false_discovery

LEVELS: Final = {"always": 0.01, "change": 0.04, "all": 0.03, "group": 0.02}
"""Expected share of false deviations: of cars always, of changes of one car, of changes of all cars, of groups."""
ALL_CARS: Final = "all"
"""Name of all cars together."""
LEAST_SIBLINGS: Final = 2
"""Least number of other cars of the same model against which a car is held."""
MOST: Final = 6
"""Largest number of deviations."""
LEAST_BROAD: Final = 1.645
"""Standard errors, in the same direction, that must remain of a deviation of a car when any one shift is left out.

A few windows may determine a coefficient, such as sharp bends by a fault of the positions. A deviation lasts: the other
shifts alone must speak for it at 5 %."""
EDGE: Final = 0.03
"""Share of the shifts at either end of which no change of all cars is tested."""


GROUP_DATES: Final = 40
"""Largest number of dates at which a change of a group is tested."""
GROUP_SPREAD: Final = (0.01, 4.0)
"""Expected spread between groups, as a share of the energy, and the number of groups that it counts as."""


@dataclass(frozen=True)
class Question:
    """Hold the tests of one car, of a group, or of all cars, in one form.

    Parameters
    ----------
    who : str
        Name of the car or the group.
    members : tuple of (s,) bool
        Shifts of the car or the group, of each model.
    q : (k,) or (1,) float
        Chance of each candidate, or of any change of a car, adjusted over cars and causes.
    """

    who: str
    of: Literal["car", "group", "all"]
    members: tuple[NDArray[np.bool_], ...]
    scan: Scan
    q: Floats

    @property
    def family(self) -> str:
        """Family within which chances are adjusted, a key of `LEVELS`."""
        if self.of == "car":
            return "always" if self.scan.kind == "always" else "change"
        return self.of

    @property
    def is_significant(self) -> bool:
        """Whether any candidate is significant."""
        return float(self.q.min()) < LEVELS[self.family]


@dataclass(frozen=True)
class Search:
    """Hold what was asked in one round.

    Parameters
    ----------
    groups : list of Siblings
        Cars of each model, with effects found before as columns of the base.
    spread : (d,) float
        Variance between cars, in units of the expected one.
    """

    groups: list[Siblings]
    spread: Floats
    questions: list[Question]


def ask(groups: Sequence[Siblings], sign: Ints, ways: Sequence[Sequence[Group]] = ()) -> Search:
    """Return the tests of all cars and groups."""
    spread = estimate_spread(groups)
    questions = [question for g in range(len(groups)) for question in _ask_cars(groups, g, sign)]
    bases = [SiblingBase(siblings, spread) for siblings in groups]
    dates = _list_dates(groups)
    if len(dates) and sum(len(siblings.cars) for siblings in groups) > 1:
        every = tuple(np.ones(len(siblings.start), np.bool_) for siblings in groups)
        scan = scan_group(bases, every, dates, own_past=False)
        questions.append(Question(ALL_CARS, "all", every, scan, scan.compute_chances()))
    for way in ways:
        questions += _ask_groups(bases, way)
    return Search(list(groups), spread, list(_adjust(questions)))


def _ask_cars(groups: Sequence[Siblings], g: int, sign: Ints) -> Iterator[Question]:
    """Yield the tests of the cars of one model."""
    siblings = groups[g]
    alike = SiblingBase(siblings, np.zeros(siblings.direction.shape[1]))
    others = sum(len(each.cars) for each in groups) - 1
    for car, name in enumerate(siblings.cars):
        members = tuple(
            each.car == car if i == g else np.zeros(len(each.car), np.bool_) for i, each in enumerate(groups)
        )
        base = SiblingBase(siblings, estimate_spread_without(groups, g, car))
        scores = base.score_shifts(car)
        changes = [scan_changes(siblings, scores, car, "step"), scan_changes(siblings, scores, car, "ramp")]
        changes = [scan for scan in changes if len(scan.begin)]  # a car of few shifts has no date for a step, or none
        chance = estimate_chance(scores, siblings.start[siblings.car == car], changes, sign)
        for scan in changes:
            yield Question(name, "car", members, scan, np.array([chance]))
        if len(siblings.cars) > LEAST_SIBLINGS:
            scan = scan_always(base, car, alike, others)
            yield Question(name, "car", members, scan, scan.compute_chances())


def _ask_groups(bases: Sequence[SiblingBase], way: Sequence[Group]) -> Iterator[Question]:
    """Yield the tests of each group always, beside the spread between groups, and as steps."""
    always = [scan_group(bases, group.members, np.empty(0), own_past=False) for group in way]
    for i, group in enumerate(way):
        others = [scan for j, scan in enumerate(always) if j != i]
        start = np.concatenate([base.siblings.start[inside] for base, inside in zip(bases, group.members, strict=True)])
        dates = np.unique(np.quantile(np.sort(start), np.linspace(0.1, 0.9, GROUP_DATES), method="nearest"))
        for scan in (_widen(always[i], others), scan_group(bases, group.members, dates, own_past=True)):
            yield Question(group.name, "group", group.members, scan, scan.compute_chances())


def _widen(scan: Scan, others: Sequence[Scan]) -> Scan:
    """Return the tests of a group with the spread between the other groups added to their variance."""
    expected, count = GROUP_SPREAD
    known = [other.information > 0.0 for other in others]
    excess = [
        np.maximum(
            other.estimate**2 - np.divide(1.0, other.information, out=np.zeros_like(k, np.float64), where=k), 0.0
        )
        for other, k in zip(others, known, strict=True)
    ]
    spread = (count * expected**2 + np.sum(excess, axis=0)) / (count + np.sum(known, axis=0))
    shrink = 1.0 / (1.0 + scan.information * spread)
    return scan._replace(
        score=scan.score * shrink,
        information=scan.information * shrink,
        whole_score=scan.whole_score * shrink,
        whole_information=scan.whole_information * shrink,
        freedom=np.full(scan.score.shape[1], count + len(others)),
    )


def find_deviations(
    groups: Sequence[Siblings], sign: Ints, ways: Sequence[Sequence[Group]] = ()
) -> tuple[list[tuple[Question, Search]], Search]:
    """Return the significant deviations, each beside those before it, and the last round."""
    found: list[tuple[Question, Search]] = []
    search = first = ask(groups, sign, ways)
    while len(found) < MOST:
        best = _choose(search, sign)
        if best is None:
            break
        found.append((best, search))
        search = ask(_explain(search.groups, best, sign), sign, ways)
    return found, first


def _choose(search: Search, sign: Ints) -> Question | None:
    """Return the significant question with the most evidence."""
    significant = [
        question for question in search.questions if question.is_significant and _is_broad(search, question, sign)
    ]
    if not significant:
        return None
    who = max(significant, key=lambda question: _weigh(question, sign))
    same = [q for q in significant if q.who == who.who]
    return max(same, key=lambda question: _weigh(question, sign))


def _is_broad(search: Search, question: Question, sign: Ints) -> bool:
    """Return whether a deviation of a car remains when any one of its shifts is left out."""
    if question.of != "car":
        return True
    g = next(i for i, there in enumerate(question.members) if there.any())
    siblings = search.groups[g]
    evidence = question.scan.compute_evidence(sign)
    place, at = np.unravel_index(int(evidence.argmax()), evidence.shape)
    weight = make_shift_weights(search.groups, question, int(place))[g][question.members[g]]
    car = siblings.cars.index(question.who)
    base = SiblingBase(siblings, estimate_spread_without(search.groups, g, car))
    scores = base.score_shifts(car)
    return scores.test_without_shifts(int(at), weight, own_past=question.scan.kind != "always") > LEAST_BROAD


def _weigh(question: Question, sign: Ints) -> float:
    """Return the evidence of the best candidate, averaged over dates."""
    return float(average_places(question.scan, question.scan.compute_evidence(sign, whole=True)).max())


def _explain(groups: list[Siblings], question: Question, sign: Ints) -> list[Siblings]:
    """Return the cars with a deviation as a column of their base."""
    evidence = question.scan.compute_evidence(sign)
    place, at = np.unravel_index(int(evidence.argmax()), evidence.shape)
    weights = make_shift_weights(groups, question, int(place))
    return [
        siblings.add_fixed(int(at), weight) if weight.any() else siblings
        for siblings, weight in zip(groups, weights, strict=True)
    ]


def make_shift_weights(groups: Sequence[Siblings], question: Question, place: int) -> list[Floats]:
    """Return the size of a deviation in each shift of the cars of each model, (s,) each."""
    out = []
    for siblings, there in zip(groups, question.members, strict=True):
        weight = there.astype(np.float64)
        begin = question.scan.begin[place]
        if question.scan.kind == "step":
            weight *= siblings.start >= begin
        elif question.scan.kind == "ramp" and there.any():
            start = siblings.start[there]
            weight[there] = make_weights(start, np.array([int(np.searchsorted(start, begin))]), "ramp")[0]
        out.append(weight)
    return out


def _adjust(questions: list[Question]) -> Iterator[Question]:
    """Yield the questions with chances adjusted within their families."""
    families: dict[str, list[Question]] = {}
    for question in questions:
        families.setdefault(question.family, []).append(question)
    for family in families.values():
        q = adjust_false_discovery(np.concatenate([question.q for question in family]))
        for question, part in zip(family, np.split(q, len(family)), strict=True):
            yield replace(question, q=part)


def _list_dates(groups: Sequence[Siblings]) -> Floats:
    """Return the times at which a change of all cars is tested: the begin of each shift but the first and last."""
    dates = np.unique(np.concatenate([siblings.start for siblings in groups]))
    edge = max(1, round(EDGE * len(dates)))
    return dates[edge:-edge]
