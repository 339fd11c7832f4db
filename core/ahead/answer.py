"""The answer to a question: what a ride would take, and what it would leave of the shift.

The ride that is asked for comes first, after what is left of the ride in progress; then the other legs of the plan,
with the rest of the time spread evenly before them. Without a plan, the shift goes on after the ride as the car's
shifts go.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from core.ahead import outlook, soc
from core.ahead.outlook import Ahead, Known, Usual
from core.ahead.plans import refusal
from core.batch import Floats
from core.cars import Cars
from core.codec import Interval, Leg, LegOutlook, Outlook, Plan
from core.columns import ZERO_CELSIUS
from core.errors import AskError

if TYPE_CHECKING:
    from core.ahead.foresight import Foresight


SHOWN: Final = 0.05
"""Standard deviation of what a car shows as full against what its battery holds, as a share: by cold, age and gauge.
Estimated: so much is told beside what the filter has learned, which cannot know it."""


class Prospect:
    """What is known of a car now, and what follows for energies ahead of it.

    Parameters
    ----------
    foresight : Foresight
    cars : Cars
    lane : int
    """

    def __init__(self, foresight: "Foresight", cars: Cars, lane: int) -> None:
        self.state = foresight.state[lane]
        told = np.empty(len(soc.TOLD))
        soc.tell(self.state, told)
        self.told = dict(zip(soc.TOLD, told.tolist(), strict=True))
        kinds = cars.of_lane[[lane]]
        self.known = Known.of({name: np.array([value]) for name, value in self.told.items()}, cars.capacity[kinds])
        ambient = np.array([self.told["ambient"]])
        self.time = float(self.state["time"])
        self.usual: Usual = foresight.lessons.usual(kinds, outlook.temperature_weights(ambient))
        self.celsius = ambient - ZERO_CELSIUS
        self.tables = foresight.lessons.tables(lane)
        self.conformal, self.lean = foresight.lessons.conformal, float(foresight.lessons.lean.factor[0])

    def energy(self, legs: Sequence[Leg]) -> Floats:
        """Return the energy of legs at the temperature of now, by the model, (legs,). [kWh]"""
        if self.tables is None:
            return np.full(len(legs), np.nan)
        plan = Plan("", 0.0, 0.0, 0.0, list(legs))
        return np.asarray(self.lean * (outlook.legs(plan, self.tables).energy @ self.usual.weights[0]))

    def rest(self, hours: float, approaches: int) -> float:
        """Return the energy of waiting, and of so many empty ways to rides. [kWh]"""
        return self.lean * float(hours * self.usual.standing[0] + approaches * self.usual.approach[0])

    def soc(self, energy: float, hours: float, kind: int = 0) -> tuple[Interval | None, outlook.Outcome, Floats]:
        """Return the charge after an energy [%], the same before errors are learned from, and quantiles of these."""
        end = outlook.at_end(self.known, np.array([energy]), np.array([hours]))
        errors, bounds = self.conformal.quantiles(np.array([kind]), energy / self.usual.per_km, self.celsius)
        return _interval(*(100.0 * np.clip(end.mean + end.sd * bounds[0], 0.0, 1.0)).tolist()), end, errors

    def leg(self, leg: Leg, energy: float, before: float, hours: float) -> LegOutlook:
        """Return what is expected of a leg that takes an energy, after another, so many hours ahead."""
        kind = 0 if np.isfinite(self.conformal.bounds[0]).any() else 1  # errors by habit, in a fleet without plans
        charge, _, _ = self.soc(before + energy, hours, kind)
        own = self.known._replace(variance=np.zeros(1), covariance=np.zeros(1), soc=np.zeros(1), quantum=np.zeros(1))
        end = outlook.at_end(own, np.array([energy]), np.array([leg.duration_s / 3600.0]))
        _, bounds = self.conformal.quantiles(np.array([kind]), energy / self.usual.per_km, self.celsius)
        mean, most, least = (-self.known.capacity[0] * (end.mean + end.sd * bounds[0])).tolist()
        return LegOutlook(leg.distance_km, leg.duration_s, _interval(mean, least, most), charge)


def answer(
    foresight: "Foresight", cars: Cars, lane: int, name: str, version: str, leg: Leg | None, plan: Plan | None
) -> Outlook:
    """Return what is expected of the rest of a shift.

    Parameters
    ----------
    foresight : Foresight
    cars : Cars
    lane : int
    name : str
        Of the vehicle.
    version : str
        Name and version of the model.
    leg : Leg, optional
        That is asked for.
    plan : Plan, optional
        To be answered instead of the one that is known.

    Raises
    ------
    AskError
        For a plan that cannot be used.
    """
    now = Prospect(foresight, cars, lane)
    if plan is not None and (refused := refusal(plan, now.time)) is not None:
        raise AskError(refused.words, refused.cause)
    left, plan = _legs(foresight, lane, now.time, plan)
    underway = left[:1] if foresight.courses.riding(lane) and plan is not None else []
    legs = [*underway, *([leg] if leg is not None else []), *left[len(underway) :]]
    hours = 0.0 if plan is None else max(plan.shift_end_s - now.time, 0.0) / 3600.0
    pauses = max(hours - sum(each.duration_s for each in legs) / 3600.0, 0.0)
    later = len(left) - len(underway)
    pause = pauses / later if later else 0.0
    energies = now.energy(legs)
    told, spent, passed, km = [], 0.0, 0.0, 0.0
    for number, (each, energy) in enumerate(zip(legs, energies.tolist(), strict=True)):
        if number >= len(legs) - later:
            spent, passed = spent + now.rest(pause, 1), passed + pause
        passed, km = passed + each.duration_s / 3600.0, km + each.distance_km
        told.append(now.leg(each, energy, spent, passed))
        spent += energy
    spent += 0.0 if later else now.rest(pauses, 0)
    ahead = _ahead(foresight, now, plan, lane, (spent, km, passed if plan is None else hours))
    end, raw, errors = now.soc(float(ahead.energy[0]), float(ahead.hours[0]), int(ahead.kind[0]))
    danger = float(outlook.risk(raw, ahead.reserve, errors)[0])
    asked = len(underway) if leg is not None else None
    capacity = float(now.known.capacity[0] * np.exp(now.state["c"]))
    return Outlook(
        vehicle_id=name,
        time_s=now.time,
        model=version,
        soc_pct=_known(100.0 * now.told["soc"]),
        soc_sd_pct=_known(100.0 * max(float(np.sqrt(now.told["variance"])), soc.FLOOR)),
        usable_capacity_kwh=_known(capacity),
        usable_capacity_sd_kwh=_known(capacity * float(np.hypot(np.sqrt(now.state["cc"]), SHOWN))),
        consumption_scale=_known(float(np.exp(now.state["a"]))),
        asked=None if asked is None else told[asked],
        legs=[each for number, each in enumerate(told) if number != asked],
        shift_end_s=_known(float(ahead.end[0])),
        soc_end_of_shift_pct=end,
        reserve_soc_pct=100.0 * float(ahead.reserve[0]),
        reserve_risk=_known(danger),
        why_not=_why_not(now, end, plan is not None or np.isfinite(ahead.energy[0])),
    )


def _legs(foresight: "Foresight", lane: int, time: float, given: Plan | None) -> tuple[list[Leg], Plan | None]:
    """Return the legs that remain, of the plan that is given or of the one that is known, and that plan."""
    if given is not None:
        return list(given.legs), given
    known = foresight.courses.left(lane)
    if known is None or not outlook.timely(known[0].time_s, known[0].shift_end_s, time):
        return [], None
    return known[1], known[0]


def _ahead(
    foresight: "Foresight", now: Prospect, plan: Plan | None, lane: int, planned: tuple[float, float, float]
) -> Ahead:
    """Return what is ahead until the shift ends: as planned, else the ride asked for and what is usual after it."""
    energy, km, hours = (np.array([value]) for value in planned)
    time, unknown, none = np.array([now.time]), np.array([np.nan]), np.zeros(1, np.int64)
    if plan is not None:
        end, reserve = np.array([plan.shift_end_s]), np.array([plan.reserve_soc_pct / 100.0])
        return Ahead(energy, km, hours, end, reserve, none)
    nothing = Ahead(unknown, unknown, unknown, unknown, unknown, none)
    after = time + 3600.0 * hours
    habits = foresight.lessons.habits_of(np.array([lane]))
    usual = outlook.by_habit(nothing, now.usual, after - now.told["begin"], after, *habits)
    if not km[0]:
        return usual
    if np.isnan(usual.energy[0]) and np.isfinite(habits[0][0]):  # the ride is all that is known to come
        return Ahead(energy, km, hours, after, usual.reserve, none + 1)
    return usual._replace(energy=usual.energy + energy, km=usual.km + km, hours=usual.hours + hours)


def _why_not(now: Prospect, end: Interval | None, ahead: bool) -> str | None:
    """Return why a figure is not known, the deepest reason first; None where all are."""
    if end is not None:
        return None
    if not np.isfinite(now.told["soc"]):
        return "the car reports no state of charge"
    if now.tables is None:
        return "no day of rides of this vehicle model has been learned from yet"
    if not ahead:
        return "no plan is known, and too few shifts of this car to tell how they go"
    return "too few shifts have ended to tell how far off forecasts are"


def _interval(mean: float, low: float, high: float) -> Interval | None:
    """Return an interval, None where it is not known."""
    return Interval(mean, low, high) if np.isfinite(mean) and np.isfinite(low) and np.isfinite(high) else None


def _known(value: float) -> float | None:
    """Return a number, None where it is not known."""
    return value if np.isfinite(value) else None
