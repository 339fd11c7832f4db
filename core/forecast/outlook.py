"""Energy ahead of a car, by plan or by its earlier shifts, and the state of charge that it leads to.

The energy of a plan's legs is computed at each knot of temperature when the plan arrives
(`socast.core.forecast.learning.leg_energy`). Of the leg in progress, the share of the remaining distance counts, and
its beginning is past. The rest of the time until the end of the shift is waiting, with an empty way to each ride. A
shift whose legs need more time than it has ends when they are done.

The charge at the end is the present charge less that energy times the consumption factor of the car. The filter
(`socast.core.forecast.soc_filter`) provides the standard deviation, and earlier errors
(`socast.core.forecast.conformal`) the interval.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, replace_nan, sum_weighted
from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.conformal import BY_HISTORY, BY_PLAN, LEVELS, TO_CHARGE
from socast.core.forecast.learning.consumption_terms import TEMPERATURES, compute_knot_weights
from socast.core.forecast.learning.plan_outcomes import WAY_HOME
from socast.core.forecast.learning.shift_patterns import expect_rest
from socast.core.forecast.planned_legs import compute_share_left
from socast.core.forecast.soc_filter import CONSUMPTION_WANDER, ENERGY_SD
from socast.core.forecast.soc_reading import READING_SD

PLAN_LEAD: Final = 600.0
"""A plan applies to samples from this time before it was sent. [s]"""
GRACE: Final = 900.0
"""Time after the end of a plan in which rides that are late are still driven. [s]"""
OVERTIME: Final = 1800.0
"""A plan applies until this time after its end. [s]"""
FACTOR_DECAY_TIME: Final = 3.0
"""Time constant of the return of the day's consumption factor to the usual; weather, traffic and load change. [h]"""
RANGE_ITERATIONS: Final = 3
"""Number of iterations of the mean consumption factor over the range; the third changes it by less than 1e-3."""
LEAST_SLOPE: Final = 0.2
"""Least energy of a percent of a display over that of the mean percent; none of a car is as uneven. [1]"""
DEFAULT_RESERVE: Final = 0.1
"""State of charge to keep where no plan defines it. [1]"""


class EnergyAhead(NamedTuple):
    """Hold energy and time until the next planned charge of n cars, or else the end of their shifts, (n,) each.

    What is unknown is NaN.

    Parameters
    ----------
    energy, sd : Energy, and its standard deviation beside that of the level of the shift. [kWh]
    planned : Energy of each of `PLAN_PARTS`, before the shares that `PlanOutcomes` learns, (n, parts) float; NaN
        without a plan. [kWh]
    km : Distance of rides. [km]
    hours : Time until then. [h]
    end : When the shift ends, not before now nor before the planned legs can be driven. [s]
    reserve : State of charge to keep. [1]
    basis : `BY_PLAN`, `TO_CHARGE` or `BY_HISTORY`, (n,) int.
    """

    energy: Floats
    sd: Floats
    planned: Floats
    km: Floats
    hours: Floats
    end: Floats
    reserve: Floats
    basis: Ints


class CarEstimate(NamedTuple):
    """Hold what `SOC_ESTIMATE` says of n cars, and their nominal usable capacities [kWh], (n,) float each."""

    soc: Floats
    variance: Floats
    log_factor: Floats
    log_factor_variance: Floats
    covariance: Floats
    usual: Floats
    quantum: Floats
    curve: Floats
    capacity: Floats

    @classmethod
    def from_filter(cls, estimates: NDArray[np.void], capacity: Floats) -> "CarEstimate":
        """Return the estimates of cars of these capacities [kWh], from (n,) SOC_ESTIMATE."""
        return cls(capacity=capacity, **{name: estimates[name] for name in cls._fields if name != "capacity"})

    def compute_mean_log_factor(self, hours: Floats) -> Floats:
        """Return the mean of `log_factor` over the next hours, while it decays towards the usual.

        Units: hours [h].
        """
        spans = np.maximum(hours, 1e-6) / FACTOR_DECAY_TIME
        return np.asarray(self.usual + (self.log_factor - self.usual) * -np.expm1(-spans) / spans)


