"""What is asked of the data: the library's effects at each value of their parameters, everywhere or in one place."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from core import effects
from core.batch import Floats, Ints
from core.diagnose.dataset import Windows
from core.effects.declaration import VARIANT
from core.effects.road_load import ROAD_LOAD
from core.fit.ride_blocks import get_numbers
from core.models import LinearModel
from core.models.features import EFFECT_PREFIX

LEAST_SHARE: Final = 0.003
"""Share of the energy that an effect must take beyond doubt: samples every few seconds distort as much."""
BENDS: Final = "turn_rate"
"""Column that an effect asks for which acts in bends."""
LEAST_IN_BENDS: Final = 0.01
"""The same of what acts in bends: a car slows before and speeds up after them between two samples, so that the kinetic
energy of the samples misses up to 1 % of the energy, just there."""
KNOWN: Final = 0.5
"""Share of the windows in which an effect must be known to be asked of."""


@dataclass(frozen=True)
class Candidates:
    """Candidates: k columns of what each would take of each of n windows, per unit of its coefficient.

    Parameters
    ----------
    variants : (k,) str
        Effects, or variants of them.
    effects : (k,) int64
        Which of `names` each is of.
    names : tuple of str
        Effects that are asked of.
    sign : (k,) int64
        That physics demands of the coefficient: 1, -1, or 0 for either.
    columns : (n, k) float
        [kWh per unit of the coefficient]
    measured : (n,) float
        Energy of the windows that are asked of, 0 of all others. [kWh]
    scope : tuple of str
        Indicator columns, `vehicle=...` or `since=...`, where the effects are asked of in a place only.
    excluded : dict of str to str
        Effects that are not asked of, and why.
    """

    variants: tuple[str, ...]
    effects: Ints
    names: tuple[str, ...]
    sign: Ints
    columns: Floats
    measured: Floats
    scope: tuple[str, ...]
    excluded: dict[str, str]

    def restrict_to(self, rows: NDArray[np.bool_], scope: tuple[str, ...]) -> "Candidates":
        """Return the same asked of some windows only, (n,) bool."""
        return replace(self, columns=self.columns * rows[:, np.newaxis], measured=self.measured * rows, scope=scope)

    @property
    def least_coefficients(self) -> Floats:
        """Coefficient with which each would be worth a name, (k,), see `least_coefficients`."""
        return compute_least_coefficients(self.variants, self.columns, self.measured)


def compute_least_coefficients(variants: Sequence[str], columns: Floats, measured: Floats) -> Floats:
    """Return the coefficient with which each variant takes `least_share` of the energy, either sign counted, (k,)."""
    size = np.abs(columns).sum(axis=0)
    out = np.full(len(size), np.inf)
    wanted = np.array([compute_least_share(variant) for variant in variants]) * float(measured.sum())
    return np.divide(wanted, size, out=out, where=size > 0.0)


def compute_least_share(variant: str) -> float:
    """Return the share of the energy that an effect must take beyond doubt, which samples may feign.

    Examples
    --------
    >>> compute_least_share("headwind"), compute_least_share("cornering")
    (0.003, 0.01)
    """
    return LEAST_IN_BENDS if BENDS in list_input_columns(variant) else LEAST_SHARE


def list_input_columns(variant: str) -> tuple[str, ...]:
    """Return the columns that an effect, or a variant of one, asks for; none where the library does not have it."""
    effect = effects.get_library().get(variant.split(VARIANT, maxsplit=1)[0])
    return () if effect is None else effect.arguments


def build_candidates(
    windows: Windows, model: LinearModel, without: Collection[str] = (), scopes: bool = False
) -> Candidates:
    """Return the library's effects that a model lacks.

    Parameters
    ----------
    windows : Windows
    model : LinearModel
    without : collection of str
        Effects not to ask of.
    scopes : bool
        Whether to ask of those too that the model has everywhere, as they may be larger in some place.

    Returns
    -------
    Asked
    """
    base = {effect.name for effect in ROAD_LOAD}
    inside = set() if scopes else {effects.get(name).base for name in model.effects}
    excluded: dict[str, str] = {}
    found: list[tuple[str, str]] = []
    for name, effect in effects.get_library().items():
        if name in base or name in without:
            continue
        if name in inside:
            excluded[name] = "in the model"
            continue
        there = [v.name for v in (effect, *effect.variants) if f"{EFFECT_PREFIX}{v.name}" in windows.table]
        columns = {v: get_numbers(windows.table, f"{EFFECT_PREFIX}{v}") for v in there}
        known = [v for v, column in columns.items() if np.isfinite(column).mean() >= KNOWN and np.any(column)]
        if known:
            found += [(name, v) for v in known]
        else:
            excluded[name] = "not in the data"
    names = tuple(dict.fromkeys(name for name, _ in found))
    stacked = [np.nan_to_num(get_numbers(windows.table, f"{EFFECT_PREFIX}{v}"), nan=0.0) for _, v in found]
    return Candidates(
        variants=tuple(v for _, v in found),
        effects=np.array([names.index(name) for name, _ in found], dtype=np.int64),
        names=names,
        sign=np.array([effects.get(name).sign for name, _ in found], dtype=np.int64),
        columns=np.column_stack(stacked) if stacked else np.empty((len(windows.measured), 0)),
        measured=windows.measured,
        scope=(),
        excluded=excluded,
    )
