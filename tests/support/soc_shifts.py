"""Events of the SOC filter for cars with known consumption and capacity, and a charge that is reported in quanta."""

from typing import NamedTuple

import numpy as np

from socast.core.forecast import filter_state, soc_filter, soc_reading
from socast.core.forecast.learning.car_driver import CAR_SD, DAY_FACTOR_SD

BEGIN = 1_516_017_600.0
WITHIN = 1.6448536269514722
"""Half width of the interval that contains 90 % of a normal distribution. [standard deviations]"""
NIGHT = 86_400.0
"""Time from one shift to the next. [s]"""
STEP = 15.0
"""Time between two events. [s]"""
CAPACITY = 40.0
"""[kWh]"""
PRIOR = CAR_SD**2 + soc_filter.DRIVER_SD**2 + DAY_FACTOR_SD**2
"""Prior variance of the consumption factor of a car."""


class Truth(NamedTuple):
    """Planted charge and log consumption factor at each event, (cars, n), and log of the capacity, (cars,)."""

    soc: np.ndarray
    a: np.ndarray
    c: np.ndarray


class FilterRun(NamedTuple):
    """Result of the filter: the estimate after each event, the state after the last, and the shifts that ended."""

    estimates: np.ndarray
    state: np.ndarray
    shifts: np.ndarray

    def at(self, name, cars=1):
        """Return a field of the estimates, (cars, n)."""
        return self.estimates[name].reshape(cars, -1)


def shift(
    cars=1, hours=4.0, quantum=0.01, a=0.0, c=0.0, metered=False, seed=1, begin=BEGIN, full=0.95, step=STEP, exact=False
):
    """Return the events of one ride of each car, (cars, n), and the planted values.

    The mean predicted power is 4 kW. The used energy differs from the predicted by exp(a), which wanders, and by the
    noise that the filter assumes.

    Parameters
    ----------
    a, c : float or (cars,) float
    metered : bool
        Whether voltage and current measure the used energy, by samples and with a gain of each car.
    exact : bool
        Whether the reported charge steps exactly at the boundaries of its quanta.
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
    out["predicted"], out["riding"] = predicted.cumsum(axis=1), 1.0
    out["distance"], out["ambient"] = 8.0 * passed, 283.15 * passed
    if metered:
        gain = np.exp(soc_filter.METER_GAIN_SD * np.random.default_rng(7).normal(size=(cars, 1)))  # constant over days
        sampled = used + soc_filter.METER_SAMPLING_SD * np.sqrt(np.abs(used)) * rng.normal(size=(cars, n))
        out["metered"], out["meter_time"] = (gain * sampled).cumsum(axis=1), passed
    out["soc"], out["quantum"] = read(charge, quantum, None if exact else rng), quantum
    out["since_charge"], out["capacity"] = np.nan, CAPACITY
    return out, Truth(charge, taken, size)


def noise(passed):
    """Return the variance of the energy of a stretch that takes 1 kWh, at times since the shift began [s]."""
    return soc_filter.ENERGY_SD**2 * np.where(passed < soc_filter.WARM_UP_TIME, soc_filter.WARM_UP_VARIANCE_FACTOR, 1.0)


def read(charge, quantum, rng=None):
    """Return falling charges as cars report them, in quanta, (cars, n).

    The boundaries between quanta are exact, or, with `rng`, have the error that the filter assumes.
    """
    edges = quantum * (np.arange(int(np.ceil(1.0 / quantum))) + 0.5)
    out = np.empty(charge.shape)
    for row, values in zip(out, charge, strict=True):
        off = 0.0 if rng is None else np.hypot(0.1 * quantum, soc_reading.READING_SD) * rng.normal(size=len(edges))
        row[:] = quantum * np.searchsorted(np.sort(edges + off), values, side="right")
    return out


def name_driver(driver, mean, variance, lane=0):
    """Return the event that names a driver, with the distribution of the driver's part, (1,) FILTER_EVENT."""
    event = np.zeros(1, filter_state.FILTER_EVENT)
    event["kind"], event["lane"], event["driver"] = filter_state.DRIVER_NAMED, lane, driver
    event["driver_mean"], event["driver_variance"] = mean, variance
    return event


def run_filter(events, state=None, prior=(0.0, PRIOR)):
    """Run the filter over events."""
    events = np.ascontiguousarray(events.ravel())
    lanes = int(events["lane"].max()) + 1
    state = filter_state.create_filter_state(lanes) if state is None else state.copy()
    estimates = np.empty(len(events), filter_state.SOC_ESTIMATE)
    shifts = np.empty(len(events), filter_state.CLOSED_SHIFT)
    priors = np.full(lanes, np.array(prior, filter_state.LOG_FACTOR_PRIOR))
    ended = soc_filter.filter_events(events, state, priors, estimates, shifts)
    return FilterRun(estimates, state, shifts[:ended])


class Faults(NamedTuple):
    """Number of readings of each car that jumped, and that were found frozen, (cars,) each."""

    jumps: np.ndarray
    freezes: np.ndarray


def count_faults(events):
    """Run the filter step by step over the events of all cars, and count the readings that it rejects.

    Parameters
    ----------
    events : (cars, n) FILTER_EVENT
    """
    state = filter_state.create_filter_state(len(events))
    jumps, freezes = np.zeros(len(events), int), np.zeros(len(events), int)
    for step in events.T:
        before, state = state, run_filter(step, state).state
        is_new = state["suspect_time"] != before["suspect_time"]
        jumps += ~np.isnan(state["suspect"]) & is_new
        freezes += (state["frozen"] == 1.0) & (before["frozen"] == 0.0)
    return Faults(jumps, freezes)


def compute_coverage(estimate, variance, truth):
    """Return the share of truths inside the 90 % interval."""
    return np.mean(np.abs(estimate - truth) < WITHIN * np.sqrt(variance))
