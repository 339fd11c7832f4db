"""The answer to a question: what a ride would take, and what it would leave of the shift.

The ride that is asked for comes first, after what is left of the ride in progress and an empty way as usual; then the
other legs of the plan, with the rest of the time spread evenly before them. A plan does not tell when a leg begins; but
where such waits would be longer than usual, they are as usual and the rest of the time comes after the last leg: a car
with hours to spare mostly spends them at a charger. How long a single wait is varies as much as waits last on average,
as it does where rides are called for at any time. Without a plan, the shift goes on after the ride as the car's shifts
go. What is left, what it takes and the charge that it leads to are those of the forecast (`core.forecast.outlook`):
without a ride the answer is the forecast, and with one it is what the forecast would be, had a plan with that ride
come.
"""

from math import inf
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np

from core.batch import Floats, Ints
from core.columns import ZERO_CELSIUS
from core.errors import AskError
from core.forecast import outlook, soc_filter
from core.forecast.outlook import RESERVE, Ahead, Known, Legs, Outcome, Usual
from core.forecast.plan_checks import refusal
from core.forecast.plan_tracker import LONGEST_SHIFT
from core.wire.messages import Interval, Leg, LegOutlook, Outlook, Plan

if TYPE_CHECKING:
    from core.forecast.engine import Foresight


_ROUNDED: Final = 1e-9  # kWh


class Prospect:
    """What is known of a car now, and what follows for energies ahead of it.

    Parameters
    ----------
    foresight : Foresight
    lane : int
    """

    def __init__(self, foresight: "Foresight", lane: int) -> None:
        cars = foresight.context.cars
        self.state = foresight.state[lane]
        told = np.empty(len(soc_filter.TOLD))
        soc_filter.tell(self.state, told)
        self.told = dict(zip(soc_filter.TOLD, told.tolist(), strict=True))
        kinds = cars.of_lane[[lane]]
        self.known = Known.of({name: np.array([value]) for name, value in self.told.items()}, cars.capacity[kinds])
        ambient = np.array([self.told["ambient"]])
        self.time = float(self.state["time"])
        self.usual: Usual = foresight.lessons.usual(kinds, outlook.temperature_weights(ambient))
        self.celsius = ambient - ZERO_CELSIUS
        self.tables = foresight.lessons.tables(lane)
        self.pause = inf if self.tables is None else self.tables.pause
        self.conformal, self.lean = foresight.lessons.conformal, foresight.lessons.lean.factor

    def charge(
        self, energy: Floats, hours: Floats, kind: Ints, doubt: Floats | float = 0.0
    ) -> tuple[Floats, Outcome, Floats]:
        """Return the charge after energies [kWh], so many hours ahead, by plan (0) or by habit (1).

        Parameters
        ----------
        energy, hours : (n,) float
        kind : (n,) int
        doubt : (n,) float
            Standard deviation of the energies, as it is not known what will have been by then. [kWh]

        Returns
        -------
        (n, 3) float
            Mean, 5th and 95th percentile. [%]
        Outcome
            The same before errors are learned from.
        (n, levels) float
            Quantiles of these errors.
        """
        errors, bounds = self._errors(energy, kind)
        end = outlook.at_end(self.known, energy, hours)
        end = end._replace(sd=np.hypot(end.sd, doubt / self.known.capacity))
        percent = 100.0 * np.clip(end.mean[:, np.newaxis] + end.sd[:, np.newaxis] * bounds, 0.0, 1.0)
        return percent, end, errors

    def taken(self, legs: Legs, energy: Floats, kind: Ints) -> Floats:
        """Return what legs take from the battery by themselves: mean, 5th and 95th percentile, (n, 3). [kWh]"""
        own = self.known._replace(variance=np.zeros(1), covariance=np.zeros(1), soc=np.zeros(1), quantum=np.zeros(1))
        end = outlook.at_end(own, energy, legs.seconds / 3600.0)
        _, bounds = self._errors(energy, kind)
        out = -self.known.capacity[0] * (end.mean[:, np.newaxis] + end.sd[:, np.newaxis] * bounds[:, [0, 2, 1]])
        least = np.array([-np.inf if leg.lost_m else 0.0 for leg in legs.plan.legs])  # only descents give anything
        return np.asarray(np.maximum(out, least[:, np.newaxis]))

    def _errors(self, energy: Floats, kind: Ints) -> tuple[Floats, Floats]:
        """Return quantiles of the errors of forecasts of energies, and the bounds of what is likely."""
        return self.conformal.quantiles(kind, energy / self.usual.per_km, np.repeat(self.celsius, len(energy)))


