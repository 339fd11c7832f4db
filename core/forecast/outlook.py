"""What is ahead of a car, and the state of charge that it leads to: from the plan, or from how the car's shifts go.

The energy of a plan's legs is known at every temperature of `core.forecast.expected` when the plan arrives; of the leg
that is being driven, the share that is left by distance counts, and its beginning is past. What is left of the time
until the shift ends is waiting, with an empty way to each ride; a shift whose legs need more time than it has ends with
them. The charge at the end is what there is now, less that energy times what this
car takes over the model; how sure that is follows from the filter (`core.forecast.soc_filter`) for the standard deviation, and
from earlier errors (`core.forecast.conformal`) for the interval.
"""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from core.batch import Floats, Ints
from core.columns import ZERO_CELSIUS
from core.forecast.conformal import LEVELS
from core.forecast.learning.leg_energy import TEMPERATURES, Tables, tents
from core.forecast.soc_filter import NOISE, WANDER
from core.wire.messages import Leg, Plan

EARLY: Final = 600.0
"""Nor does a plan speak of samples that were so much before it. [s]"""
OVERTIME: Final = 1800.0
"""A plan is over so long after its end. [s]"""
FADES: Final = 3.0
"""Time in which all but 1/e is gone of what a car was found to take today: weather, traffic, passengers change. [h]"""
RESERVE: Final = 0.1
"""State of charge that is to be left where no plan says how much. [1]"""
_KNOTS: Final = len(TEMPERATURES)

COURSE: Final = np.dtype(
    [
        ("planned", "f8"),  # 1 where there is a plan whose energy is known
        ("came", "f8"),  # [s]
        ("end", "f8"),  # of the shift [s]
        ("reserve", "f8"),  # [1]
        ("legs", "f8"),  # how many are left
        ("leg_kwh", "f8", (_KNOTS,)),  # of the next leg, at each temperature [kWh]
        ("begun_kwh", "f8", (_KNOTS,)),  # of the same, once it has begun
        ("leg_km", "f8"),
        ("leg_s", "f8"),
        ("driven_km", "f8"),  # of the ride in progress when the plan came
        ("later_kwh", "f8", (_KNOTS,)),  # of all legs after it
        ("later_km", "f8"),
        ("later_s", "f8"),
    ]
)
"""What a plan says of the rest of a shift."""


class Ahead(NamedTuple):
    """What is ahead of n cars, (n,) float each; NaN where nobody knows.

    Parameters
    ----------
    energy : As the model predicts it, with what its errors have taught. [kWh]
    km : Of rides. [km]
    hours : Until the shift ends. [h]
    end : When it does, not before now, nor before what is planned can be driven. [s]
    reserve : State of charge to be left. [1]
    kind : 0 by plan, 1 by habit. [1]
    """

    energy: Floats
    km: Floats
    hours: Floats
    end: Floats
    reserve: Floats
    kind: Ints


class Known(NamedTuple):
    """What the filter knows of n cars, (n,) float each.

    Parameters
    ----------
    soc, variance : State of charge. [1]
    scale, scale_variance, covariance : `a` less `c` of `core.forecast.soc_filter`, and its covariance with the charge.
    usual : What `scale` was expected to be before anything was found today.
    quantum : Of the charge as it is reported. [1]
    capacity : Nominal usable. [kWh]
    """

    soc: Floats
    variance: Floats
    scale: Floats
    scale_variance: Floats
    covariance: Floats
    usual: Floats
    quantum: Floats
    capacity: Floats

    @classmethod
    def of(cls, told: Mapping[str, Floats], capacity: Floats) -> "Known":
        """Return what the filter told (`core.forecast.soc_filter.TOLD`) of cars of these capacities."""
        return cls(capacity=capacity, **{name: told[name] for name in cls._fields[:-1]})

    def later(self, hours: Floats) -> Floats:
        """Return the mean of `scale` over so many hours to come: what was found today fades, towards the usual."""
        spans = np.maximum(hours, 1e-6) / FADES
        return np.asarray(self.usual + (self.scale - self.usual) * -np.expm1(-spans) / spans)


class Usual(NamedTuple):
    """What is usual of n cars at the outside temperature about each.

    Parameters
    ----------
    weights : (n, temperatures) float
        Of the temperatures of `core.forecast.expected`.
    standing : (n,) float
        Power of a car that waits. [kW]
    approach : (n,) float
        Energy of the empty way to a ride, on average, over that of standing as long. [kWh]
    per_km : (n,) float
        Energy of rides and rests over the kilometres of rides. [kWh/km]
    power : (n,) float
        The same over the hours of both. [kW]
    """

    weights: Floats
    standing: Floats
    approach: Floats
    per_km: Floats
    power: Floats


class Outcome(NamedTuple):
    """State of charge at some point ahead, (n,) float each. [1]"""

    mean: Floats
    sd: Floats


