"""Simulate a driver who follows limits and traffic, brakes for lights, signs and bends, and waits."""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import KMH
from socast.core.compiled_cache import njit
from socast.tools.simulator.settings import STEP
from socast.tools.simulator.world import BOULEVARD, EXPRESSWAY, RESIDENTIAL, Route

REACTION: Final = 1.5
"""Time constant with which the speed that a driver wants follows mood and traffic. [s]

With it, speed varies as smoothly as in the 10 Hz drives of a BMW i3. Samples every 1, 3 and 5 s show this share of the
kinetic energy that a car gains while it accelerates, seen every 0.5 s:

| drives | 1 s | 3 s | 5 s |
|---|---|---|---|
| simulated rides of 2 to 12 km | 98 % | 90 % | 83 % |
| simulated shifts of taxis, with many short rides | 98 % | 92 % | 88 % |
| BMW i3 | 98 % | 91 % | 82 % |

The correlation of accelerations 0.5 s apart is 0.88 to 0.89, and 0.91 for the i3. Without the reaction time, the shares
at 3 s are 82 and 86 %.
"""


class DrivingStyle(NamedTuple):
    """Describe how a person drives.

    Parameters
    ----------
    pace : float
        Desired speed divided by the speed limit. [1]
    accelerate, brake : float
        Usual acceleration and deceleration. [m/s^2]
    """

    pace: float
    accelerate: float
    brake: float


class Motion(NamedTuple):
    """Hold a drive step by step.

    Parameters
    ----------
    along : (n,) float
        Distance driven at the end of the step. [m]
    before, after : (n,) float
        Speed at the beginning and at the end of the step. [m/s]
    """

    along: Floats
    before: Floats
    after: Floats


def make_style(rng: np.random.Generator) -> DrivingStyle:
    """Draw the driving style of a person."""
    return DrivingStyle(float(rng.normal(1.02, 0.05)), float(rng.uniform(1.3, 2.3)), float(rng.uniform(1.4, 2.3)))


def compute_congestion(clock: float) -> float:
    """Return the density of the traffic, from 0 (free) to 1 (rush hour). [1]"""
    return float(np.exp(-(((clock - 8.2) / 1.3) ** 2)) + np.exp(-(((clock - 17.2) / 1.6) ** 2)))


def drive_route(route: Route, style: DrivingStyle, traffic: float, rng: np.random.Generator) -> Motion:
    """Drive a route."""
    count = len(route.limit)
    draws, waits = rng.uniform(size=count), rng.uniform(size=count)
    stops = np.where(route.street == RESIDENTIAL, 0.48, np.where(route.street == BOULEVARD, 0.46, 0.0))
    red = draws < stops + 0.15 * traffic * (route.street != EXPRESSWAY)
    longest = np.where(route.street == BOULEVARD, 60.0, 14.0) * (1 + 0.5 * traffic)
    wait = np.where(red, 1.5 + longest * waits**1.5, 0.0)
    slow = np.where(route.street == EXPRESSWAY, 1 - 0.55 * traffic * waits, 0.82 - 0.25 * traffic)
    limit = route.limit * slow * style.pace
    cap = np.minimum(limit, np.append(limit[1:], 0.0))
    cap = np.where(route.turn, np.minimum(cap, np.where(route.street == EXPRESSWAY, 45 * KMH, 19 * KMH)), cap)
    cap = np.where(red, 0.0, cap)
    cap[-1] = 0.0
    length = np.diff(route.along)
    steps = int((route.along[-1] / 1.5 + wait.sum() + 120 * count) / STEP)
    mood = rng.normal(size=1024)
    return Motion(*_drive(length, limit, cap, wait, style, mood, steps))


@njit(cache=True)
def _drive(
    length: Floats, limit: Floats, cap: Floats, wait: Floats, style: DrivingStyle, mood: Floats, steps: int
) -> tuple[Floats, Floats, Floats]:
    """Integrate the motion over a route; `cap` is the allowed speed at the end of each segment."""
    for i in range(len(cap) - 2, -1, -1):
        cap[i] = min(cap[i], np.sqrt(cap[i + 1] ** 2 + 2 * style.brake * length[i + 1]))
    along, before, after = np.empty(steps), np.empty(steps), np.empty(steps)
    n, segment, covered, into, speed, drift, ripple = 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0
    while segment < len(length) and n < steps:
        left = length[segment] - into
        drift = 0.97 * drift + 0.243 * mood[n % len(mood)]
        ripple += STEP / REACTION * (drift - ripple)
        wish = max(limit[segment] * (1 + 0.05 * ripple), 0.8)
        push = style.accelerate * max(0.25, 1 - speed / 36.0)
        rate = min(max((wish - speed) / 1.2, -style.brake), push)
        needed = (speed**2 - cap[segment] ** 2) / (2 * max(left, 0.2))
        if needed > 0.8 * style.brake:
            rate = -min(needed, 4.0)
        faster = max(speed + rate * STEP, 0.0)
        moved = 0.5 * (speed + faster) * STEP
        if moved >= left and cap[segment] == 0.0:
            moved, faster = left, 0.0
        covered, into = covered + moved, into + moved
        along[n], before[n], after[n] = covered, speed, faster
        n, speed = n + 1, faster
        if into >= length[segment] - 1e-9:
            into -= length[segment]
            for _ in range(int(wait[segment] / STEP) if speed == 0.0 else 0):
                if n < steps:
                    along[n], before[n], after[n] = covered, 0.0, 0.0
                    n += 1
            segment += 1
    return along[:n], before[:n], after[:n]