class Way(NamedTuple):
    """What is to be driven: legs, whether the first is under way, and the place of the one that was asked for."""

    legs: Legs
    underway: bool
    asked: int | None

    @classmethod
    def of(cls, left: Legs, underway: bool, leg: Leg | None, now: Prospect) -> "Way":
        """Return what is left of a plan, with the ride that is asked for first, but after the leg under way."""
        if leg is None:
            return cls(left, underway, None)
        asked = outlook.legs(Plan("", now.time, now.time, 0.0, [leg]), now.tables)
        return cls(left.before(int(underway), asked), underway, int(underway))

    def ahead(self, now: Prospect) -> Ahead:
        """Return what is ahead until the shift ends, as a forecast has it."""
        none, time = np.zeros(1), np.array([now.time])
        ahead = outlook.by_plan(self.legs.course(0, 0.0).reshape(1), time, none, np.array([self.underway]), now.usual)
        return ahead._replace(energy=now.lean[0] * ahead.energy)

    def outlooks(self, now: Prospect, ahead: Ahead, end: Floats) -> list[LegOutlook]:
        """Return what is expected of each leg, with `ahead` of the whole shift and the charge (1, 3) at its end [%]."""
        place, hours = np.arange(len(self.legs.km)), self.legs.seconds / 3600.0
        waits = place >= self.underway + (self.asked is not None)
        spare = max(float(ahead.hours[0]) - float(hours.sum()), 0.0)
        pause = waits * min(spare / max(int(waits.sum()), 1), now.pause)
        energy = now.lean[0] * (self.legs.energy @ now.usual.weights[0])
        rest = now.lean[0] * (pause * now.usual.standing + (place >= self.underway) * now.usual.approach)
        spent = np.cumsum(rest + energy)
        by_habit = not np.isfinite(now.conformal.bounds[0]).any()  # in a fleet without plans
        kind = np.full(len(place), int(by_habit))
        doubt = now.usual.standing * np.sqrt(np.cumsum(pause**2))
        charge, _, _ = now.charge(spent, np.cumsum(pause + hours), kind, doubt)
        charge = falling(np.vstack([charge, end]), np.append(spent, ahead.energy))
        rows = zip(self.legs.plan.legs, now.taken(self.legs, energy, kind).tolist(), charge.tolist(), strict=False)
        return [LegOutlook(leg.distance_km, leg.duration_s, _interval(*kwh), _interval(*soc)) for leg, kwh, soc in rows]


def falling(charge: Floats, spent: Floats) -> Floats:
    """Return charges ahead that do not rise where energy is taken: what is left later was there before.

    Intervals are learned by distance, each for itself, so that a later one may be surer. The last one stays as it is;
    those before it are raised to it, as what falls below them takes the one after them below it.

    Parameters
    ----------
    charge : (n, m) float
        Means and percentiles, one point after another; NaN where they are not known.
    spent : (n,) float
        Energy until then, which falls where a descent gives back more than the way takes. [kWh]

    Returns
    -------
    (n, m) float

    Examples
    --------
    >>> falling(np.array([[50.0], [40.0], [42.0], [41.0]]), np.array([1.0, 2.0, 3.0, 2.5])).tolist()
    [[50.0], [42.0], [42.0], [41.0]]
    """
    out = charge.copy()
    for i in reversed(range(len(out) - 1)):
        if spent[i + 1] >= spent[i] - _ROUNDED:
            out[i] = np.where(np.isnan(out[i]), out[i], np.fmax(out[i], out[i + 1]))
    return out


