"""How strong a hidden effect has to be to take its share of the energy."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from core.batch import Floats, Ints
from core.errors import SettingsError
from tools.simulator.hidden import EffectInputs
from tools.simulator.hidden_shapes import POWERS
from tools.simulator.settings import STEP, Hidden
from tools.simulator.shift import NO_RIDE


class EffectEnergies(NamedTuple):
    """Energies of some rides: of the battery without hidden effects, and of each effect at natural size. [J]."""

    battery: Floats
    effects: Floats


def sum_energies(view: EffectInputs, ride: Ints, hidden: Iterable[Hidden]) -> EffectEnergies:
    """Return the energies of the rides of a shift. `battery` (rides,), `effects` (rides, effects)."""
    powers = [view.state.parts.sum(axis=1), *(POWERS[effect](view) for effect, _ in hidden)]
    inside = ride != NO_RIDE
    sums: list[Floats] = [np.bincount(ride[inside], power[inside]).astype(float) * STEP for power in powers]
    return EffectEnergies(sums[0], np.stack(sums[1:], axis=1))


def calibrate_effects(pilot: list[EffectEnergies], hidden: tuple[Hidden, ...]) -> list[float]:
    """Return the factor by which each effect has to be multiplied.

    Notes
    -----
    The size of an effect is the sum over rides of its absolute energy, over the energy of all rides, hidden effects
    included; for an effect that only ever costs energy that is simply its share.

    Raises
    ------
    SettingsError
        For an effect that has nothing to act on, such as cooling in January.
    """
    battery = float(np.concatenate([energies.battery for energies in pilot]).sum())
    effects = np.concatenate([energies.effects for energies in pilot])
    absolute, signed = np.abs(effects).sum(axis=0), effects.sum(axis=0)
    for (effect, size), energy in zip(hidden, absolute, strict=True):
        if energy < 1e-5 * battery:
            raise SettingsError(
                f"hidden effect {effect} uses {energy / battery:.1e} of the energy in this season, too little "
                f"to make it {size:g}; choose other dates or another effect"
            )
    sizes = np.array([size for _, size in hidden])
    total = battery / (1 - float((sizes * signed / absolute).sum()))
    return [float(factor) for factor in sizes * total / absolute]


def check_effects(hidden: tuple[Hidden, ...]) -> None:
    """Refuse an effect that does not exist.

    Raises
    ------
    SettingsError
    """
    for effect, _ in hidden:
        if effect not in POWERS:
            raise SettingsError(f"no hidden effect is called {effect!r}; choose from {', '.join(sorted(POWERS))}")
