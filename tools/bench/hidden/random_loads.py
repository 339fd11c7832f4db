"""Hide loads of random size in simulated drives: each ride, vehicle-day, driver, date or car has its own.

A load is a power of a kind, such as a constant power or a share of the air drag, times a normal deviate of its unit.
The voltage and current of the cars contain it, so that everything after them sees it as in a real car.
"""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import GRAVITY
from socast.tools.bench.hidden.drives import BASE, Drives, Readings, RecordedShift, enter_readings, integrate_shift
from socast.tools.simulator.hidden import EffectInputs, compute_braking_power, compute_rolling_power
from socast.tools.simulator.shift import NO_RIDE
from socast.tools.simulator.trace import REFERENCE_DENSITY

START: Final = 300.0
"""Time constant with which a load at the beginning of a ride decays. [s]"""


class RandomLoad(NamedTuple):
    """Describe a load.

    Parameters
    ----------
    level : {"car", "driver", "date", "day", "ride"}
        What has a size of its own.
    size : float
        Standard deviation of the sizes: W for `constant` and `beginning`, otherwise a share of the power of the kind.
    """

    level: str
    kind: str
    size: float


def _drag(view: EffectInputs) -> Floats:
    return np.asarray(0.5 * REFERENCE_DENSITY * view.car.drag_area * view.trace.speed**3)


def _climbing(view: EffectInputs) -> Floats:
    return np.asarray(view.car.mass * GRAVITY * np.maximum(view.trace.grade, 0.0) * view.trace.speed)


KINDS: Final[Mapping[str, Callable[[EffectInputs], Floats]]] = MappingProxyType(
    {
        "constant": lambda view: np.ones(len(view.trace.time)),
        "rolling": compute_rolling_power,
        "drag": _drag,
        "climbing": _climbing,
        "braking": compute_braking_power,
        "beginning": lambda view: np.exp(-view.trace.elapsed / START),
    }
)
"""Power of each kind of load, for a size of 1. [W]"""


def measure_with_loads(drives: Drives, loads: Sequence[RandomLoad], seed: int) -> Readings:
    """Return the readings of the cars with random loads.

    Returns
    -------
    Readings
        With the power of each load at a size of 1 as `hidden`, in the order of `loads`.
    """
    rng = np.random.default_rng([seed, 11])
    deviates: list[dict[object, float]] = [{} for _ in loads]
    cars, most = drives.vehicles, max(leg.first + leg.samples for leg in drives.legs)
    voltage, current, soc, hvac = np.full((4, len(cars), most), np.nan)
    out = Readings(voltage, current, soc, hvac, np.zeros((len(loads), len(cars), most)))
    for leg in drives.legs:
        view = leg.driven.view
        nominal = np.stack([KINDS[load.kind](view) for load in loads]) if loads else None
        power = np.zeros(len(view.trace.time))
        for number, (load, drawn) in enumerate(zip(loads, deviates, strict=True)):
            units = _name_units(leg, load.level)
            sizes = np.array([drawn.setdefault(unit, float(rng.normal())) if unit else 0.0 for unit in units])
            if nominal is not None:
                power += load.size * sizes[leg.driven.shift.timeline.ride] * nominal[number]
        enter_readings(out, cars.index(leg.member.name), leg, integrate_shift(leg, BASE, power), nominal)
    return out


def _name_units(leg: RecordedShift, level: str) -> list[object]:
    """Return the unit of each ride of a shift; the last entry, None, is that of the time between rides."""
    shift, name = leg.driven.shift, leg.member.name
    assert NO_RIDE == -1  # the last entry of the list
    whole: Mapping[str, object] = {"car": name, "date": int(shift.time // 86_400.0), "day": (name, leg.first)}
    if level in whole:
        return [whole[level]] * len(shift.trips) + [None]
    if level == "driver":
        return [*(trip.driver_id for trip in shift.trips), None]
    return [*((name, trip.ride_id) for trip in shift.trips), None]
