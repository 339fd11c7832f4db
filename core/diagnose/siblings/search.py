"""Find the cars that deviate from their siblings or change, one after the other, beside those found before."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from core.batch import Floats, Ints
from core.diagnose.siblings.causes import average_places
from core.diagnose.siblings.scan import Kind, Scan, make_weights, scan_all_cars, scan_always, scan_changes
from core.diagnose.siblings.spread import SiblingBase, estimate_spread, estimate_spread_without
from core.diagnose.siblings.sums import Siblings
from core.stats.multiple_testing import adjust_false_discovery

LEVEL: Final = 0.03
"""Expected share of false deviations of a family: always, changes of one car, changes of all cars."""
LEAST_SIBLINGS: Final = 2
"""Least number of other cars of the same model against which a car is held."""
MOST: Final = 6
"""Largest number of deviations."""
EDGE: Final = 0.03
"""Share of the shifts at either end of which no change of all cars is tested."""


@dataclass(frozen=True)
class Question:
    """Hold the tests of one car, or of all, in one form.

    Parameters
    ----------
    group : int
        Index of the vehicle model; -1 for all.
    car : int
        Index of the car in its model; -1 for all.
    scan : Scan
        Tests.
    q : (k,) float
        Chance of each candidate, adjusted over cars and causes.
    """

    group: int
    car: int
    scan: Scan
    q: Floats


@dataclass(frozen=True)
class Search:
    """Hold what was asked in one round.

    Parameters
    ----------
    groups : list of Siblings
        Cars of each model, with effects found before as columns of the base.
    spread : (d,) float
        Variance between cars, in units of the expected one.
    questions : list of Question
        All tests.
    """

    groups: list[Siblings]
    spread: Floats
    questions: list[Question]


def ask(groups: Sequence[Siblings]) -> Search:
    """Return the tests of all cars.

    Parameters
    ----------
    groups : sequence of Siblings
        Cars of each model.
    """
    groups = [siblings for siblings in groups if len(siblings.start)]
    spread = estimate_spread(groups)
    questions: list[Question] = []
    for g, siblings in enumerate(groups):
        for car in range(len(siblings.cars)):
            base = SiblingBase(siblings, estimate_spread_without(groups, g, car))
            kinds: tuple[Kind, ...] = ("step", "ramp")
            if len(siblings.cars) > LEAST_SIBLINGS:
                questions.append(_make_question(g, car, scan_always(base, car)))
            questions += [_make_question(g, car, scan_changes(base, car, kind)) for kind in kinds]
    dates = _list_dates(groups)
    if len(dates) and sum(len(siblings.cars) for siblings in groups) > 1:
        bases = [SiblingBase(siblings, spread) for siblings in groups]
        questions.append(_make_question(-1, -1, scan_all_cars(bases, dates)))
    return Search(groups, spread, list(_adjust(questions)))


def find_deviations(groups: Sequence[Siblings], sign: Ints) -> tuple[list[tuple[Question, Search]], Search]:
    """Return the significant deviations, each beside those before it, and the last round.

    Parameters
    ----------
    groups : sequence of Siblings
        Cars of each model.
    sign : (k,) int64
        Sign that physics demands of each candidate.
    """
    found: list[tuple[Question, Search]] = []
    search = first = ask(groups)
    while len(found) < MOST:
        best = _choose(search, sign)
        if best is None:
            break
        found.append((best, search))
        search = ask(_explain(search.groups, best, sign))
    return found, first


def _choose(search: Search, sign: Ints) -> Question | None:
    """Return the significant question with the most evidence."""
    significant = [question for question in search.questions if question.q.min() < LEVEL]
    if not significant:
        return None
    who = max(significant, key=lambda question: _weigh(question, sign))
    same = [q for q in significant if (q.group, q.car) == (who.group, who.car)]
    return max(same, key=lambda question: _weigh(question, sign))


def _weigh(question: Question, sign: Ints) -> float:
    """Return the evidence of the best candidate, averaged over dates."""
    return float(average_places(question.scan, question.scan.compute_evidence(sign, whole=True)).max())


def _explain(groups: list[Siblings], question: Question, sign: Ints) -> list[Siblings]:
    """Return the cars with a deviation as a column of their base."""
    evidence = question.scan.compute_evidence(sign)
    place, at = np.unravel_index(int(evidence.argmax()), evidence.shape)
    out = list(groups)
    for g, siblings in enumerate(groups):
        if question.group in {-1, g}:
            out[g] = siblings.add_fixed(int(at), make_shift_weights(siblings, question, int(place)))
    return out


def make_shift_weights(siblings: Siblings, question: Question, place: int) -> Floats:
    """Return the size of a deviation in each shift of the cars of a model, (s,)."""
    there = np.ones(len(siblings.start), np.bool_) if question.car < 0 else siblings.car == question.car
    if question.scan.kind == "always":
        return there.astype(np.float64)
    begin = question.scan.begin[place]
    if question.scan.kind == "step":
        return np.asarray(there & (siblings.start >= begin), dtype=np.float64)
    start = siblings.start[there]
    out = np.zeros(len(there))
    out[there] = make_weights(start, np.array([int(np.searchsorted(start, begin))]), "ramp")[0]
    return out


def _make_question(group: int, car: int, scan: Scan) -> Question:
    """Return a question with unadjusted chances."""
    return Question(group, car, scan, scan.compute_chances())


def _adjust(questions: list[Question]) -> Iterator[Question]:
    """Yield the questions with chances adjusted within always, changes of one car, and changes of all cars."""
    families: dict[tuple[bool, bool], list[Question]] = {}
    for question in questions:
        families.setdefault((question.car < 0, question.scan.kind == "always"), []).append(question)
    for family in families.values():
        q = adjust_false_discovery(np.concatenate([question.q for question in family]))
        for question, part in zip(family, np.split(q, len(family)), strict=True):
            yield replace(question, q=part)


def _list_dates(groups: Sequence[Siblings]) -> Floats:
    """Return the times at which a change of all cars is tested: the begin of each shift but the first and last."""
    dates = np.unique(np.concatenate([siblings.start for siblings in groups]))
    edge = max(1, round(EDGE * len(dates)))
    return dates[edge:-edge]
