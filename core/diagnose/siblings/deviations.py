"""Describe what distinguishes single cars from their siblings, and what changed since when.

1. `sums` gathers the sums of products of each shift, with random effects of rides and days removed.
2. `spread` estimates how much cars differ, without the car under test.
3. `shift_scores` and `scan` test every candidate always, as a step and as a ramp; `chance` gives the probability of so
   much evidence without a change; `search` selects what is significant.
4. `causes` weighs causes and dates.
"""

from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
from scipy.special import ndtr

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.columns import SECONDS_PER_DAY
from socast.core.diagnose.add.terms import describe_coefficient
from socast.core.diagnose.candidates import Candidates, build_candidates
from socast.core.diagnose.deviation_words import MONTH, rank_deviation
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.records import (
    CarDeviation,
    CauseProbability,
    Comparisons,
    DirectionSpread,
    RankedCar,
    ShiftSize,
)
from socast.core.diagnose.siblings.causes import (
    average_places,
    select_credible_range,
    select_credible_set,
    weigh_causes,
    weigh_dates,
)
from socast.core.diagnose.siblings.groups import list_groups
from socast.core.diagnose.siblings.scan import Scan
from socast.core.diagnose.siblings.search import Question, Search, find_deviations, make_shift_weights
from socast.core.diagnose.siblings.spread import SiblingBase, estimate_spread_without
from socast.core.diagnose.siblings.sums import DIRECTIONS, Siblings, gather_siblings
from socast.core.models import LinearModel
from socast.core.models.features import EFFECT_PREFIX, SINCE_SCOPE, VEHICLE_SCOPE
from socast.core.records import make_interval
from socast.core.stats.scores import Estimate


def diagnose_deviations(
    base: BaseProjection,
    model: LinearModel,
    known: Floats,
    without: Collection[str] = (),
    of_vehicle: Mapping[str, str] | None = None,
) -> Comparisons:
    """Return what distinguishes cars from their siblings, what changed, and all cars in order of their deviation.

    Those with an implausible cause follow the others, and those whose interval of the size contains zero are last.

    Units: known [kWh per unit].
    """
    candidates = keep_declared_values(build_candidates(base.windows, model, without, scopes=True))
    if not candidates.variants:
        return Comparisons([], [])
    groups = gather_siblings(base, candidates, known)
    ways = list_groups(base.windows, groups, of_vehicle or {})
    found, first = find_deviations(groups, candidates.sign, ways)
    deviations = [_describe(question, search, candidates) for question, search in found]
    return Comparisons(sorted(deviations, key=rank_deviation), rank_cars(first, candidates.sign))


def keep_declared_values(candidates: Candidates) -> Candidates:
    """Return the candidates whose parameters have their declared values."""
    names = [candidates.names[i] for i in candidates.effects.tolist()]
    kept = [i for i, (variant, name) in enumerate(zip(candidates.variants, names, strict=True)) if variant == name]
    return Candidates(
        variants=tuple(candidates.variants[i] for i in kept),
        effects=np.arange(len(kept), dtype=np.int64),
        names=tuple(candidates.variants[i] for i in kept),
        sign=candidates.sign[kept],
        columns=candidates.columns[:, kept],
        measured=candidates.measured,
        scope=candidates.scope,
        excluded=candidates.excluded,
    )


def rank_cars(search: Search, sign: Ints) -> list[RankedCar]:
    """Return each car with its deviations in spreads between cars, the one with most evidence first."""
    rows = []
    for question in [q for q in search.questions if q.family == "always"]:
        g = next(i for i, there in enumerate(question.members) if there.any())
        siblings = search.groups[g]
        car = siblings.cars.index(question.who)
        variance = estimate_spread_without(search.groups, g, car)
        deviations = SiblingBase(siblings, variance).expect_deviations()
        mean, error = deviations.mean[car], np.sqrt(deviations.variance[car])
        energy = siblings.direction[siblings.car == car].sum(axis=0) / siblings.measured[siblings.car == car].sum()
        root = np.sqrt(variance)
        share = Estimate(float(energy @ mean), float(np.sqrt(energy @ deviations.covariance[car] @ energy)), np.inf)
        evidence = average_places(question.scan, question.scan.compute_evidence(sign))
        rows.append(
            RankedCar(
                car=siblings.cars[car],
                siblings=len(siblings.cars) - 1,
                evidence=float(evidence.max()),
                share=share.value,
                share_ci95=make_interval(*share.interval),
                share_spread=float(np.sqrt(energy**2 @ variance)),
                spreads=[
                    DirectionSpread(direction=name, value=m / r, error=e / r)
                    for name, m, e, r in zip(DIRECTIONS, mean, error, root, strict=True)
                ],
            )
        )
    return sorted(rows, key=lambda row: -(row.evidence or 0.0))


