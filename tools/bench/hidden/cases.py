"""Define the data sets of the benchmark: hidden effects, drives, measurements, and the right names."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal

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
from socast.tools.simulator.hidden_shapes import strip_shape
from socast.tools.simulator.settings import Hidden

Weather = Literal["none", "noisy"]

BARE: Final = frozenset({"cabin_heating", "cabin_cooling"})
"""Effects that need cars without climate control and a model with constant auxiliaries as a base."""


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
