"""Define the data sets of the benchmark: hidden effects, drives and measurements, and those of each part."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from types import MappingProxyType
from typing import Final, Literal

import numpy as np

from socast.tools.bench.hidden.drives import (
    BASE,
    EVERYWHERE,
    FLEET,
    NO_CLIMATE,
    TURNS,
    Drives,
    Readings,
    Scope,
    simulate_drives,
)
from socast.tools.bench.hidden.recording import Measurement, Recording, Tables, add_weather_noise, record_drives
from socast.tools.simulator.hidden import EFFECTS
from socast.tools.simulator.hidden_shapes import BENT, OTHER, get_right_names, strip_shape
from socast.tools.simulator.settings import Hidden

Weather = Literal["none", "noisy"]

BARE: Final = frozenset({"cabin_heating", "cabin_cooling"})
"""Effects that need cars without climate control and a model with constant auxiliaries as a base."""
SHARES: Final = (0.0075, 0.015, 0.03, 0.06)
SEEDS: Final = 10
NONE_SEEDS: Final = 25
"""Number of seeds of data sets without hidden effects, with four data sets each."""
FRESH: Final = 1000
"""First seed of data sets without hidden effects; no other part uses their drives."""
PAIRS: Final = 6
"""Number of pairs of effects for each seed."""
PAIR_SHARE: Final = 0.03
"""Share of the energy of each of two effects. [1]"""
SHAPES: Final = ("first", "other", "bent")
"""Shapes of the hidden effects. Constants of diagnosis are chosen on `first` and `bent` only."""
OUTSIDE_SHARES: Final = (0.03, 0.06)
ABSORBED: Final = MappingProxyType(
    {
        "tyre_pressure": "a larger rolling resistance of each car, which the base fits",
        "brake_drag": "a constant force, such as rolling resistance",
        "roof_load": "a larger drag area of each car, which the base fits",
        "standby": "a constant power, such as that of accessories",
        "age": "a share of the driving power that each car has for good, which the base fits as the scale of its terms",
    }
)
"""Effects with the shape of columns of the base, and these columns; they leave no error if they are everywhere.

They are visible only where they change: in one vehicle from a date on, or in all vehicles from a date on.
"""


@dataclass(frozen=True)
class Case:
    """Describe a data set.

    Parameters
    ----------
    hidden : tuple of Hidden
        Effects and their shares of the energy.
    measurement : {"vi", "soc"}
        Whether the cars report voltage and current, or the state of charge only.
    weather : {"none", "noisy"}
        Error of wind and rain in the observations of the stations.
    where : Scope
        Cars and dates in which the effects are hidden.
    without : tuple of str
        Effects that are removed from the candidates of diagnosis.
    """

    seed: int
    hidden: tuple[Hidden, ...] = ()
    measurement: Measurement = "vi"
    weather: Weather = "none"
    where: Scope = EVERYWHERE
    without: tuple[str, ...] = ()

    @property
    def bare(self) -> bool:
        """Whether the cars have no climate control and the model has no accessory curve."""
        return any(strip_shape(effect) in BARE for effect, _ in self.hidden)

    @property
    def recipe(self) -> str:
        """Recipe of the model that is diagnosed."""
        return "road_load_constant" if self.bare else "road_load"


class SeedData:
    """Make all data sets of a seed from one simulation."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._recordings: dict[str, Recording] = {}
        self._last: tuple[object, Readings] | None = None

    @cached_property
    def drives(self) -> Drives:
        """The drives of the seed."""
        return simulate_drives(replace(FLEET, seed=self.seed), TURNS)

    def recording(self, weather: Weather) -> Recording:
        """Return what a consumer receives with exact or noisy weather."""
        if weather not in self._recordings:
            messages = add_weather_noise(self.drives.messages, self.seed) if weather == "noisy" else None
            self._recordings[weather] = record_drives(self.drives, messages)
        return self._recordings[weather]

    def tables(self, case: Case) -> Tables:
        """Return the tables of a data set."""
        key = case.hidden, case.where
        if self._last is None or self._last[0] != key:  # all measurements and weathers share the same readings
            phenomena = NO_CLIMATE if case.bare else BASE
            self._last = key, self.drives.measured(case.hidden, case.where, phenomena)
        names = [effect for effect, _ in case.hidden]
        return self.recording(case.weather).tables(self._last[1], case.measurement, names)