def _describe(question: Question, search: Search, candidates: Candidates) -> CarDeviation:
    """Return the record of a deviation."""
    scan = question.scan
    evidence = scan.compute_evidence(candidates.sign)
    causes = weigh_causes(scan, candidates.sign)
    dates = weigh_dates(scan, evidence, causes)
    declared = {i: effects.get(candidates.variants[i]) for i in select_credible_set(causes).tolist()}
    coefficients = {i: _estimate_cause(scan, evidence, i) for i in declared}
    plausible = {i: describe_coefficient(declared[i], coefficients[i]).plausible for i in declared}
    kept = sorted(declared, key=lambda i: not plausible[i])
    best = kept[0]
    place = int(np.searchsorted(np.cumsum(dates), 0.5))
    coefficient, effect = coefficients[best], declared[best]
    columns = [f"{EFFECT_PREFIX}{candidates.variants[best]}"]
    since, range_of_since = None, None
    if question.of == "car":
        columns.append(f"{VEHICLE_SCOPE}{question.who}")
    if scan.kind != "always":
        low, high = select_credible_range(dates)
        since = _format_date(scan.begin[place])
        range_of_since = _format_date(scan.after[low]), _format_date(scan.begin[high])
        columns.append(f"{SINCE_SCOPE}{since}")
    if scan.kind == "ramp" or question.of == "group":
        columns = []  # no term holds a ramp or a group
    return CarDeviation(
        who=question.who,
        of=question.of,
        kind=scan.kind,
        effect=candidates.names[best],
        causes=[
            CauseProbability(
                effect=candidates.names[i],
                probability=causes[i],
                shown_by=declared[i].shown_by,
                plausible=plausible[i],
            )
            for i in kept
        ],
        q=question.q.min(),
        z=scan.z.ravel()[np.abs(scan.z).argmax()],
        evidence=average_places(scan, evidence).max(),
        tests=sum(each.scan.unit.shape[1] for each in search.questions),
        coefficient=describe_coefficient(effect, coefficient),
        words=effect.in_words(coefficient.value, coefficient.ci95),
        since=since,
        since_ci90=range_of_since,
        columns=columns,
        days=_sum_scope(search.groups, question, best, place)[3],
        shifts=_list_shifts(question, search, best, place),
        **_compute_size(question, search, (causes, dates), evidence),
    )


def _estimate_cause(scan: Scan, evidence: Floats, cause: int) -> Estimate:
    """Return the coefficient that a cause would need, averaged over its dates."""
    dates = weigh_dates(scan, evidence[:, [cause]], np.ones(1))
    estimate, error = _mix(scan.estimate[:, cause], scan.information[:, cause], dates)
    unit = float(scan.unit[:, cause] @ dates)
    return Estimate(unit * estimate, unit * error, np.inf)


def _mix(estimate: Floats, information: Floats, weight: Floats) -> tuple[float, float]:
    """Return mean and standard deviation of estimates at several dates, each with a probability."""
    known = (information > 0.0) & (weight > 0.0)
    estimate, variance, weight = estimate[known], 1.0 / information[known], weight[known] / weight[known].sum()
    mean = float(weight @ estimate)
    return mean, float(np.sqrt(weight @ (variance + (estimate - mean) ** 2)))


