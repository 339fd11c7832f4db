"""What the logger of a car sends wrong throughout: which car, and in how many of its rides.

A quality bit tells of a sample, and a reason why one ride is unfit. A fault of a logger lasts until somebody mends it,
so it is counted by car, from the totals of its rides, and told in one line.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Final

import numpy as np

from socast.core.totals.accumulator import Totals

LoggerFaults = dict[str, Counter[str]]
"""Name of a fault -> name of a car -> number of its rides."""

CURRENT_INVERTED: Final = "current_inverted"
CLOCK_ROLLOVER: Final = "clock_rollover"
SPEED_UNIT: Final = "speed_times_"
STAMPS_SHARED: Final = "stamps_shared"
MOST_SHARED: Final = 0.2
"""Share of the samples of a ride with a shared stamp that is no accident. [1]"""
MOST_NAMED: Final = 8
"""Number of cars that a line names."""

_SENTENCES: Final = {
    CURRENT_INVERTED: "the current has the wrong sign, by accelerations or by the state of charge: positive must mean "
    "discharging; these rides are unfit",
    CLOCK_ROLLOVER: "the clock was 1024 weeks (19.6 years) early, because the week number of its GPS receiver has "
    "rolled over; they were added: update the receiver",
    STAMPS_SHARED: "samples share stamps (floored, or sent in bursts); they were placed by counter and order: send the "
    "time of each sample",
    SPEED_UNIT: "the speed is in another unit: odometer and fixes show {factor} times as much; it was multiplied by "
    "that",
}


def count_faults(rides: Totals, lane_names: list[str]) -> LoggerFaults:
    """Return the faults that rides show, by car."""
    found = {
        CURRENT_INVERTED: rides.flagged(CURRENT_INVERTED) > 0,
        CLOCK_ROLLOVER: rides.flagged(CLOCK_ROLLOVER) > 0,
        STAMPS_SHARED: rides.flagged("stamp_shared") > MOST_SHARED * rides.amount("samples"),
    }
    scale = np.where(rides.at_last("speed_scale") > 0.0, rides.at_last("speed_scale"), 1.0)
    for factor in np.unique(scale[scale != 1.0]).tolist():
        found[f"{SPEED_UNIT}{factor:.4g}"] = scale == factor
    return {
        name: Counter(lane_names[lane] for lane in rides.lane[where].tolist())
        for name, where in found.items()
        if where.any()
    }


def add_faults(total: LoggerFaults, more: Mapping[str, Mapping[str, int]]) -> None:
    """Add counts to others, in place."""
    for name, cars in more.items():
        total.setdefault(name, Counter()).update(cars)


def describe_faults(faults: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return one line for each fault: the cars, their rides, what is wrong and how to mend it.

    Examples
    --------
    >>> describe_faults({"speed_times_1.609": {"taxi-7": 12}})[0][:54]
    'taxi-7 (12 rides): the speed is in another unit: odome'
    """
    return [f"{_name_cars(cars)}: {explain_fault(name)}" for name, cars in sorted(faults.items())]


def list_facts(faults: Mapping[str, Mapping[str, int]]) -> dict[str, list[str]]:
    """Return what is wrong with the logger of each car, by car."""
    facts: dict[str, list[str]] = {}
    for name, cars in sorted(faults.items()):
        for car in cars:
            facts.setdefault(car, []).append(explain_fault(name))
    return facts


def explain_fault(name: str) -> str:
    """Return what is wrong with a logger, and how to mend it, by the name of the fault."""
    if name.startswith(SPEED_UNIT):
        return _SENTENCES[SPEED_UNIT].format(factor=name.removeprefix(SPEED_UNIT))
    return _SENTENCES[name]


def _name_cars(cars: Mapping[str, int]) -> str:
    """Return the names of cars with the most rides first."""
    ordered = sorted(cars, key=lambda car: (-cars[car], car))
    named = [f"{car} ({cars[car]:,} {'ride' if cars[car] == 1 else 'rides'})" for car in ordered[:MOST_NAMED]]
    return ", ".join(named) + (f" and {len(ordered) - MOST_NAMED:,} more" if len(ordered) > MOST_NAMED else "")
