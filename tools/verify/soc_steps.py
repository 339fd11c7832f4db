"""Compare each step of the compiled filter of the state of charge with filterpy's, from the same state before it."""

from collections.abc import Callable
from math import exp, isnan
from typing import Any

import numpy as np

from socast.core.batch import Lanes
from socast.core.forecast.filter_state import CLOSED_SHIFT, DEFAULT_QUANTUM, DRIVER_NAMED, RUNNING, SOC_ESTIMATE
from socast.core.forecast.kalman_update import LARGEST_LOG_CAPACITY, LARGEST_LOG_CONSUMPTION
from socast.core.forecast.learning.consumption_terms import WARM_UP_DECAY
from socast.core.forecast.soc_filter import (
    BEYOND_MARGIN,
    ENERGY_SD,
    FILTER_RESET_SILENCE,
    LARGEST_VARIANCE,
    SHIFT_GAP,
    WARM_UP_TIME,
    WARM_UP_VARIANCE_FACTOR,
    filter_events,
)
from socast.core.forecast.soc_reading import REJECTION_MARGIN, REJECTION_SDS
from socast.tools.verify.differences import Tallies, measure_differences
from socast.tools.verify.soc_witness import SocWitness, Stretch, get_covariance, get_mean

BEGINNING, STATISTICS = "beginning of a shift", "new statistics of the fleet"
TEMPERATURE, SILENCE, CHARGING = "first temperature of a shift", "reset after silence", "charging"
UNKNOWN, UNTRUSTED, LIMIT = "no charge known before", "untrusted jump", "estimate at a limit"
"""Causes for which a linear filter does not describe a step."""


class SocSteps:
    """Compare the steps of all cars while the engine runs its filters over them."""

    def __init__(self, lanes: Lanes, run: Callable[..., int] = filter_events) -> None:
        self.tallies, self._lanes, self._run = Tallies(), lanes, run

    def filter_events(self, events: Any, state: Any, prior: Any, estimates: Any, shifts: Any) -> int:
        """Run the filters over events, as `filter_events` does, and compare each step beforehand."""
        trial, out = state.copy(), (np.empty(1, SOC_ESTIMATE), np.empty(1, CLOSED_SHIFT))
        for i, event in enumerate(events):
            lane = int(event["lane"])
            before = trial[lane].copy()
            self._run(events[i : i + 1], trial, prior, *out)
            if event["kind"] != DRIVER_NAMED:  # the step that follows takes the driver into account
                self._compare(self._lanes.names[lane], before, event, trial[lane])
        return self._run(events, state, prior, estimates, shifts)

    def _compare(self, car: str, before: Any, event: Any, after: Any) -> None:
        """Compare the state of a car after an event with filterpy's, or pass it over."""
        tally = self.tallies[car]
        cause = find_cause(before, event)
        if not cause:
            witness = SocWitness(before)
            if event["kind"] == RUNNING:
                witness.take_driver(before)
            witness.predict(measure_stretch(before, event))
            cause = take_reading(witness, before, event)
        if cause:
            tally.passed_over[cause] += 1
        else:
            found = get_mean(after), get_covariance(after)
            tally.add(measure_differences(*found, witness.mean, witness.covariance))


def find_cause(before: Any, event: Any) -> str:
    """Return why a linear filter does not describe the step of an event, from the state of its car before it."""
    passed, duration = event["time"] - before["time"], event["duration"] - before["seen_time"]
    since = event["since_charge"]
    other_level = event["level"] != before["level"] and not isnan(event["level"]) and not isnan(before["level"])
    causes = {
        BEGINNING: before["active"] == 0.0 or passed > SHIFT_GAP,
        STATISTICS: other_level and event["car_kind"] == before["car_kind"],
        TEMPERATURE: duration > 0.0 and isnan(before["level_sd"]) and not isnan(event["level_sd"]),
        SILENCE: passed - max(duration, 0.0) > FILTER_RESET_SILENCE,
        CHARGING: since < passed or (since == 0.0 and passed == 0.0 and before["charging"] == 1.0),
        UNKNOWN: isnan(before["soc"]),
    }
    return next((cause for cause, applies in causes.items() if applies), "")


def measure_stretch(before: Any, event: Any) -> Stretch:
    """Return what a car did since the totals that its state remembers."""
    names = ("time", "predicted", "metered", "meter_time")
    totals = ("duration", *names[1:])
    duration, predicted, metered, meter_time = (
        float(event[total] - before[f"seen_{name}"]) for total, name in zip(totals, names, strict=True)
    )
    awake = event["time"] - before["begin"]
    if duration > 0.0:
        cold, warmer = (exp(-max(time, 0.0) / WARM_UP_DECAY) for time in (awake - duration, awake))
        predicted += event["warm_up"] * (cold - warmer)
    used = metered * duration / meter_time if meter_time > 0.5 * duration else np.nan
    warming = awake < WARM_UP_TIME or event["since_charge"] < WARM_UP_TIME
    noise = ENERGY_SD**2 * (WARM_UP_VARIANCE_FACTOR if warming else 1.0)
    capacity = event["capacity"] * (1.0 + before["curve"] * (2.0 * before["soc"] - 1.0))
    return Stretch(predicted, used, duration, capacity, noise)


def take_reading(witness: SocWitness, before: Any, event: Any) -> str:
    """Update filterpy's filter by the reading of an event; return why a linear filter does not describe that."""
    reading, reported = float(event["soc"]), float(before["reported"])
    quantum = min(before["quantum"], DEFAULT_QUANTUM if isnan(event["quantum"]) else event["quantum"])
    if not isnan(reading) and reading != reported:
        off = reading - witness.mean[0]
        sd = np.sqrt(witness.covariance[0, 0] + quantum**2 / 12.0)
        far = abs(off) > max(REJECTION_SDS * sd, quantum + REJECTION_MARGIN)
        if far or abs(off - before["suspect"]) <= quantum + REJECTION_MARGIN:
            return UNTRUSTED
        is_trusted, is_frozen = isnan(before["suspect"]), before["frozen"] == 1.0
        witness.update_with_step(reported, reading, quantum, is_trusted=is_trusted, is_frozen=is_frozen)
    soc, log_consumption, log_capacity = witness.mean
    is_beyond = (
        not -BEYOND_MARGIN <= soc <= 1.0 + BEYOND_MARGIN
        or witness.covariance[0, 0] > LARGEST_VARIANCE
        or abs(log_consumption) >= LARGEST_LOG_CONSUMPTION
        or abs(log_capacity) >= LARGEST_LOG_CAPACITY
    )
    return LIMIT if is_beyond else ""
