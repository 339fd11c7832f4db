"""Compute the factor by which a hidden effect is scaled to take its share of the energy."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.errors import SettingsError
from socast.tools.simulator.hidden import EffectInputs
from socast.tools.simulator.hidden_shapes import get_power
from socast.tools.simulator.settings import STEP, Hidden
from socast.tools.simulator.shift import NO_RIDE


class EffectEnergies(NamedTuple):
    """Hold the energies of rides.

    Parameters
    ----------
    battery : (rides,) float
        Energy at the terminals of the battery, without hidden effects. [J]
    effects : (rides, effects) float
        Energy of each hidden effect at natural size. [J]
    """

    battery: Floats
    effects: Floats


def sum_energies(view: EffectInputs, ride: Ints, hidden: Iterable[Hidden]) -> EffectEnergies:
    """Return the energies of the rides of a shift."""
    powers = [view.state.parts.sum(axis=1), *(get_power(effect)(view) for effect, _ in hidden)]
    inside = ride != NO_RIDE
    sums: list[Floats] = [np.bincount(ride[inside], power[inside]).astype(float) * STEP for power in powers]
    return EffectEnergies(sums[0], np.stack(sums[1:], axis=1))


def calibrate_effects(pilot: list[EffectEnergies], hidden: tuple[Hidden, ...]) -> list[float]:
    """Return the factor by which the power of each effect is multiplied.

    Notes
    -----
    The size of an effect is the sum of its absolute energy over all rides, divided by the energy of all rides with
    hidden effects. For an effect that always costs energy the size equals its share of the energy.
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
    """Raise an error if an effect does not exist."""
    for effect, _ in hidden:
        get_power(effect)