def compute_soc_sd(estimate: CarEstimate) -> Floats:
    """Return the standard deviation of the present charge, NaN where the charge is unknown. [1]"""
    sd = np.sqrt(np.maximum(estimate.variance, READING_SD**2))
    return np.where(np.isnan(estimate.soc), np.nan, sd)


def compute_charge_between(upper: Any, lower: Any, curve: Any) -> Any:
    """Return the energy between two charges of a display with a curve, over the capacity. [1]

    Examples
    --------
    >>> round(compute_charge_between(1.0, 0.5, 0.1), 3), round(compute_charge_between(0.5, 0.0, 0.1), 3)
    (0.525, 0.475)
    """
    return (upper - lower) * (1.0 + curve * (upper + lower - 1.0))


def lower_charge(soc: Floats, energy: Floats, curve: Floats) -> Floats:
    """Return the charge of a display with a curve after an energy, over the capacity: the inverse of the above. [1]

    Examples
    --------
    >>> lower_charge(np.ones(2), np.array([0.525, 0.5]), np.array([0.1, 0.0])).round(3).tolist()
    [0.5, 0.5]
    """
    level = compute_charge_between(soc, 0.0, curve) - energy
    slope = 1.0 - curve
    root = np.sqrt(np.maximum(slope**2 + 4.0 * curve * level, LEAST_SLOPE**2))
    return np.asarray(2.0 * level / (slope + root))


class MeanAndSd(NamedTuple):
    """Hold mean and standard deviation of a quantity ahead of n cars, (n,) float each."""

    mean: Floats
    sd: Floats


class UsualConsumption(NamedTuple):
    """Hold the usual consumption of n cars at their outside temperatures, (n,) float each.

    Parameters
    ----------
    weights : Weights of the knots of temperature, (n, temperatures) float. [1]
    standing_power, ..., level_sd : Values of `LegEnergyTables` of the same names.
    warm_up_energy : That which is left of the warm-up of the shift. [kWh]
    covariance : The same as `LegEnergyTables.parts_covariance`, (n, 2, 2) float. [1]
    plan_factor, plan_covariance, plan_spread : Factor, covariance and variance of `PlanOutcomes`, (n, parts),
        (n, parts, parts) and (n,) float.
    """

    weights: Floats
    standing_power: Floats
    approach_energy: Floats
    warm_up_energy: Floats
    energy_per_km: Floats
    mean_power: Floats
    driving_energy_per_km: Floats
    ride_pace: Floats
    level_sd: Floats
    covariance: Floats
    plan_factor: Floats
    plan_covariance: Floats
    plan_spread: Floats

    def weigh(self, energy: Floats) -> Floats:
        """Return the energies of cars at the knots of temperature, interpolated to their temperatures. [kWh]"""
        return sum_weighted(energy, self.weights)

    def compute_parts(self, driving: Floats, waiting: Floats, spare: Floats) -> Floats:
        """Return the energy of each of `PLAN_PARTS`, with a way home as far as the spare time allows, (n, parts). [kWh]

        Units: driving [kWh], waiting [kWh], spare [h].
        """
        way_home = np.minimum(WAY_HOME, 60.0 * spare / self.ride_pace) * self.driving_energy_per_km
        return np.column_stack([driving, waiting, way_home])

    def expect_plan(self, parts: Floats) -> MeanAndSd:
        """Return the energy of what is done of a plan, where `parts` are as in `compute_parts`. [kWh]

        With a consumption of one car, any number of plans may be asked for.
        """
        driving, waiting, way_home = (parts * self.plan_factor).T
        energy = driving + waiting + way_home
        variance = self.plan_spread * np.maximum(energy, 0.0)
        for covariance, each in (
            (self.covariance, np.column_stack([driving + way_home, waiting])),
            (self.plan_covariance, parts),
        ):
            of_rows = np.broadcast_to(covariance, (len(parts), *covariance.shape[1:]))
            variance += sum_weighted(sum_weighted(of_rows, each), each)
        return MeanAndSd(energy, np.sqrt(np.maximum(variance, 0.0)))