class Legs(NamedTuple):
    """The legs of a plan, and what they take.

    Parameters
    ----------
    plan : Plan
    energy : (legs, temperatures) float
        [kWh]
    begun : (legs, temperatures) float
        Of each once it has begun. [kWh]
    km, seconds : (legs,) float
    """

    plan: Plan
    energy: Floats
    begun: Floats
    km: Floats
    seconds: Floats

    @classmethod
    def of(cls, plan: Plan, energy: Floats, begun: Floats) -> "Legs":
        """Return the legs of a plan that take these energies."""
        km = np.array([leg.distance_km for leg in plan.legs], dtype=np.float64)
        seconds = np.array([leg.duration_s for leg in plan.legs], dtype=np.float64)
        return cls(plan, energy.reshape(-1, _KNOTS), begun.reshape(-1, _KNOTS), km, seconds)

    def left(self, done: int, driven_km: float | None = None) -> "Legs":
        """Return the legs that are left once so many are done.

        Of the first, so many kilometres were driven; None where it has not begun.
        """
        legs, energy, begun = self.plan.legs[done:], self.energy[done:].copy(), self.begun[done:].copy()
        if legs and driven_km is not None:
            share = float(share_left(np.array([legs[0].distance_km]), np.array([driven_km]))[0])
            parts = {name: value and share * value for name, value in msgspec.structs.asdict(legs[0]).items()}
            legs = [Leg(**parts), *legs[1:]]
            energy[0] = begun[0] = share * begun[0]
        return Legs.of(msgspec.structs.replace(self.plan, legs=legs), energy, begun)

    def before(self, place: int, other: "Legs") -> "Legs":
        """Return these legs with those of another plan before the one at a place."""
        legs = [*self.plan.legs[:place], *other.plan.legs, *self.plan.legs[place:]]
        parts = zip((self.energy, self.begun), (other.energy, other.begun), strict=True)
        energy, begun = (np.concatenate([own[:place], more, own[place:]]) for own, more in parts)
        return Legs.of(msgspec.structs.replace(self.plan, legs=legs), energy, begun)

    def course(self, done: int, driven_km: float) -> NDArray[np.void]:
        """Return what is left once so many legs are done, and what the ride in progress had driven when it came."""
        out = np.zeros(1, COURSE)[0]
        out["planned"], out["end"], out["reserve"] = 1.0, self.plan.shift_end_s, self.plan.reserve_soc_pct / 100.0
        out["came"], out["driven_km"] = self.plan.time_s, driven_km
        out["legs"] = max(len(self.km) - done, 0)
        if done < len(self.km):
            out["leg_kwh"], out["begun_kwh"] = self.energy[done], self.begun[done]
            out["leg_km"], out["leg_s"] = self.km[done], self.seconds[done]
            out["later_kwh"] = self.energy[done + 1 :].sum(axis=0)
            out["later_km"], out["later_s"] = self.km[done + 1 :].sum(), self.seconds[done + 1 :].sum()
        return out


def legs(plan: Plan, tables: Tables | None) -> Legs:
    """Return the legs of a plan with their energies, by what is expected of the car's model; NaN where nothing is."""
    unknown = np.full((len(plan.legs), _KNOTS), np.nan)
    found = Legs.of(plan, unknown, unknown)
    if tables is None or not plan.legs:
        return found
    climbs = [(leg.gained_m, leg.lost_m) for leg in plan.legs]
    gained, lost = (np.array([np.nan if c[i] is None else c[i] for c in climbs], dtype=np.float64) for i in (0, 1))
    energy, begun = (tables.legs(found.km, found.seconds, gained, lost, begun=begun) for begun in (False, True))
    return found._replace(energy=energy, begun=begun)


def share_left(leg_km: Floats, driven_km: Floats) -> Floats:
    """Return the share of legs that is left when so much of each was driven, (n,). [1]

    Examples
    --------
    >>> share_left(np.array([4.0, 4.0, 0.0]), np.array([1.0, 9.0, 1.0])).tolist()
    [0.75, 0.0, 1.0]
    """
    done = np.divide(np.maximum(driven_km, 0.0), leg_km, out=np.zeros(len(leg_km)), where=leg_km > 0.0)
    return np.asarray(np.clip(1.0 - done, 0.0, 1.0))


def by_plan(courses: NDArray[np.void], time: Floats, ride_km: Floats, riding: NDArray[np.bool_], usual: Usual) -> Ahead:
    """Return what is ahead by plan.

    Parameters
    ----------
    courses : (n,) COURSE
    time : (n,) float
        Now. [s]
    ride_km : (n,) float
        Driven on the ride in progress, 0 between rides. [km]
    riding : (n,) bool
    usual : Usual
    """
    left = np.where(riding, share_left(courses["leg_km"], ride_km - courses["driven_km"]), 1.0)
    driving = left * courses["leg_s"] + courses["later_s"]
    end = np.maximum(courses["end"], time + driving)
    hours = (end - time) / 3600.0
    rest = np.maximum(hours - driving / 3600.0, 0.0)
    whole, begun, later = (_at(courses[name], usual.weights) for name in ("leg_kwh", "begun_kwh", "later_kwh"))
    approaches = courses["legs"] - riding * (courses["legs"] > 0.0)
    resting = rest * usual.standing + approaches * usual.approach
    energy = np.where(riding, left * begun, whole) + later + resting
    known = (courses["planned"] == 1.0) & timely(courses["came"], courses["end"], time)
    return Ahead(
        np.where(known, energy, np.nan),
        np.where(known, left * courses["leg_km"] + courses["later_km"], np.nan),
        np.where(known, hours, np.nan),
        np.where(known, end, np.nan),
        np.where(known, courses["reserve"], np.nan),
        np.zeros(len(time), np.int64),
    )


