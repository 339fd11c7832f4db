"""Build the candidates of a diagnosis: the effects of the library at each value of their parameters."""

from collections.abc import Collection
from dataclasses import dataclass
from math import inf
from typing import Final

import numpy as np

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.diagnose.dataset import Windows
from socast.core.effects import ROAD_LOAD
from socast.core.effects.declaration import VARIANT
from socast.core.fit.ride_blocks import get_numbers
from socast.core.models import LinearModel
from socast.core.models.features import EFFECT_PREFIX

LEAST_SHARE: Final = 0.003
"""Share of the energy that an effect must exceed, because samples every few seconds distort as much."""
LEAST_KNOWN: Final = 0.5
"""Share of the windows in which an effect must be known to be a candidate."""

NO_COLUMN: Final = "not in the tables"
NO_SIGNAL: Final = "not in the data"
NEVER_ACTS: Final = "zero in these drives"
"""Why an effect is no candidate: the tables lack its columns, its signal is known in too few windows, or it has no
energy, because its threshold is not reached, or its signal is unknown or stays at zero."""
NOT_IDENTIFIABLE: Final = "not identifiable beside the model"
"""Result for a candidate that the terms of the model can imitate."""


@dataclass(frozen=True)
class Candidates:
    """Hold k candidates: the energy of each in each of n windows, per unit of its coefficient.

    Parameters
    ----------
    variants : (k,) str
        Names of the effects or of their variants.
    effects : (k,) int64
        Index in `names` of the effect of each variant.
    sign : (k,) int64
        Sign of the coefficient that physics demands: 1, -1, or 0 for either.
    columns : (n, k) float
        Energy. [kWh per unit of the coefficient]
    excluded : dict of str to str
        Effects that are not candidates, with the reason.
    """

    variants: tuple[str, ...]
    effects: Ints
    names: tuple[str, ...]
    sign: Ints
    columns: Floats
    excluded: dict[str, str]

    def get_limits(self, at: int) -> tuple[float, float]:
        """Return the smallest and the largest plausible coefficient of a candidate, which include 0."""
        return find_coefficient_limits(self.variants[at], int(self.sign[at]))


def find_coefficient_limits(variant: str, sign: int) -> tuple[float, float]:
    """Return the smallest and the largest plausible coefficient of an effect, which include 0."""
    if variant.split(VARIANT, maxsplit=1)[0] not in effects.get_library():
        return (-inf if sign <= 0 else 0.0), (inf if sign >= 0 else 0.0)
    effect = effects.get(variant)
    return min(effect.low, 0.0), max(effect.high, 0.0)


def compute_least_coefficients(columns: Floats, measured: Floats) -> Floats:
    """Return the coefficient with which the absolute energy of each variant has the share `LEAST_SHARE`.

    Units: measured [kWh].
    """
    size = np.abs(columns).sum(axis=0)
    out = np.full(len(size), np.inf)
    return np.divide(LEAST_SHARE * float(measured.sum()), size, out=out, where=size > 0.0)


def build_candidates(windows: Windows, model: LinearModel, without: Collection[str] = ()) -> Candidates:
    """Return the effects of the library that a model lacks.

    Returns
    -------
    Candidates
        All variants that are known in enough windows, and the reasons for which other effects are excluded.
    """
    base = {effect.name for effect in ROAD_LOAD}
    inside = {effects.get(name).base for name in model.effects}
    excluded: dict[str, str] = {}
    variants: list[tuple[str, str]] = []
    for name, effect in effects.get_library().items():
        if name in base or name in without:
            continue
        if name in inside:
            excluded[name] = "in the model"
            continue
        tabulated = [v.name for v in (effect, *effect.variants) if f"{EFFECT_PREFIX}{v.name}" in windows.table]
        columns = {v: get_numbers(windows.table, f"{EFFECT_PREFIX}{v}") for v in tabulated}
        known = [v for v, column in columns.items() if np.isfinite(column).mean() >= LEAST_KNOWN]
        if acting := [v for v in known if np.any(columns[v])]:
            variants += [(name, v) for v in acting]
        else:
            excluded[name] = NEVER_ACTS if known else NO_SIGNAL if columns else NO_COLUMN
    names = tuple(dict.fromkeys(name for name, _ in variants))
    stacked = [np.nan_to_num(get_numbers(windows.table, f"{EFFECT_PREFIX}{v}"), nan=0.0) for _, v in variants]
    return Candidates(
        variants=tuple(v for _, v in variants),
        effects=np.array([names.index(name) for name, _ in variants], dtype=np.int64),
        names=names,
        sign=np.array([effects.get(name).sign for name, _ in variants], dtype=np.int64),
        columns=np.column_stack(stacked) if stacked else np.empty((len(windows.measured), 0)),
        excluded=excluded,
    )
