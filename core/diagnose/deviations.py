"""Describe what the inference found of single cars, groups and dates."""

from math import exp, log
from typing import Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from socast.core import effects
from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.diagnose.add.terms import describe_coefficient
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.deviation_words import MONTH, has_certain_size
from socast.core.diagnose.inference.posterior import Inference, LikelyCause
from socast.core.diagnose.inference.window_columns import CAR_DIRECTIONS, SHAPES
from socast.core.diagnose.inference.window_model import CARS
from socast.core.diagnose.records import CarDeviation, CauseProbability, DirectionSpread, RankedCar, ShiftSize
from socast.core.fit.ride_blocks import get_numbers
from socast.core.models.features import EFFECT_PREFIX, SINCE_SCOPE, VEHICLE_SCOPE
from socast.core.records import make_interval
from socast.core.stats.scores import Estimate

CREDIBLE: Final = 0.9
"""Probability that a credible set holds."""


class _Scope(NamedTuple):
    """Hold sums over the windows within the scope of a finding.

    Parameters
    ----------
    net, full : float
        Energy of the effect per unit of its coefficient, as it grows, and at its full size. [kWh]
    measured, distance, days : float
        Measured energy [kWh], distance [km], and time from the first to the last vehicle-day [days].
    """

    net: float
    full: float
    measured: float
    distance: float
    days: float


def list_credible(shares: dict[str, float], level: float = CREDIBLE) -> list[str]:
    """Return the fewest causes that hold a share of the probability, the most probable first.

    Examples
    --------
    >>> list_credible({"tyre_pressure": 0.6, "brake_drag": 0.35, "payload": 0.05})
    ['tyre_pressure', 'brake_drag']
    """
    total = np.cumsum(list(shares.values()))
    return list(shares)[: int(np.searchsorted(total, min(level, total[-1]) - 1e-12)) + 1] if len(shares) else []


def describe_deviations(seen: Windows, inference: Inference, *, dated: bool) -> list[CarDeviation]:
    """Return what distinguishes cars or groups, and what changed; those of certain size first.

    Parameters
    ----------
    dated : bool
        Whether the dates of the rides are known. If they are invented, nothing is said of what began at a date.
    """
    scoped = [one for one in inference.findings if one.family.is_scoped]
    found = [_describe(seen, inference, one) for one in scoped if one.is_likely]
    return sorted((one for one in found if dated or one.since is None), key=lambda one: not has_certain_size(one))


def _describe(seen: Windows, inference: Inference, one: LikelyCause) -> CarDeviation:
    """Return the record of a finding within a scope."""
    family, when, effect = one.family, one.when, effects.get(one.variant)
    coefficient = replace(describe_coefficient(effect, one.size.estimate), plausible=one.is_plausible)  # of either sign
    columns = [f"{EFFECT_PREFIX}{one.variant}"]
    since, limits = None, None
    if family.of == "car":
        columns.append(f"{VEHICLE_SCOPE}{family.who}")
    if when.since is not None:
        since, limits = when.since, _find_dates(one)
        columns.append(f"{SINCE_SCOPE}{since}")
    if when.kind == "ramp" or family.of == "group":
        columns = []  # no term holds a ramp or a group
    scope = _sum_scope(seen, inference, one)
    estimate = one.size.estimate
    share, per_km, per_month = (
        _scale(estimate, scope.net / by) for by in (scope.measured, scope.distance, scope.days / MONTH)
    )
    growth = _scale(estimate, scope.full / scope.measured * MONTH / scope.days) if when.kind == "ramp" else None
    return CarDeviation(
        who=family.who,
        of=family.of,
        kind=when.kind,
        effect=one.effect,
        causes=[
            CauseProbability(
                effect=name,
                probability=one.causes[name],
                shown_by=effects.get(name).shown_by,
            )
            for name in list_credible(one.causes)
        ],
        q=1.0 - one.probability,
        z=estimate.value / estimate.error,
        evidence=_average_evidence(one),
        tests=inference.scoped,
        coefficient=coefficient,
        words=effect.in_words(estimate.value, estimate.ci95),
        since=since,
        since_ci90=limits,
        columns=columns,
        days=scope.days,
        share=share.value,
        share_ci95=make_interval(*share.interval),
        kwh_per_km=per_km.value,
        kwh_per_km_ci95=make_interval(*per_km.interval),
        kwh_per_month=per_month.value,
        kwh_per_month_ci95=make_interval(*per_month.interval),
        share_per_month=None if growth is None else growth.value,
        share_per_month_ci95=None if growth is None else make_interval(*growth.interval),
        shifts=_list_shifts(inference, one) if family.of == "car" else [],
    )


def _average_evidence(one: LikelyCause) -> float:
    """Return the logarithm of the Bayes factor of a family against none, averaged over its alternatives."""
    prior = one.family.prior
    chance = min(max(one.probability, exp(-700.0)), 1.0 - 1e-15)
    return log(chance / (1.0 - chance)) - log(prior / (1.0 - prior))


def _scale(estimate: Estimate, factor: float) -> Estimate:
    """Return an estimate times a factor."""
    return Estimate(estimate.value * factor, abs(factor) * estimate.error, estimate.freedom)