def _at(energy: Floats, weights: Floats) -> Floats:
    """Return energies that are known at each temperature at the temperatures about each row, (n,)."""
    return np.asarray(np.einsum("ij,ij->i", energy, weights))


def timely(came: Any, end: Any, time: Any) -> Any:
    """Tell whether a plan that came at a time, of a shift that ends at another, speaks of now. [s]"""
    return (time >= came - EARLY) & (time <= end + OVERTIME)


def by_habit(ahead: Ahead, usual: Usual, elapsed: Floats, now: Floats, hours: Floats, busy: Floats) -> Ahead:
    """Return what is ahead by how the car's shifts go, where no plan tells.

    Parameters
    ----------
    ahead : Ahead
        By plan.
    usual : Usual
    elapsed, now : (n,) float
        Time since the shift began, and the time. [s]
    hours, busy : (n,) float
        How long the car's shifts are [h], and the energy of an hour of them over what is usual.
    """
    left = hours - elapsed / 3600.0
    energy = np.where(left > 0.0, busy * usual.power * left, np.nan)
    mine = np.isnan(ahead.energy) & np.isfinite(energy)
    return Ahead(
        np.where(mine, energy, ahead.energy),
        np.where(mine, energy / usual.per_km, ahead.km),
        np.where(mine, left, ahead.hours),
        np.where(mine, now + 3600.0 * left, ahead.end),
        np.where(np.isnan(ahead.reserve), RESERVE, ahead.reserve),
        np.where(mine, 1, ahead.kind),
    )


def reach(known: Known, reserve: Floats, usual: Usual) -> Outcome:
    """Return how far a car gets until its reserve, and the standard deviation before errors are learned from. [km]

    That takes as long as such cars usually do for the energy that is left.
    """
    left = np.maximum(known.soc - reserve, 0.0)
    energy = left * known.capacity
    km = energy / (np.exp(known.later(energy / usual.power)) * usual.per_km)
    own = np.divide(known.variance, left**2, out=np.zeros(len(left)), where=left > 0.0)
    noise = np.divide(NOISE**2, energy, out=np.zeros(len(left)), where=energy > 0.0)
    return Outcome(km, km * np.sqrt(np.maximum(known.scale_variance, 0.0) + own + noise))


def at_end(known: Known, energy: Floats, hours: Floats) -> Outcome:
    """Return the state of charge after an energy, and its standard deviation before anything is learned of errors.

    Notes
    -----
    With the predicted fall D = E / C, the mean falls by exp(a - c) D, where what was found of a - c today fades. The
    variance is that of the charge; D^2 times that of a - c, which wanders on meanwhile; the covariance of both; the
    noise of the energy itself, which grows with its root; and the quantum of what is reported, as the outcome is. D has
    no factor exp(a - c), so that a car that stops telling its charge, and of which less is learned, never counts as
    surer than if it told.
    """
    predicted = energy / known.capacity
    variance = (
        known.variance
        + predicted**2 * (known.scale_variance + WANDER**2 * hours)
        - 2.0 * predicted * known.covariance
        + NOISE**2 * np.maximum(energy, 0.0) / known.capacity**2
        + known.quantum**2 / 12.0
    )
    mean = known.soc - np.exp(known.later(hours)) * predicted
    return Outcome(mean, np.sqrt(np.maximum(variance, known.quantum**2 / 12.0)))


def risk(outcome: Outcome, reserve: Floats, quantiles: Floats) -> Floats:
    """Return the probability that the charge ends below a reserve, by quantiles of the standardised error, (n, levels).

    Beyond the outermost quantiles it falls off to 0, and to 1, within half of what they are from the median.
    """
    at = (reserve - outcome.mean) / outcome.sd
    middle = quantiles[:, len(LEVELS) // 2]
    low, high = 1.5 * quantiles[:, 0] - 0.5 * middle, 1.5 * quantiles[:, -1] - 0.5 * middle
    knots = np.column_stack([low, quantiles, high])
    levels = np.array([0.0, *LEVELS, 1.0])
    place = np.clip((knots <= at[:, np.newaxis]).sum(axis=1) - 1, 0, len(levels) - 2)
    rows = np.arange(len(at))
    width = np.maximum(knots[rows, place + 1] - knots[rows, place], 1e-12)
    share = np.clip((at - knots[rows, place]) / width, 0.0, 1.0)
    found = levels[place] + share * (levels[place + 1] - levels[place])
    return np.where(np.isfinite(at) & np.isfinite(middle), found, np.nan)


def temperature_weights(ambient: Floats) -> Floats:
    """Return the weight of each of `TEMPERATURES` at an outside temperature [K], (n, temperatures)."""
    return tents(np.nan_to_num(ambient - ZERO_CELSIUS, nan=15.0), TEMPERATURES)
