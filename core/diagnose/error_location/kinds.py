"""Define the kinds of load by which rides, days and cars may differ, as columns of energy of the windows."""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.fit.ride_blocks import get_numbers

BEGINNING: Final = 300.0
"""Time constant with which a load at the beginning of a ride decays. [s]"""
LEAST_POWER: Final = 0.02
"""Mean power of a kind below which these drives cannot tell its size. [kW]"""


class Kind(NamedTuple):
    """Describe a kind of load.

    Parameters
    ----------
    unit : str
        Unit of its size: W, or % of the energy that the catalogue expects.
    energy : callable
        Returns the energy of each window [kWh] of a table for 1 kW, or for the whole energy of the catalogue.
    """

    name: str
    unit: str
    energy: Callable[[pd.DataFrame], Floats]


class KindColumns(NamedTuple):
    """Hold the energies of the kinds that some windows have, scaled so that each has a mean power of 1 kW.

    Parameters
    ----------
    columns : (n, k) float
        Energies. [kWh per kW]
    power : (k,) float
        Mean power of each kind at its nominal size. [kW]
    """

    kinds: tuple[Kind, ...]
    columns: Floats
    power: Floats
    dropped: tuple[str, ...]


def _hours(table: pd.DataFrame) -> Floats:
    return get_numbers(table, "duration_s") / 3600.0


def _at_beginning(table: pd.DataFrame) -> Floats:
    """Return the hours of each window times the mean of exp(-t / 300 s) over it, zero where t is unknown."""
    if "elapsed_s" not in table:
        return np.zeros(len(table))
    length, begin = get_numbers(table, "duration_s") / BEGINNING, get_numbers(table, "elapsed_s") / BEGINNING
    mean = -np.expm1(-length) / np.maximum(length, 1e-12)
    return np.asarray(np.nan_to_num(_hours(table) * np.exp(-begin) * mean))


def _of_effect(name: str, parameter: str = "") -> Callable[[pd.DataFrame], Floats]:
    """Return the function that reads the energy of an effect, times a parameter of the car."""

    def read(table: pd.DataFrame) -> Floats:
        if name not in table:
            return np.zeros(len(table))
        energy = get_numbers(table, name) * (get_numbers(table, parameter) if parameter else 1.0)
        return np.asarray(np.nan_to_num(energy))

    return read


KINDS: Final = (
    Kind("constant", "W", _hours),
    Kind("rolling", "%", _of_effect("effect_rolling", "rolling_resistance")),
    Kind("drag", "%", _of_effect("effect_aero_drag", "drag_area_m2")),
    Kind("climbing", "%", _of_effect("effect_climbing_up")),
    Kind("braking", "%", _of_effect("effect_braking")),
    Kind("beginning", "W", _at_beginning),
)
"""Per second, per km, per km and speed squared, per metre climbed, per braking, and at the beginning of a ride."""


def gather_kinds(table: pd.DataFrame) -> KindColumns:
    """Return the kinds of load that the windows of a table have."""
    hours = float(_hours(table).sum())
    energies = {kind: kind.energy(table) for kind in KINDS}
    power = {kind: float(energy.sum()) / hours for kind, energy in energies.items()}
    kept = tuple(kind for kind in KINDS if power[kind] >= LEAST_POWER)
    columns = np.column_stack([energies[kind] / power[kind] for kind in kept])
    dropped = tuple(kind.name for kind in KINDS if kind not in kept)
    return KindColumns(kept, columns, np.array([power[kind] for kind in kept]), dropped)
