"""What the filter hears of cars whose truth is known: consumption, capacity, and a charge that is read in quanta."""

from typing import NamedTuple

import numpy as np

from core.forecast import filter_state, soc_filter, soc_reading
from core.forecast.learning.car_driver import CAR_SD, DAY_FACTOR_SD

BEGIN = 1_516_017_600.0
WITHIN = 1.6448536269514722
"""Standard deviations about the mean of a normal that hold 90 % of it."""
NIGHT = 86_400.0
"""From one shift to the next. [s]"""
STEP = 15.0
"""Between two events. [s]"""
CAPACITY = 40.0
"""[kWh]"""
PRIOR = CAR_SD**2 + soc_filter.DRIVER_SD**2 + DAY_FACTOR_SD**2
"""Variance of what a car takes, before anything is known of it."""


class Truth(NamedTuple):
    """What was planted: charge and logarithm of consumption at each event, (cars, n), and of capacity, (cars,)."""

    soc: np.ndarray
    a: np.ndarray
    c: np.ndarray


class Heard(NamedTuple):
    """What came of events: `soc.TOLD` of each, the state after the last, and the shifts that ended."""

    estimates: np.ndarray
    state: np.ndarray
    shifts: np.ndarray

    def at(self, name, cars=1):
        """Return what was told, (cars, n)."""
        return self.estimates[name].reshape(cars, -1)


def shift(
    cars=1, hours=4.0, quantum=0.01, a=0.0, c=0.0, metered=False, seed=1, begin=BEGIN, full=0.95, step=STEP, exact=False
):
    """Return the events of one ride of `hours` a car, car by car, and what was planted.

    Power is predicted to be 4 kW on average. What is used differs from it by exp(a), which wanders, and by the noise
    that the filter allows for.

    Parameters
    ----------
    a, c : float or (cars,) float
    metered : bool
        Whether voltage and current tell what is used: sampled, and with a gain of each car's own.
    exact : bool
        Whether the charge is reported to tick where it should, not about there.
    """
    rng = np.random.default_rng(seed)
    n = int(hours * 3600.0 / step)
    predicted = rng.gamma(4.0, 1.0, (cars, n)) * step / 3600.0
    walk = soc_filter.CONSUMPTION_WANDER * np.sqrt(step / 3600.0) * rng.normal(size=(cars, n)).cumsum(axis=1)
    taken = np.broadcast_to(a, (cars,))[:, None] + walk
    size = np.broadcast_to(c, (cars,)).astype(float)
    used = np.exp(taken) * predicted + np.sqrt(noise(step * np.arange(n)) * predicted) * rng.normal(size=(cars, n))
    charge = full - used.cumsum(axis=1) / (CAPACITY * np.exp(size))[:, None]
    out = np.zeros((cars, n), filter_state.FILTER_EVENT)
    passed = step * np.arange(1.0, n + 1)
    out["lane"] = np.arange(cars)[:, None]
    out["time"], out["duration"] = begin + passed, passed
    out["predicted"], out["factor"], out["riding"] = predicted.cumsum(axis=1), 1.0, 1.0
    out["distance"], out["ambient"] = 8.0 * passed, 283.15 * passed
    if metered:
        gain = np.exp(soc_filter.METER_GAIN_SD * np.random.default_rng(7).normal(size=(cars, 1)))  # the same every day
        sampled = used + soc_filter.METER_SAMPLING_SD * np.sqrt(np.abs(used)) * rng.normal(size=(cars, n))
        out["metered"], out["meter_time"] = (gain * sampled).cumsum(axis=1), passed
    out["soc"], out["quantum"] = read(charge, quantum, None if exact else rng), quantum
    out["since_charge"], out["capacity"] = np.nan, CAPACITY
    return out, Truth(charge, taken, size)


def noise(passed):
    """Return the variance of the energy of a stretch that takes 1 kWh, so long after the shift began [s]."""
    return soc_filter.ENERGY_SD**2 * np.where(passed < soc_filter.WARM_UP_TIME, soc_filter.WARM_UP_VARIANCE_FACTOR, 1.0)


def read(charge, quantum, rng=None):
    """Return charges that fall as cars report them, in quanta, (cars, n).

    Boundaries between quanta are where they should be, or, with `rng`, as far off as the filter allows for.
    """
    edges = quantum * (np.arange(int(np.ceil(1.0 / quantum))) + 0.5)
    out = np.empty(charge.shape)
    for row, values in zip(out, charge, strict=True):
        off = 0.0 if rng is None else np.hypot(0.1 * quantum, soc_reading.READING_SD) * rng.normal(size=len(edges))
        row[:] = quantum * np.searchsorted(np.sort(edges + off), values, side="right")
    return out


def named(driver, mean, variance, lane=0):
    """Return the event that names who drives, and their part in what is taken, (1,)."""
    event = np.zeros(1, filter_state.FILTER_EVENT)
    event["kind"], event["lane"], event["driver"] = filter_state.DRIVER_NAMED, lane, driver
    event["driver_mean"], event["driver_variance"] = mean, variance
    return event


def heard(events, state=None, prior=(0.0, PRIOR)):
    """Send events through the filter."""
    events = np.ascontiguousarray(events.ravel())
    lanes = int(events["lane"].max()) + 1
    state = filter_state.create_filter_state(lanes) if state is None else state.copy()
    estimates = np.empty(len(events), filter_state.SOC_ESTIMATE)
    shifts = np.empty(len(events), filter_state.CLOSED_SHIFT)
    priors = np.full(lanes, np.array(prior, filter_state.LOG_FACTOR_PRIOR))
    ended = soc_filter.filter_events(events, state, priors, estimates, shifts)
    return Heard(estimates, state, shifts[:ended])


class Faults(NamedTuple):
    """Number of readings of each car that jumped, and that were found frozen, (cars,) each."""

    jumps: np.ndarray
    freezes: np.ndarray


def count_faults(events):
    """Send the events of all cars step by step through the filter, and count the readings that it did not accept.

    Parameters
    ----------
    events : (cars, n) FILTER_EVENT
    """
    state = filter_state.create_filter_state(len(events))
    jumps, freezes = np.zeros(len(events), int), np.zeros(len(events), int)
    for step in events.T:
        before, state = state, heard(step, state).state
        is_new = (state["suspect"] != before["suspect"]) | (state["suspect_time"] != before["suspect_time"])
        jumps += ~np.isnan(state["suspect"]) & is_new
        freezes += (state["frozen"] == 1.0) & (before["frozen"] == 0.0)
    return Faults(jumps, freezes)


def covered(found, variance, truth):
    """Return how often the truth is in the 90 % interval."""
    return np.mean(np.abs(found - truth) < WITHIN * np.sqrt(variance))


def covariance(state):
    """Return the covariance of charge, scale and capacity."""
    s = state[0]
    return np.array(
        [[s["p_ss"], s["p_sa"], s["p_sc"]], [s["p_sa"], s["p_aa"], s["p_ac"]], [s["p_sc"], s["p_ac"], s["p_cc"]]]
    )