def _compute_size(
    question: Question, search: Search, weights: tuple[Floats, Floats], evidence: Floats
) -> dict[str, Any]:
    """Return the net energy of a deviation: as a share, per km and per month, averaged over causes and dates."""
    scan, (causes, _) = question.scan, weights
    groups = search.groups
    shares, errors, chances = [], [], []
    for cause in np.flatnonzero(causes > 0.01 * causes.max()).tolist():
        dates = weigh_dates(scan, evidence[:, [cause]], np.ones(1))
        for place in np.flatnonzero(dates > 0.001).tolist():
            net, measured, distance, days = _sum_scope(groups, question, cause, place)
            if scan.information[place, cause] <= 0.0:
                continue
            unit = scan.unit[place, cause]
            size = np.array([net / measured, net / max(distance, 1e-9), net / days * MONTH]) * unit
            if scan.kind == "ramp":
                whole = net / max(float(_sum_scope(groups, question, cause, place, full=True)[0]), 1e-300)
                size = np.append(size, size[0] / whole * MONTH * SECONDS_PER_DAY / (scan.end - scan.begin[place]))
            shares.append(size * scan.estimate[place, cause])
            errors.append(size / np.sqrt(scan.information[place, cause]))
            chances.append(causes[cause] * dates[place])
    names = ("share", "kwh_per_km", "kwh_per_month", "share_per_month")
    out: dict[str, Any] = {}
    for name, value, error in zip(names, np.array(shares).T, np.abs(np.array(errors)).T, strict=False):
        low, middle, high = compute_mixed_quantiles(value, error, np.array(chances))
        out |= {name: middle, f"{name}_ci95": make_interval(low, high)}
    return out


def compute_mixed_quantiles(
    mean: Floats, error: Floats, weight: Floats, levels: tuple[float, ...] = (0.025, 0.5, 0.975)
) -> list[float]:
    """Return quantiles of a mixture of normal distributions.

    Examples
    --------
    >>> [round(q, 2) for q in compute_mixed_quantiles(np.ones(2), np.ones(2), np.ones(2))]
    [-0.96, 1.0, 2.96]
    """
    share = weight / weight.sum()
    width = 6.0 * np.maximum(error, 1e-300)
    low, high = np.full(len(levels), (mean - width).min()), np.full(len(levels), (mean + width).max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = ndtr((middle[:, np.newaxis] - mean) / np.maximum(error, 1e-300)) @ share < np.array(levels)
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return [float(value) for value in 0.5 * (low + high)]


def _sum_scope(
    groups: list[Siblings], question: Question, cause: int, place: int, *, full: bool = False
) -> tuple[float, float, float, float]:
    """Return net energy per unit [kWh], measured energy [kWh], distance [km] and days within a scope."""
    net = measured = distance = 0.0
    days = 1.0
    for siblings, weight in zip(groups, make_shift_weights(groups, question, place), strict=True):
        there = weight > 0.0
        net += float((there if full else weight) @ siblings.net[:, cause])
        measured += float(siblings.measured[there].sum())
        distance += float(siblings.distance[there].sum())
        if there.any():
            days = max(days, float(np.ptp(siblings.start[there])) / SECONDS_PER_DAY)
    return net, measured, distance, days


def _list_shifts(question: Question, search: Search, cause: int, place: int) -> list[ShiftSize]:
    """Return the size of a cause in each shift, estimated from this shift alone, for a figure."""
    if question.of != "car":
        return []
    g = next(i for i, there in enumerate(question.members) if there.any())
    siblings = search.groups[g]
    base = SiblingBase(siblings, search.spread)
    scores = base.score_shifts(siblings.cars.index(question.who))
    score, information = scores.score[:, cause], scores.square[:, cause]
    there = np.flatnonzero(question.members[g])
    measured = siblings.measured[there]
    known = (information > 0.0) & (siblings.size[there, cause] > 0.0) & (measured > 0.0)
    unit = np.divide(siblings.net[there, cause], measured, out=np.zeros(len(there)), where=known)
    weight = make_shift_weights(search.groups, question, place)[g][there]
    return [
        ShiftSize(start_s=start, share=u * b / a, error=abs(u) / np.sqrt(a), size=w)
        for start, u, b, a, w in zip(
            siblings.start[there][known], unit[known], score[known], information[known], weight[known], strict=True
        )
    ]


def _format_date(time: float) -> str:
    """Return the UTC date of a Unix time."""
    return datetime.fromtimestamp(float(time), UTC).date().isoformat()