class PlanTimes(NamedTuple):
    """Hold how the rest of the shifts of n cars is spent by plan, (n,) each.

    Parameters
    ----------
    end : When the shift ends. [s]
    left : Share of the next leg that is left. [1]
    kept : Share of the rides not begun for which there is time until the end; 1 in plans with charges. [1]
    approaches : Number of empty ways to the rides not begun, until the next planned charge. [1]
    pause : Mean wait before a leg, in plans with charges. [h]
    waits : Number of these waits until the next planned charge. [1]
    waiting : Waits until the next planned charge, or else the end of the shift. [h]
    until : Time until then. [h]
    after : Time from the last planned charge to the end of the shift. [h]
    waiting_after : Waits in that time. [h]
    """

    end: Floats
    left: Floats
    kept: Floats
    approaches: Floats
    pause: Floats
    waits: Floats
    waiting: Floats
    until: Floats
    after: Floats
    waiting_after: Floats


def schedule_plan(
    progress: NDArray[np.void],
    time: Floats,
    ride_km: Floats,
    riding: NDArray[np.bool_],
    charging_since: Floats,
    *,
    drives_all: bool = False,
) -> PlanTimes:
    """Return how the rest of a shift is spent by plan.

    A plan does not state when a leg begins. Without charges, what matters is the time that remains for waiting. With
    charges it is spread evenly before the rides and charges. Rides that have not begun, and for which there is no time
    left, will not come: their passengers did not, or another car took them, unless the car `drives_all`.

    Units: charging_since [s] of a car that stands at a charger, NaN for others.
    """
    left = np.where(riding, compute_share_left(progress["leg_km"], ride_km - progress["driven_km"]), 1.0)
    begun = riding * left * progress["leg_s"]
    pending = ~riding * progress["leg_s"] + progress["later_s"]
    room = np.maximum(progress["end"] + GRACE - time - begun, 0.0)
    in_time = np.divide(room, pending, out=np.ones(len(time)), where=pending > room)
    kept = np.where(drives_all | (progress["charges"] > 0.0), 1.0, in_time)
    driving = begun + kept * pending
    charging = np.maximum(progress["charge_s"] - replace_nan(time - charging_since, 0.0), 0.0)
    middle = charging + progress["between_s"]  # 0 without charges, like all that follows a charge
    end = np.maximum(progress["end"], time + (driving + (middle + progress["after_s"])))
    hours = (end - time) / 3600.0
    spare = np.maximum(hours - (driving + (middle + progress["after_s"])) / 3600.0, 0.0)
    has_charge = progress["charges"] > 0.0
    approaches = kept * (progress["legs"] - riding * (progress["legs"] > 0.0))
    waits = approaches + (has_charge & np.isnan(charging_since))
    between = progress["between_legs"] + np.maximum(progress["charges"] - 1.0, 0.0)
    number = waits + between + progress["after_legs"]
    pause = spare / np.maximum(number, 1.0)
    waiting = np.where(has_charge, waits * pause, spare)
    until = np.where(has_charge, driving / 3600.0 + waiting, hours)
    waiting_after = np.where(number > 0.0, progress["after_legs"] * pause, spare)
    after = progress["after_s"] / 3600.0 + waiting_after
    return PlanTimes(end, left, kept, approaches, pause, waits, waiting, until, after, waiting_after)