def answer(foresight: "Foresight", lane: int, leg: Leg | None, plan: Plan | None) -> Outlook:
    """Return what is expected of the rest of a shift.

    Parameters
    ----------
    foresight : Foresight
    lane : int
    leg : Leg, optional
        That is asked for.
    plan : Plan, optional
        To be answered instead of the one that is known.

    Raises
    ------
    AskError
        For a plan that cannot be used, or is of a later shift than the one under way.
    """
    now = Prospect(foresight, lane)
    if plan is not None and (refused := refusal(plan, now.time, LONGEST_SHIFT)) is not None:
        raise AskError(refused.words, refused.cause)
    courses = foresight.courses
    left = courses.left(lane, now.time, plan, now.tables)
    nothing = outlook.legs(Plan("", now.time, now.time, 100.0 * RESERVE, []), now.tables)
    way = Way.of(left or nothing, left is not None and courses.riding(lane) and len(left.km) > 0, leg, now)
    habits = foresight.lessons.habits_of(np.array([lane]))
    ahead = way.ahead(now) if left is not None else _unplanned(way.ahead(now), leg is not None, now, *habits)
    charge, raw, errors = now.charge(ahead.energy, ahead.hours, ahead.kind)
    told, end = way.outlooks(now, ahead, charge), _interval(*charge[0].tolist())
    danger = float(outlook.risk(raw, ahead.reserve, errors)[0])
    capacity = float(now.known.capacity[0] * np.exp(now.state["c"]))
    return Outlook(
        vehicle_id=foresight.context.vehicle_ids[lane],
        time_s=now.time,
        model=foresight.context.model_label,
        soc_pct=_known(100.0 * now.told["soc"]),
        soc_sd_pct=_known(100.0 * max(float(np.sqrt(now.told["variance"])), soc_filter.FLOOR)),
        usable_capacity_kwh=_known(capacity),
        usable_capacity_sd_kwh=_known(capacity * float(np.hypot(np.sqrt(now.state["cc"]), soc_filter.METER))),
        consumption_scale=_known(float(np.exp(now.state["a"]))),
        asked=None if way.asked is None else told[way.asked],
        legs=[each for number, each in enumerate(told) if number != way.asked],
        shift_end_s=_known(float(ahead.end[0])),
        soc_end_of_shift_pct=end,
        reserve_soc_pct=100.0 * float(ahead.reserve[0]),
        reserve_risk=_known(danger),
        why_not=_why_not(now, end, _unknown(left is not None, ahead, lane in courses.later, *habits)),
    )


def silenced(told: Outlook, silent_s: float) -> Outlook:
    """Return an answer of a car that has been silent for so long that its shift is over.

    Nobody knows what it did meanwhile: whether it drove on or charged. What a ride takes is still told.
    """
    asked, *legs = (each and msgspec.structs.replace(each, soc_pct=None) for each in (told.asked, *told.legs))
    return msgspec.structs.replace(
        told,
        asked=asked,
        legs=legs,
        shift_end_s=None,
        soc_end_of_shift_pct=None,
        reserve_risk=None,
        why_not=f"the car has been silent for {silent_s / 3600.0:.1f} h while others went on, so its shift is over",
    )


def _unplanned(ride: Ahead, asked: bool, now: Prospect, hours: Floats, busy: Floats) -> Ahead:
    """Return what is ahead without a plan: the ride that is asked for, if any, and what is usual of the car after it.

    `hours` and `busy` are how long the car's shifts are, and how busy. Where the shift is longer, the ride is all that
    is known to come.
    """
    unknown = np.array([np.nan])
    nothing = Ahead(unknown, unknown, unknown, unknown, unknown, np.zeros(1, np.int64))
    usual = outlook.by_habit(nothing, now.usual, ride.end - now.told["begin"], ride.end, hours, busy)
    if np.isfinite(usual.energy[0]):
        energy = ride.energy + now.lean[1] * usual.energy
        return usual._replace(energy=energy, km=ride.km + usual.km, hours=ride.hours + usual.hours)
    return ride._replace(kind=ride.kind + 1) if asked and np.isfinite(hours[0]) else usual


def _unknown(planned: bool, ahead: Ahead, later: bool, hours: Floats, busy: Floats) -> str | None:
    """Return why it is not known what is ahead; None where it is."""
    if planned or np.isfinite(ahead.energy[0]):
        return None
    plan = "the plan that is known is of a later shift" if later else "no plan is known"
    if np.isfinite(hours[0] * busy[0]):
        return f"{plan}, and this shift is longer than those of this car usually are"
    return f"{plan}, and too few shifts of this car to tell how they go"


def _why_not(now: Prospect, end: Interval | None, unknown: str | None) -> str | None:
    """Return why a figure is not known, the deepest reason first; None where all are."""
    if end is not None:
        return None
    if not np.isfinite(now.told["soc"]):
        return "the car reports no state of charge"
    if now.tables is None:
        return "no day of rides of this vehicle model has been learned from yet"
    return unknown or "too few shifts have ended to tell how far off forecasts are"


def _interval(mean: float, low: float, high: float) -> Interval | None:
    """Return an interval, None where it is not known."""
    return Interval(mean, low, high) if np.isfinite(mean) and np.isfinite(low) and np.isfinite(high) else None


def _known(value: float) -> float | None:
    """Return a number, None where it is not known."""
    return value if np.isfinite(value) else None
