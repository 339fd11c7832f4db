"""The data sets of each part of the benchmark."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from itertools import product
from types import MappingProxyType
from typing import Final

import numpy as np

from tools.bench.hidden.cases import BARE, Case, Weather, get_right_names, strip_shape
from tools.bench.hidden.drives import FLEET, Scope
from tools.bench.hidden.recording import Measurement
from tools.simulator.hidden import EFFECTS
from tools.simulator.hidden_shapes import OTHER
from tools.simulator.settings import Hidden

SHARES: Final = (0.0075, 0.015, 0.03, 0.06)
SEEDS: Final = 10
NONE_SEEDS: Final = 25
"""Seeds of data sets with nothing hidden, four data sets each."""
FRESH: Final = 1000
"""First of their seeds: drives that nothing else is judged on."""
PAIRS: Final = 6
"""Pairs of effects a seed."""
PAIR_SHARE: Final = 0.03
"""Share of each of two effects, and of one in one vehicle or from a date on."""
OUTSIDE_SHARES: Final = (0.03, 0.06)
ABSORBED: Final = MappingProxyType(
    {
        "tyre_pressure": "a larger rolling resistance of each car, which it has of its own",
        "brake_drag": "a force that does not vary, as rolling resistance is",
        "roof_load": "a larger drag area of each car, which it has of its own",
        "standby": "a power that does not vary, as the accessories' is",
    }
)
"""Effects of the shape of the base's own columns, and of which: they leave no error where they are everywhere.

They can be told where they come and go: in one vehicle from a date on, or from a date on in all.
"""


@dataclass(frozen=True)
class Selection:
    """What of a part is run.

    Parameters
    ----------
    seeds : int
        How many; of `none` two and a half times as many.
    first : int
        The first of them: to judge on drives that nothing was developed on.
    effects : tuple of str
    shares : tuple of float
    measurements, weathers, shapes : tuple of str
        Shapes are `first`, the simulator's own, and `other`.
    """

    seeds: int = SEEDS
    first: int = 0
    effects: tuple[str, ...] = tuple(EFFECTS)
    shares: tuple[float, ...] = SHARES
    measurements: tuple[Measurement, ...] = ("vi", "soc")
    weathers: tuple[Weather, ...] = ("none", "noisy")
    shapes: tuple[str, ...] = ("first", "other")

    @property
    def names(self) -> list[str]:
        """Names of the effects in all shapes."""
        endings = {"first": "", "other": OTHER}
        return [effect + endings[shape] for shape in self.shapes for effect in self.effects]

    @property
    def numbers(self) -> range:
        """The seeds."""
        return range(self.first, self.first + self.seeds)

    def ways(self) -> list[tuple[Measurement, Weather]]:
        """Return measurements with weathers."""
        return list(product(self.measurements, self.weathers))


def make_single_effects(choice: Selection) -> Iterator[Case]:
    """Give data sets with one effect."""
    for seed, effect, share in product(choice.numbers, choice.names, choice.shares):
        yield from _measured(choice, Case(seed, (Hidden(effect, share),)))


def make_pairs(choice: Selection) -> Iterator[Case]:
    """Give data sets with two effects, pairs drawn at random of those that can be told."""
    able = [effect for effect in choice.effects if effect not in ABSORBED and effect not in BARE]
    for seed in choice.numbers if len(able) > 1 else ():
        rng = np.random.default_rng([seed, 9])
        for _ in range(PAIRS):
            pair = rng.choice(able, 2, replace=False)
            yield from _measured(choice, Case(seed, tuple(Hidden(str(effect), PAIR_SHARE) for effect in pair)))


def make_vehicle_effects(choice: Selection) -> Iterator[Case]:
    """Give data sets with one effect in one vehicle."""
    for seed, effect in product(choice.numbers, choice.effects):
        number = int(np.random.default_rng([seed, 10, *effect.encode()]).integers(FLEET.vehicles)) + 1
        case = Case(seed, (Hidden(effect, PAIR_SHARE),), where=Scope(vehicle=f"taxi-{number:03d}"))
        yield from _measured(choice, case)


def make_dated_effects(choice: Selection) -> Iterator[Case]:
    """Give data sets with one effect from a date on, in the middle half of the days."""
    for seed, effect in product(choice.numbers, choice.effects):
        rng = np.random.default_rng([seed, 11, *effect.encode()])
        day = int(rng.integers(FLEET.days // 4, FLEET.days - FLEET.days // 4))
        begins = FLEET.start + timedelta(days=day * FLEET.day_step)
        case = Case(seed, (Hidden(effect, PAIR_SHARE),), where=Scope(since=begins.date().isoformat()))
        yield from _measured(choice, case)


def make_empty(choice: Selection) -> Iterator[Case]:
    """Give data sets with nothing hidden, of drives of their own."""
    first, end = (-(-number * NONE_SEEDS // SEEDS) for number in (choice.first, choice.first + choice.seeds))
    for seed in range(first, end):
        yield from _measured(choice, Case(FRESH + seed))


def make_outside_effects(choice: Selection) -> Iterator[Case]:
    """Give data sets with an effect that is taken out of the library."""
    shares = [share for share in choice.shares if share in OUTSIDE_SHARES] or choice.shares
    for seed, effect, share in product(choice.numbers, choice.names, shares):
        yield from _measured(choice, Case(seed, (Hidden(effect, share),), without=get_right_names(strip_shape(effect))))


PARTS: Final[dict[str, Callable[[Selection], Iterator[Case]]]] = {
    "one": make_single_effects,
    "two": make_pairs,
    "vehicle": make_vehicle_effects,
    "date": make_dated_effects,
    "none": make_empty,
    "outside": make_outside_effects,
}
"""Part -> its data sets."""


def draw_sample(cases: Sequence[Case], size: int | None, seed: int = 0) -> list[Case]:
    """Return as many data sets, drawn at random, in their order; all of them where there are no more."""
    if size is None or len(cases) <= size:
        return list(cases)
    drawn = np.random.default_rng([seed, 12]).choice(len(cases), size, replace=False)
    return [cases[i] for i in sorted(drawn.tolist())]


def _measured(choice: Selection, case: Case) -> Iterator[Case]:
    """Give a data set as it is measured, under either weather."""
    for measurement, weather in choice.ways():
        yield replace(case, measurement=measurement, weather=weather)
