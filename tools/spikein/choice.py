"""Choose which known effects are put into a recording to score its diagnosis."""

from dataclasses import dataclass
from itertools import product

from socast.tools.spikein.spike import Spike


@dataclass(frozen=True)
class ScoreChoice:
    """Choose what is put in.

    Parameters
    ----------
    effects : tuple of str
        Effects, with their forms.
    sizes : tuple of float
        Energy of the effect over that of the affected cars and times. [1]
    vehicles, since_s : tuple of str, float, optional
        Cars and time that have it, as of `Spike`.
    seeds : tuple of int
        Seeds of what the recording does not tell.
    """

    effects: tuple[str, ...]
    sizes: tuple[float, ...]
    vehicles: tuple[str, ...] = ()
    since_s: float | None = None
    seeds: tuple[int, ...] = (0,)

    def list_spikes(self) -> list[Spike]:
        """Return one spike for each effect, size and seed."""
        made = product(self.effects, self.sizes, self.seeds)
        return [Spike(effect, size, self.vehicles, self.since_s, seed) for effect, size, seed in made]