def _find_dates(one: LikelyCause) -> tuple[str, str]:
    """Return the shortest range of dates that holds 90 % of the probability of a change of this form."""
    places = one.family.places
    rows = [at for at, place in enumerate(places) if place.kind == one.when.kind]
    chance = np.array([one.dates.get(at, 0.0) for at in rows])
    total = np.r_[0.0, np.cumsum(chance / max(float(chance.sum()), 1e-300))]
    ends = np.searchsorted(total, total[:-1] + CREDIBLE - 1e-12)
    ends = np.where(ends < len(total), ends, 2 * len(total))
    first = int(np.argmin(ends - np.arange(len(ends))))
    last = min(int(ends[first]) - 1, len(rows) - 1)
    early, late = places[rows[first]], places[rows[last]]
    return str(early.before or early.since), str(late.since)


def _sum_scope(seen: Windows, inference: Inference, one: LikelyCause) -> _Scope:
    """Return sums over the windows within the scope of a finding."""
    columns = inference.columns
    weight = np.zeros(len(columns.start))
    weight[one.family.days] = one.when.weight
    days = weight > 0.0
    rows = days[columns.day]
    at = columns.names.index(one.variant)
    return _Scope(
        net=float(one.column.sum()),
        full=float(columns.effects[rows, at].sum()),
        measured=float(seen.measured[rows].sum()),
        distance=max(float(np.nansum(get_numbers(seen.table, "distance_km")[rows])), 1e-9),
        days=max(1.0, float(np.ptp(columns.start[days])) / SECONDS_PER_DAY),
    )


def _list_shifts(inference: Inference, one: LikelyCause) -> list[ShiftSize]:
    """Return the size of a cause on each day of a car, estimated from this day alone, for a figure."""
    columns, model = inference.columns, inference.model
    at = columns.names.index(one.variant)
    without = np.delete(model.known, [k for k in range(model.known.shape[1]) if _is_same(model.known[:, k], one)], 1)
    alone = model.add(without)
    energy = columns.effects[:, [at]]
    sums = alone.sum_days(energy)
    source, place = alone.coordinates
    source = np.append(source[:-1], sums.shape[1] - 1)
    by_place = np.append(-alone.coefficients * alone.scale[:-1], 1.0)[place]
    own = sums.shape[1] - 2
    score = (sums[:, own][:, source] * by_place).sum(axis=1)
    information = sums[:, own, own]
    amount, measured = columns.sum_days(energy[:, 0]), columns.sum_days(columns.measured)
    out = []
    for day, weight in zip(one.family.days.tolist(), one.when.weight.tolist(), strict=True):
        if information[day] <= 0.0 or measured[day] <= 0.0 or amount[day] == 0.0:
            continue
        unit = amount[day] / measured[day]
        size, error = unit * score[day] / information[day], abs(unit) / float(np.sqrt(information[day]))
        out.append(ShiftSize(start_s=float(columns.start[day]), share=size, error=error, size=weight))
    return out


def _is_same(known: Floats, one: LikelyCause) -> bool:
    """Return whether a known column is that of a finding, apart from its unit."""
    size = float(np.sqrt((known @ known) * (one.column @ one.column)))
    return size > 0.0 and abs(float(known @ one.column)) > (1.0 - 1e-9) * size


def rank_cars(inference: Inference) -> list[RankedCar]:
    """Return each car with its deviations in spreads between cars, the one that deviates most first."""
    columns, model = inference.columns, inference.model
    if not model.has_cars:
        return []
    names = (*SHAPES, *CAR_DIRECTIONS)
    width = len(names)
    mean = model.coefficients[model.car_effects].reshape(-1, width)
    covariance = model.covariance()[model.car_effects, model.car_effects]
    spread = np.exp(model.log_spread[CARS])
    loads = np.column_stack([columns.shapes, columns.directions])
    by_day = np.array([columns.sum_days(load) for load in loads.T]).T
    measured = columns.sum_days(columns.measured)
    rows = []
    for car, name in enumerate(columns.cars):
        days = columns.car_of_day == car
        siblings = len({int(c) for c in columns.car_of_day[columns.kind_of_day == columns.kind_of_day[days][0]]}) - 1
        own = slice(car * width, (car + 1) * width)
        energy = by_day[days].sum(axis=0) / max(float(measured[days].sum()), 1e-9) * spread
        share = Estimate(
            float(energy @ mean[car]), float(np.sqrt(energy @ covariance[own, own] @ energy)), float("inf")
        )
        found = [one for one in inference.findings if one.family.who == name and one.when.kind == "always"]
        rows.append(
            RankedCar(
                car=name,
                siblings=siblings,
                evidence=_average_evidence(found[0]) if found else None,
                share=share.value,
                share_ci95=make_interval(*share.interval),
                share_spread=float(np.sqrt((energy**2).sum())),
                spreads=[
                    DirectionSpread(direction=direction, value=value, error=float(np.sqrt(variance)))
                    for direction, value, variance in zip(
                        names, mean[car].tolist(), np.diag(covariance[own, own]).tolist(), strict=True
                    )
                ],
            )
        )
    return sorted(rows, key=lambda row: -max(abs(each.value) for each in row.spreads))
