"""One data set of the benchmark: what is hidden in which drives, how it is measured, and what counts as found."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Final, Literal

from tools.bench.hidden.drives import (
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
from tools.bench.hidden.recording import Measurement, Recording, Tables, add_weather_noise, record_drives
from tools.simulator.hidden_shapes import OTHER
from tools.simulator.settings import Hidden

Weather = Literal["none", "noisy"]

RIGHT_NAMES: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "drivetrain_loss": ("drivetrain_loss_power", "drivetrain_loss_torque", "drivetrain_loss_speed"),
        "humidity": ("humidity", "demisting"),
    }
)
"""What counts as the right name where the library calls a cause otherwise than the simulator, or by several names.

`drivetrain_loss`: the simulator's loss grows with the square of the power at the wheels; the library has one effect
that grows with the square of the power, one with that of the force and one with that of the speed, which make it up.
`humidity`: the simulator's is the drying of damp air, by relative humidity; the library has that as `demisting`, and
as `humidity` the latent load of cooling, by vapour pressure. Both dry air.
"""
BARE: Final = frozenset({"cabin_heating", "cabin_cooling"})
"""Effects that the base must not have already: cars without climate control, and a model with constant auxiliaries."""


@dataclass(frozen=True)
class Case:
    """A data set.

    Parameters
    ----------
    seed : int
    hidden : tuple of Hidden
        Effects and their shares of the energy.
    measurement : {"vi", "soc"}
    weather : {"none", "noisy"}
        Error of wind and rain in what the weather stations say.
    where : Where
    without : tuple of str
        Effects of the library that diagnosis is not to ask of.
    """

    seed: int
    hidden: tuple[Hidden, ...] = ()
    measurement: Measurement = "vi"
    weather: Weather = "none"
    where: Scope = EVERYWHERE
    without: tuple[str, ...] = ()

    @property
    def bare(self) -> bool:
        """Whether the cars have no climate control and the model no accessory curve."""
        return any(strip_shape(effect) in BARE for effect, _ in self.hidden)

    @property
    def recipe(self) -> str:
        """Recipe of the model that is diagnosed."""
        return "road_load_constant" if self.bare else "road_load"


def strip_shape(effect: str) -> str:
    """Return the name of an effect whichever its shape."""
    return effect.removesuffix(OTHER)


def get_right_names(effect: str) -> tuple[str, ...]:
    """Return the effects of the library that are right to be named where this one is hidden."""
    return RIGHT_NAMES.get(strip_shape(effect), (strip_shape(effect),))


class SeedData:
    """All data sets of a seed.

    Parameters
    ----------
    seed : int
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._recordings: dict[str, Recording] = {}
        self._last: tuple[object, Readings] | None = None

    @cached_property
    def drives(self) -> Drives:
        """The drives of the seed."""
        return simulate_drives(replace(FLEET, seed=self.seed), TURNS)

    def recording(self, weather: Weather) -> Recording:
        """Return what a consumer has, under one weather or the other."""
        if weather not in self._recordings:
            messages = add_weather_noise(self.drives.messages, self.seed) if weather == "noisy" else None
            self._recordings[weather] = record_drives(self.drives, messages)
        return self._recordings[weather]

    def tables(self, case: Case) -> Tables:
        """Return a data set.

        Raises
        ------
        SettingsError
            For an effect that has nothing to act on there.
        """
        asked = case.hidden, case.where
        if self._last is None or self._last[0] != asked:  # measurements and weathers share what happened
            phenomena = NO_CLIMATE if case.bare else BASE
            self._last = asked, self.drives.measured(case.hidden, case.where, phenomena)
        names = [effect for effect, _ in case.hidden]
        return self.recording(case.weather).tables(self._last[1], case.measurement, names)
