"""The event time of the fleet, by which a silent car is noticed before its next sample.

A car that sends nothing cannot show that time passes. The other cars can. The fleet clock counts how far the latest
repaired time of all cars, the front, advances from sample to sample. A ride ends once the clock has advanced by more
than the setting `gap_time` since the last sample of its car. Without other cars, the ride ends at the next sample.

The clock compares no car's time with that of another car, so a logger whose clock is hours wrong is not silent:

- A sample advances the clock by no more than the time since the sample before it of the same car. A car that joins with
  a clock far ahead moves the front, but not the clock.
- Samples that a logger had stored and sends together are behind the front, and do not advance the clock.
- If the car at the front stops, or its clock is set back, the others stay behind the front and the clock stands. After
  `STALLED` samples, and two of each car, the front returns to the present sample. Until then, silence is noticed later,
  never too early. In a large fleet, thousands of samples are behind the front only because clocks differ by a second.

The clock is wrong if a logger whose time is ahead of all others stores samples for longer than `gap_time`, and then
sends them together. The rides of other cars then end early; their samples begin new rides.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.cleaning.segmentation import finish_ride
from socast.core.compiled_cache import njit

FIELDS: Final = ("heard",)
"""Fields in the state of a lane: the fleet clock at its last accepted sample. [s]"""

FLEET_CLOCK: Final = np.dtype(
    [
        ("front", "f8"),  # latest repaired time of all cars [s]
        ("progress", "f8"),  # time that has passed since the first sample [s]
        ("behind", "f8"),  # number of successive samples behind the front
        ("cars", "f8"),  # number of cars of which a sample has been accepted
        ("check", "f8"),  # value of `progress` up to which no ride can have become silent [s]
    ]
)
"""State of the fleet clock."""

RIDE_END: Final = np.dtype(
    [
        ("row", "i8"),  # number of rows of the batch before it
        ("lane", "i8"),
        ("place", "i8"),  # place among the messages of the batch
    ]
)
"""End of a ride between two rows."""
STALLED: Final = 1000.0
"""Least number of successive samples behind the front after which the front returns to the present one.

It equals the number of samples by which the daily update distinguishes a wrong day from a few wrong clocks."""


def new_fleet_clock() -> NDArray[np.void]:
    """Return the state of the clock before the first sample, (1,) FLEET_CLOCK."""
    clock = np.zeros(1, FLEET_CLOCK)
    clock["front"] = -np.inf
    return clock


@njit(cache=False)
def advance_fleet_clock(clock: Any, time: float, dt: float, longest: float) -> bool:
    """Advance the clock by an accepted sample; return whether a ride may have become silent.

    Parameters
    ----------
    dt : float
        Time since the sample before it of the same car, 0 for the first one. [s]
    """
    if time > clock.front:
        if dt <= longest:
            clock.progress += min(dt, time - clock.front)
        clock.front = time
        clock.behind = 0.0
    else:
        clock.behind += 1.0
        if clock.behind >= max(STALLED, 2.0 * clock.cars):
            clock.front = time
            clock.behind = 0.0
    return bool(clock.progress > clock.check)


@njit(cache=False)
def end_silent_rides(clock: Any, states: Any, row: int, place: int, longest: float, ends: Any, n_ends: int) -> int:
    """End the rides of all cars that have been silent for too long; return the number of ends so far.

    It visits every car. Call it only where `advance_fleet_clock` returned true.
    """
    earliest = clock.progress
    for lane in range(states.shape[0]):
        state = states[lane]
        if state.riding == 1.0:
            if clock.progress - state.heard > longest:
                finish_ride(state, 0.0)
                ends[n_ends].row, ends[n_ends].lane, ends[n_ends].place = row, lane, place
                n_ends += 1
            else:
                earliest = min(earliest, state.heard)
    clock.check = earliest + longest
    return n_ends