def compute_planned_energy(
    progress: NDArray[np.void],
    times: PlanTimes,
    time: Floats,
    riding: NDArray[np.bool_],
    usual: UsualConsumption,
    *,
    drives_home: bool = True,
) -> EnergyAhead:
    """Return the energy ahead by plan, until the next planned charge, or else the end of the shift and the way home."""
    left, kept, has_charge = times.left, times.kept, progress["charges"] > 0.0
    whole, begun, later = (usual.weigh(progress[name]) for name in ("leg_kwh", "begun_kwh", "later_kwh"))
    approaches = times.approaches + has_charge  # the way to a charger is empty, too
    idling = times.waiting * usual.standing_power + approaches * usual.approach_energy + usual.warm_up_energy
    driving = np.where(riding, left * begun, kept * whole) + kept * later
    spare = np.where(progress["legs"] > 0.0, np.inf, times.waiting)  # after the last leg, it may be driven in part
    parts = usual.compute_parts(driving, idling, np.where(drives_home & ~has_charge, spare, 0.0))
    basis = np.where(has_charge, TO_CHARGE, BY_PLAN)
    energy = usual.expect_plan(parts)
    timing_sd = usual.standing_power * np.sqrt(times.waits) * times.pause  # a wait has an sd equal to its mean
    known = _is_planned(progress, time)
    return EnergyAhead(
        np.where(known, energy.mean, np.nan),
        np.where(has_charge, np.hypot(energy.sd, timing_sd), energy.sd),
        np.where(known[:, np.newaxis], parts, np.nan),
        np.where(known, np.where(riding, left, kept) * progress["leg_km"] + kept * progress["later_km"], np.nan),
        np.where(known, times.until, np.nan),
        np.where(known, times.end, np.nan),
        np.where(known, progress["reserve"], np.nan),
        np.where(known, basis, BY_PLAN),
    )


def is_plan_current(came: Any, end: Any, time: Any) -> Any:
    """Return whether a plan that was sent at `came`, for a shift that ends at `end`, applies to `time`. [s]"""
    return (time >= came - PLAN_LEAD) & (time <= end + OVERTIME)


def _is_planned(progress: NDArray[np.void], time: Floats) -> NDArray[np.bool_]:
    """Return where there is a plan that applies to a time [s], whose energy is known."""
    return np.asarray((progress["planned"] == 1.0) & is_plan_current(progress["came"], progress["end"], time))


def find_expected_end(progress: NDArray[np.void], time: Floats, begin: Floats, patterns: NDArray[np.void]) -> Floats:
    """Return when shifts are expected to end, by plan or else by earlier shifts; NaN where unknown. [s]"""
    out, planned = progress["end"].copy(), _is_planned(progress, time)
    if len(rows := np.flatnonzero(~planned)):
        out[rows] = time[rows] + 3600.0 * expect_rest(patterns[rows], time[rows] - begin[rows]).hours
    return out


def fill_from_history(
    ahead: EnergyAhead, usual: UsualConsumption, elapsed: Floats, now: Floats, patterns: NDArray[np.void]
) -> EnergyAhead:
    """Return the energy ahead, by earlier shifts where there is no plan; `elapsed` is that of the shift [s]."""
    rest = expect_rest(patterns, elapsed)
    whole = rest.work * usual.mean_power + usual.warm_up_energy
    filled = np.isnan(ahead.energy) & np.isfinite(whole)
    return EnergyAhead(
        np.where(filled, whole, ahead.energy),
        np.where(filled, rest.work_sd * usual.mean_power, ahead.sd),
        np.where(filled[:, np.newaxis], np.nan, ahead.planned),
        np.where(filled, whole / usual.energy_per_km, ahead.km),
        np.where(filled, rest.hours, ahead.hours),
        np.where(filled, now + 3600.0 * rest.hours, ahead.end),
        np.where(np.isnan(ahead.reserve), DEFAULT_RESERVE, ahead.reserve),
        np.where(filled, BY_HISTORY, ahead.basis),
    )


class DrivingRange(NamedTuple):
    """Hold the way that n cars can drive down to their reserves, (n,) float each.

    Parameters
    ----------
    km : Distance, with its standard deviation before the conformal correction. [km]
    energy : Energy that it takes, as predicted. [kWh]
    """

    km: MeanAndSd
    energy: Floats


