"""Simulate the display of the state of charge: it counts charge, drifts, is a curve, and may fail.

The display is an account of the car itself. It is neither the true state of charge nor computed from the energy that
the physics integrates.
"""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.compiled_cache import njit
from socast.tools.simulator.cars import Car
from socast.tools.simulator.conditions import ABSENT, FROZEN, JUMPING
from socast.tools.simulator.physics import State
from socast.tools.simulator.settings import STEP

RELAXATION: Final = 6 * 3600.0
"""Time constant with which the count is corrected by the voltage at rest. [s]"""
FAILS_AFTER: Final = (1200.0, 3600.0)
"""Shortest and longest time after the begin of a shift at which a display freezes or sends nothing more. [s]"""
JUMPS_PER_HOUR: Final = 3.0
JUMP: Final = (5.0, 25.0)
"""Smallest and largest jump. [%]"""
JUMP_TIME: Final = 600.0
"""Mean time for which a jump lasts. [s]"""


class Display(NamedTuple):
    """Describe a display that counts charge.

    Parameters
    ----------
    gain : float
        Relative error of the current sensor. [1]
    offset : float
        Current that it shows without any. [A]
    assumed : float
        Capacity that the display assumes over the true one. [1]
    bottom, top : float
        Counted charge that is shown as 0 and as 100 %. [1]
    exponent : float
        Exponent of the curve between them. [1]
    """

    gain: float
    offset: float
    assumed: float
    bottom: float
    top: float
    exponent: float


def make_display(rng: np.random.Generator) -> Display:
    """Draw the display of a car."""
    return Display(
        gain=float(rng.normal(0.0, 0.01)),
        offset=float(rng.normal(0.0, 0.15)),
        assumed=float(rng.normal(1.0, 0.02)),
        bottom=float(rng.uniform(0.0, 0.04)),
        top=float(rng.uniform(0.97, 1.0)),
        exponent=float(rng.uniform(0.9, 1.12)),
    )


def compute_display(state: State, soc: float, car: Car, capacity: float, display: Display | None) -> Floats:
    """Return what a healthy display shows, before it is divided into steps.

    Units: capacity [J], returns [%].
    """
    if display is None:
        return np.clip(100.0 * state.soc, 0.0, 100.0)
    charge = display.assumed * capacity / car.voltage
    counted = _count(state.current * (1.0 + display.gain) + display.offset, state.soc, soc, charge)
    share = np.clip((counted - display.bottom) / (display.top - display.bottom), 0.0, 1.0)
    return np.asarray(100.0 * share**display.exponent)


@njit(cache=True)
def _count(current: Floats, soc: Floats, begin: float, charge: float) -> Floats:
    """Return the counted charge, which is slowly corrected towards the true one. (n,) [1]"""
    counted, out = begin, np.empty(len(soc))
    for i in range(len(soc)):
        counted += STEP * ((soc[i] - counted) / RELAXATION - current[i] / charge)
        out[i] = counted
    return out


def spoil_display(shown: Floats, kind: str, rng: np.random.Generator) -> Floats:
    """Return what a faulty display sends.

    Units: shown [%], returns [%].
    """
    n, out = len(shown), shown.copy()
    if kind in (ABSENT, FROZEN):
        first = min(n - 1, int(rng.uniform(*FAILS_AFTER) / STEP))
        out[first:] = out[first] if kind == FROZEN else np.nan
    elif kind == JUMPING:
        for _ in range(int(rng.poisson(JUMPS_PER_HOUR * n * STEP / 3600.0))):
            begin, length = int(rng.integers(n)), int(rng.exponential(JUMP_TIME) / STEP)
            jump = float(rng.uniform(*JUMP)) * (1.0 if rng.uniform() < 0.5 else -1.0)
            out[begin : begin + length] += jump
        out = np.clip(out, 0.0, 100.0)
    return out
