"""Faults of loggers: each changes the samples of a car as real loggers are known to.

A fault of one kind of value needs a witness of another kind, or nothing could show it. `settle` gives the car one: an
odometer or fixes beside a wrong speed, a counter beside a clock that is set forward, a charge beside a wrong current.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Ints
from socast.tools.bench.league.loggers import Car, Log

VALUES, SAMPLES, CLOCK, ORDER = range(4)
"""Stages in which faults act: on values, on which samples there are, on stamps, on the order of arrival."""
CAUSES: Final = {
    "clock": (
        *("gap", "clock", "time", "stamp", "counter", "sequence", "pause", "too_long", "too_short", "missing"),
        *("distance", "speed"),
    ),
    "speed": ("speed", "distance", "odometer", "bridge", "too_long"),
    "position": ("position", "fix", "distance", "speed", "slope", "bridge"),
    "odometer": ("odometer", "distance", "speed"),
    "current": ("current", "power", "energy", "meter", "contradictory"),
    "charge": ("soc", "charg", "energy", "capacity", "contradictory", "too_long"),
}
"""Words of the reasons that name each family of faults."""


class Fault(NamedTuple):
    """Describe a fault.

    Parameters
    ----------
    name, family : str
        Its name, and the key in `CAUSES` of the reasons for which a ride may be unfit.
    spoils : tuple of str
        What it makes useless as a witness: `speed`, `position`, `odometer`, `power`, `soc`, `counter`, `stamp`. Two
        faults that spoil the same never act together.
    apply : callable
        Function that changes the samples of a car.
    prepare : callable
        Function that makes the car one that can have the fault.
    """

    name: str
    family: str
    stage: int
    spoils: tuple[str, ...]
    apply: Callable[[Log, np.random.Generator], None]
    prepare: Callable[[Car, np.random.Generator], None]
    stays: tuple[str, ...]

    @property
    def meaning(self) -> str:
        """Say in one sentence what it does."""
        return (self.apply.__doc__ or "").partition("\n")[0]


FAULTS: Final[dict[str, Fault]] = {}
"""Every fault by its name."""
Apply = Callable[[Log, np.random.Generator], None]


def _keep(_: Car, __: np.random.Generator) -> None:
    """Leave a car as it is."""


def fault(
    family: str,
    stage: int = VALUES,
    *spoils: str,
    prepare: Callable[[Car, np.random.Generator], None] = _keep,
    stays: tuple[str, ...] = (),
) -> Callable[[Apply], Apply]:
    """Declare a fault by a function that has its name."""

    def declare(apply: Apply) -> Apply:
        name = apply.__name__
        FAULTS[name] = Fault(name, family, stage, spoils, apply, prepare, stays)
        return apply

    return declare


def find_spoiled(faults: Sequence[Fault]) -> set[str]:
    """Return what faults make useless as a witness."""
    return {part for each in faults for part in each.spoils}


def are_compatible(one: Fault, other: Fault) -> bool:
    """Return whether two faults can act together: they spoil different things, and leave a witness of the motion."""
    takes = find_spoiled((one, other))
    blind = takes >= {"speed", "odometer", "position"}
    stays = not (one.stays and other.stays) or one.stays == other.stays
    return len(takes) == len(one.spoils) + len(other.spoils) and not blind and stays


def settle(car: Car, faults: Sequence[Fault], rng: np.random.Generator) -> None:
    """Prepare a car for its faults, and give it the witnesses by which they can be noticed."""
    for each in faults:
        each.prepare(car, rng)
    spoiled = find_spoiled(faults)
    motion = [part for part in ("odometer", "position") if part not in spoiled]
    is_blind = "speed" in spoiled or "speed" not in car.sends
    if is_blind and not any(part in car.sends for part in motion):
        car.sends.add(str(rng.choice(motion)))
    if "power" in spoiled:
        car.sends.update(("power", "soc"))
    if any(each.family == "position" and "absent" not in each.name for each in faults):
        car.sends.add("position")


def find_drives(log: Log) -> Iterator[Ints]:
    """Yield the rows of each drive."""
    for number in range(len(log.car.track.drives)):
        rows = np.flatnonzero(log.drive == number)
        if len(rows) > 3:
            yield rows


def pick_block(log: Log, rows: Ints, rng: np.random.Generator, least: float, most: float) -> Ints:
    """Return the rows of some seconds within a drive."""
    true = log.true[rows]
    duration = min(rng.uniform(least, most), 0.6 * (true[-1] - true[0]))
    begin = rng.uniform(true[0] + 10.0, max(true[0] + 11.0, true[-1] - duration))
    block = rows[(true >= begin) & (true <= begin + duration)]
    return block if len(block) else rows[len(rows) // 2 : len(rows) // 2 + 1]