def compute_range(estimate: CarEstimate, reserve: Floats, usual: UsualConsumption) -> DrivingRange:
    """Return how far cars can drive down to their reserves if they drive on without a pause.

    Notes
    -----
    It is the length of the ride after which `compute_end_soc` expects the reserve, at the usual pace of rides. The
    standard deviation of the charge there, over the fall of the charge per kilometre, is that of the distance. The
    consumption factor returns to the usual within hours, so its mean over the way is found by iteration.
    """
    left = np.maximum(compute_charge_between(estimate.soc, reserve, estimate.curve), 0.0)
    per_km = usual.driving_energy_per_km
    energy = left * estimate.capacity
    for _ in range(RANGE_ITERATIONS):
        hours = energy / per_km * usual.ride_pace / 60.0
        factor = np.exp(estimate.compute_mean_log_factor(hours))
        energy = left * estimate.capacity / factor
    km = energy / per_km
    driving = km * per_km
    sd = np.sqrt(np.maximum(usual.covariance[:, 0, 0], 0.0)) * driving  # beside that of the usual mix
    at_reserve = compute_end_soc(estimate, MeanAndSd(driving, sd), km * usual.ride_pace / 60.0)
    return DrivingRange(MeanAndSd(km, at_reserve.sd * estimate.capacity / (factor * per_km)), energy)


def compute_end_soc(estimate: CarEstimate, energy: MeanAndSd, hours: Floats) -> MeanAndSd:
    """Return the state of charge after an energy, with its standard deviation before the conformal correction. [1]

    Units: energy [kWh], hours [h].

    Notes
    -----
    With the predicted fall D = E / C, the mean falls by exp(a - c) D, where a - c decays to the usual. The variance
    is the sum of that of the charge; D^2 times that of a - c, which is the present one and that of the mean of its
    wandering over the hours T, `CONSUMPTION_WANDER`^2 T / 3; that of the predicted energy; twice the covariance of
    charge and a - c times -D; the noise of the energy itself, proportional to the energy; and that of the quantum of
    the reported outcome.
    D has no factor exp(a - c), so that a car which stops reporting its charge never gets a narrower interval for it.
    """
    predicted = energy.mean / estimate.capacity
    variance = (
        estimate.variance
        + predicted**2 * (estimate.log_factor_variance + CONSUMPTION_WANDER**2 * hours / 3.0)
        + (energy.sd / estimate.capacity) ** 2
        - 2.0 * predicted * estimate.covariance
        + ENERGY_SD**2 * np.maximum(energy.mean, 0.0) / estimate.capacity**2
        + estimate.quantum**2 / 12.0
    )
    mean = lower_charge(estimate.soc, np.exp(estimate.compute_mean_log_factor(hours)) * predicted, estimate.curve)
    return MeanAndSd(mean, np.sqrt(np.maximum(variance, estimate.quantum**2 / 12.0)))


def compute_reserve_risk(end: MeanAndSd, reserve: Floats, quantiles: Floats) -> Floats:
    """Return the probability that the charge ends below the reserve, by the quantiles of the standardised error.

    Beyond the outermost quantiles the probability falls linearly to 0, or rises to 1, within half of their distance
    from the median.
    """
    at = (reserve - end.mean) / end.sd
    middle = quantiles[:, len(LEVELS) // 2]
    low, high = 1.5 * quantiles[:, 0] - 0.5 * middle, 1.5 * quantiles[:, -1] - 0.5 * middle
    knots = np.column_stack([low, quantiles, high])
    levels = np.array([0.0, *LEVELS, 1.0])
    place = np.clip((knots <= at[:, np.newaxis]).sum(axis=1) - 1, 0, len(levels) - 2)
    rows = np.arange(len(at))
    width = np.maximum(knots[rows, place + 1] - knots[rows, place], 1e-12)
    share = np.clip((at - knots[rows, place]) / width, 0.0, 1.0)
    risk = levels[place] + share * (levels[place + 1] - levels[place])
    return np.where(np.isfinite(at) & np.isfinite(middle), risk, np.nan)


def compute_temperature_weights(ambient: Floats) -> Floats:
    """Return the weight of each of `TEMPERATURES` at outside temperatures."""
    return compute_knot_weights(replace_nan(ambient - ZERO_CELSIUS, 15.0), TEMPERATURES)
