"""Build the shapes that a real effect may have: its textbook form at each value of its parameters, and bends of each.

No real effect has exactly the form of a textbook. An effect that is compared with others by its exact form alone loses
to a wrong one that happens to bend in the same way. Each form x therefore comes with bends x z, where z is a bounded
function of the conditions with mean 0 and variance 1 over the energy of x: the logarithm of the power and its square
(exponents, thresholds, saturation), the speed, the outside temperature, and the time since the start of the ride. An
effect that acts by time may also lag. The size of each bend, relative to the effect, has the prior standard deviation
`BEND`.

References
----------
Kennedy and O'Hagan, Journal of the Royal Statistical Society B 63 (2001) 425, DOI 10.1111/1467-9868.00294, model
discrepancy. Brynjarsdóttir and O'Hagan, Inverse Problems 30 (2014) 114007, DOI 10.1088/0266-5611/30/11/114007, on why
the discrepancy needs an informative prior.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.diagnose.candidates import Candidates
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.projection import BaseProjection
from socast.core.effects.declaration import VARIANT, Effect
from socast.core.fit.ride_blocks import get_numbers

BEND: Final = 0.25
"""Prior standard deviation of each bend of an effect, relative to the effect. [1]"""
MOST_SIGMAS: Final = 2.5
"""Largest absolute value of the function of a bend, in standard deviations."""
LEAST_QUANTILE: Final = 0.02
"""Quantile of the powers of an effect below which they count as the quantile, because zero has no logarithm."""
START: Final = 60.0
"""Time since the start of the ride below which it changes little. [s]"""
MEMORY: Final = 0.6
"""Weight of the past in the mean of earlier windows, by which an effect may lag."""


@dataclass(frozen=True)
class Families:
    """Hold the forms of all candidates and the bends of each, off the terms of the model.

    Parameters
    ----------
    variants : (k,) str
        Names of the effects or of their variants.
    effects : (k,) int64
        Index of the effect of each among the names of the candidates.
    signs : (k,) int64
        Sign of the coefficient that physics demands: 1, -1, or 0 for either.
    plausible : list of ((float, float) or None)
        Range of plausible coefficients of each; None where the library does not have the effect.
    columns : (n, columns) float
        The forms, each followed by its bends, weighted and projected. [1 per unit of the coefficient]
    ends : (k,) int64
        End of the columns of each form.
    left : (k,) float
        Share of the size of each form that the terms of the model cannot explain. [1]
    energy : (k,) float
        Absolute energy of each form over all windows. [kWh per unit of the coefficient]
    """

    variants: tuple[str, ...]
    effects: Ints
    names: tuple[str, ...]
    signs: Ints
    plausible: list[tuple[float, float] | None]
    columns: Floats
    ends: Ints
    left: Floats
    energy: Floats

    def locate(self, at: int) -> slice:
        """Return the place of a form and its bends among the columns."""
        return slice(int(self.ends[at - 1]) if at else 0, int(self.ends[at]))


def build_families(base: BaseProjection, candidates: Candidates) -> Families:
    """Return the shapes of all candidates, off the terms of a model."""
    bends = Bends(base)
    blocks = [np.empty((len(base.residual), 0))]
    for at, variant in enumerate(candidates.variants):
        energy = candidates.columns[:, at]
        blocks += [energy[:, np.newaxis], bends.build(energy, acts_by_time(variant))]
    columns = base.project_out(np.column_stack(blocks))
    ends = np.cumsum([block.shape[1] for block in blocks])[2::2]
    starts = np.r_[0, ends[:-1]].astype(np.int64)
    whole = (base.apply_weights(candidates.columns) ** 2).sum(axis=0)
    off = (columns[:, starts] ** 2).sum(axis=0)
    return Families(
        variants=candidates.variants,
        effects=candidates.effects,
        names=candidates.names,
        signs=candidates.sign,
        plausible=[None if each is None else (each.low, each.high) for each in map(find_effect, candidates.variants)],
        columns=columns,
        ends=ends.astype(np.int64),
        left=np.divide(off, whole, out=np.zeros(len(whole)), where=whole > 0.0),
        energy=np.abs(candidates.columns).sum(axis=0),
    )


def find_effect(variant: str) -> Effect | None:
    """Return the effect of a variant, None if the library does not have it."""
    return effects.get_library().get(variant.split(VARIANT, maxsplit=1)[0])


def acts_by_time(variant: str) -> bool:
    """Return whether an effect acts all the time, and not by motion; False for one that the library does not have."""
    effect = find_effect(variant)
    return effect is not None and effect.per == "time"


class Bends:
    """Bend energies by the conditions of their windows."""

    def __init__(self, base: BaseProjection) -> None:
        table = base.windows.table
        self._weight = base.weight
        self._hours = np.maximum(get_numbers(table, "duration_s"), 1.0) / 3600.0
        self._conditions = (
            np.nan_to_num(get_numbers(table, "average_speed_kmh")),
            np.nan_to_num(get_numbers(table, "ambient_c"), nan=15.0),
            np.log(np.nan_to_num(get_numbers(table, "elapsed_s")) + START),
        )
        self._earlier = _list_earlier_windows(base.windows)

    def build(self, energy: Floats, lags: bool) -> Floats:
        """Return the bends of an energy."""
        weight = self._weight * energy**2
        acts = weight > 0.0
        if not acts.any():
            return np.empty((len(energy), 0))
        power = np.log(np.abs(energy) / self._hours + 1e-300)
        power = standardise(np.maximum(power, np.quantile(power[acts], LEAST_QUANTILE)), weight)
        functions = [power, standardise(power**2, weight), *(standardise(c, weight) for c in self._conditions)]
        columns = [energy * function for function in functions if function.any()]
        if lags:
            columns += self._lag(energy)
        return np.column_stack(columns) if columns else np.empty((len(energy), 0))

    def _lag(self, energy: Floats) -> list[Floats]:
        """Return the energy at the power of the window before, and at that of all windows before, less the energy."""
        if not len(self._earlier):
            return []
        rate = energy / self._hours
        mean = rate.copy()
        before = rate.copy()
        for rows in self._earlier:  # windows by their number in the ride, so that each knows the mean of those before
            before[rows] = rate[rows - 1]
            mean[rows] = MEMORY * mean[rows - 1] + (1.0 - MEMORY) * rate[rows]
        return [(before - rate) * self._hours, (mean - rate) * self._hours]


def _list_earlier_windows(windows: Windows) -> list[Ints]:
    """Return the rows of all second windows of a ride, of all third ones, and so on; none where rides are windows."""
    first = np.flatnonzero(np.r_[True, np.diff(windows.ride) != 0])
    place = np.arange(len(windows.ride)) - np.repeat(first, np.diff(np.r_[first, len(windows.ride)]))
    order = np.argsort(place, kind="stable")
    return [rows for rows in np.split(order, np.flatnonzero(np.diff(place[order])) + 1)[1:] if len(rows)]


def standardise(values: Floats, weight: Floats) -> Floats:
    """Return values with mean 0 and sd 1, at most `MOST_SIGMAS` from 0; all 0 where they do not vary."""
    share = weight / weight.sum()
    values = values - share @ values
    spread = float(np.sqrt(share @ values**2))
    return np.asarray(np.clip(values / spread, -MOST_SIGMAS, MOST_SIGMAS)) if spread > 1e-9 else np.zeros(len(values))