@dataclass(frozen=True)
class Selection:
    """Select the data sets of a part.

    Parameters
    ----------
    seeds : int
        Number of seeds; the part `none` has two and a half times as many.
    first : int
        First seed, to evaluate on drives that were not used in development.
    shares : tuple of float
        Shares of the energy. [1]
    measurements, weathers, shapes : tuple of str
        Measurements, errors of the weather, and shapes of the effects: `first` as in `hidden`, `other` as in
        `hidden_shapes`, `bent` as in its `bend_shape`.
    """

    seeds: int = SEEDS
    first: int = 0
    effects: tuple[str, ...] = tuple(EFFECTS)
    shares: tuple[float, ...] = SHARES
    measurements: tuple[Measurement, ...] = ("vi", "soc")
    weathers: tuple[Weather, ...] = ("none", "noisy")
    shapes: tuple[str, ...] = SHAPES

    @property
    def numbers(self) -> range:
        """The seeds."""
        return range(self.first, self.first + self.seeds)

    def ways(self) -> list[tuple[Measurement, Weather]]:
        """Return all combinations of measurements and weathers."""
        return list(product(self.measurements, self.weathers))

    def list_singles(self) -> Iterator[tuple[int, str]]:
        """Yield each seed with the name of each effect in each shape."""
        for seed, shape, effect in product(self.numbers, self.shapes, self.effects):
            yield seed, select_shape(effect, shape, seed)


def select_shape(effect: str, shape: str, seed: int) -> str:
    """Return the name of an effect in a shape.

    Parameters
    ----------
    seed : int
        Number of the bent shape; no other effect bends in the same way at the same number.

    Examples
    --------
    >>> [select_shape("snow", shape, 7) for shape in SHAPES]
    ['snow', 'snow~other', 'snow~bent7']
    """
    return effect + {"first": "", "other": OTHER, "bent": f"{BENT}{seed}"}[shape]


def make_single_effects(choice: Selection) -> Iterator[Case]:
    """Yield data sets with one effect."""
    for (seed, effect), share in product(choice.list_singles(), choice.shares):
        yield from _measured(choice, Case(seed, (Hidden(effect, share),)))


def make_pairs(choice: Selection) -> Iterator[Case]:
    """Yield data sets with two effects that no column of the base absorbs, drawn at random, each in a random shape."""
    able = [effect for effect in choice.effects if effect not in ABSORBED and effect not in BARE]
    for seed in choice.numbers if len(able) > 1 else ():
        rng = np.random.default_rng([seed, 9])
        for _ in range(PAIRS):
            pair, shapes = rng.choice(able, 2, replace=False), rng.choice(choice.shapes, 2)
            names = [select_shape(str(e), str(shape), seed) for e, shape in zip(pair, shapes, strict=True)]
            yield from _measured(choice, Case(seed, tuple(Hidden(name, PAIR_SHARE) for name in names)))


def make_empty(choice: Selection) -> Iterator[Case]:
    """Yield data sets without hidden effects, on drives that no other part uses."""
    first, end = (-(-number * NONE_SEEDS // SEEDS) for number in (choice.first, choice.first + choice.seeds))
    for seed in range(first, end):
        yield from _measured(choice, Case(FRESH + seed))


def make_outside_effects(choice: Selection) -> Iterator[Case]:
    """Yield data sets with an effect that is removed from the library."""
    shares = [share for share in choice.shares if share in OUTSIDE_SHARES] or choice.shares
    for (seed, effect), share in product(choice.list_singles(), shares):
        yield from _measured(choice, Case(seed, (Hidden(effect, share),), without=get_right_names(strip_shape(effect))))


PARTS: Final[dict[str, Callable[[Selection], Iterator[Case]]]] = {
    "one": make_single_effects,
    "two": make_pairs,
    "none": make_empty,
    "outside": make_outside_effects,
}
"""Function that yields the data sets of each part."""


def draw_sample(cases: Sequence[Case], size: int | None) -> list[Case]:
    """Return data sets drawn at random, in their order; all of them if there are not more."""
    if size is None or len(cases) <= size:
        return list(cases)
    drawn = np.random.default_rng([0, 12]).choice(len(cases), size, replace=False)
    return [cases[i] for i in sorted(drawn.tolist())]


def _measured(choice: Selection, case: Case) -> Iterator[Case]:
    """Yield a data set with each measurement and each weather."""
    for measurement, weather in choice.ways():
        yield replace(case, measurement=measurement, weather=weather)
