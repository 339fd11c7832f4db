"""How far time has progressed in a fleet, so that silent cars show and no car with a wrong clock silences others.

Clocks of two cars are never compared. Each car tells how much time passes between its own messages, and the fleet is as
far as the car that has come farthest since it joined. A step of more than `LONGEST_STEP_S` is that of a clock or a
pause. It counts once a second car has made one, and no farther than the shorter of both.
"""

from math import isfinite
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats

SILENT_S: Final = 600.0
"""Time without a forecast after which a car is silent. [s]"""
LONGEST_STEP_S: Final = SILENT_S
"""Longest time between two messages of a car that counts without a second car. [s]"""
NOBODY: Final = -1


class FleetTime(NamedTuple):
    """Hold the time since the first message, and the last long step that it has not followed in full.

    The columns `time`, `elapsed` and `heard` of a car are its own last time, how far it has come in the time of the
    fleet, and the time of the fleet at its last message.

    Parameters
    ----------
    progress : float
        Time that has passed. [s]
    stepper : int
        Row of the car that made the step, `NOBODY` without one.
    goal : float
        How far it would have come. [s]
    """

    progress: float = 0.0
    stepper: int = NOBODY
    goal: float = 0.0

    def join(self, car: Any) -> None:
        """Take a new car into the fleet, whose clock may be anywhere."""
        car["elapsed"] = car["heard"] = self.progress

    def hear(self, cars: NDArray[np.void], row: int, time: float) -> "FleetTime":
        """Return the time of the fleet after a message of a car, and write that the car was heard.

        Units: time [Unix s].

        Parameters
        ----------
        cars : (cars,) structured
            Values of the cars, changed in place.
        """
        car, now = cars[row], self
        step = time - car["time"]
        reached = float(car["elapsed"] + step) if isfinite(step) and step > 0.0 else float(car["elapsed"])
        if reached - self.progress > LONGEST_STEP_S:
            now = self._follow(cars, row, reached)
            reached = now.progress
        car["time"], car["elapsed"] = time, reached
        now = now._replace(progress=max(now.progress, reached))
        car["heard"] = now.progress
        return now

    def _follow(self, cars: NDArray[np.void], row: int, goal: float) -> "FleetTime":
        """Return the time of the fleet after a long step, which counts as far as another car made one too."""
        if self.stepper in {row, NOBODY}:
            return FleetTime(self.progress, row, goal)
        both = max(self.progress, min(goal, self.goal))
        other = cars[self.stepper]
        other["elapsed"] += both - self.progress
        other["heard"] += both - self.progress
        return FleetTime(both, *max((self.stepper, self.goal), (row, goal), key=lambda step: step[1]))


def find_newest(time: Floats, is_heard: NDArray[np.bool_]) -> float:
    """Return the newest time of those cars that are not silent and no more than `SILENT_S` ahead of most of them.

    Units: returns [Unix s].

    Parameters
    ----------
    time : (cars,) float
        Last time of each car by its own clock, NaN where unknown. [Unix s]
    """
    known = np.sort(time[is_heard & np.isfinite(time)])
    if not len(known):
        return float("nan")
    return float(known[known <= known[(len(known) - 1) // 2] + SILENT_S][-1])
