"""State what physics tells of the coefficients of a model before any data: a Gaussian for each.

Effects declare the mean and the spread of their coefficients with a source
(`socast.core.effects.declaration.Expectation`), some in multiples of a figure of the car in the catalogue. Where an
effect declares none, its plausible range stands for one: the middle, with half the width as standard deviation. The
numbers of the accessory curve are expected at those of the reference curve, and their declared bounds are two standard
deviations on either side.
"""

from collections.abc import Sequence
from math import inf
from typing import Final

import numpy as np

from socast.core import effects
from socast.core.batch import Floats
from socast.core.effects.road_load import accessories
from socast.core.fit.accessory_curve import CHOKE_POINTS, LEAST_GAP, LEVELS, flatten_curve
from socast.core.fit.block_sums import build_design
from socast.core.fit.nested_effects import Gaussian
from socast.core.models import Term
from socast.core.models.features import ACCESSORIES_COLUMN, EFFECT_PREFIX, Columns, is_scope
from socast.core.models.plausibility import compute_plausible_range
from socast.core.vehicles import ACCESSORIES
from socast.core.vehicles.fleet import CarParameters

BOUNDS_OVER_SD: Final = 4.0
"""Width of the bounds of a number of the accessory curve over its standard deviation. [1]"""
UNKNOWN_ENERGY: Final = 1.0
"""Standard deviation of the energy of a row by a term of which physics tells nothing. [kWh]"""


def build_prior(terms: Sequence[Term], columns: Columns, rows: int) -> Gaussian:
    """Return the prior of the coefficients of terms, none of which is the accessories'."""
    known = [_expect(term, columns, rows) for term in terms]
    mean, sd = np.array(known, dtype=np.float64).reshape(-1, 2).T
    return Gaussian(mean, np.diag(sd**2))


def _expect(term: Term, columns: Columns, rows: int) -> tuple[float, float]:
    """Return the mean and the standard deviation of a coefficient."""
    named = [column for column in term.columns if column.startswith(EFFECT_PREFIX)]
    figures = [column for column in term.columns if column in CarParameters._fields]
    others = [column for column in term.columns if column not in {*named, *figures} and not is_scope(column)]
    if len(named) != 1 or others:
        size = float(np.sqrt(np.mean(build_design((term,), columns, rows) ** 2))) if rows else 0.0
        return 0.0, UNKNOWN_ENERGY / size if size > 0.0 else UNKNOWN_ENERGY
    effect = effects.get(named[0].removeprefix(EFFECT_PREFIX))
    expected = effect.expected
    if expected is None:
        mean, sd = (effect.low + effect.high) / 2.0, (effect.high - effect.low) / 2.0
    else:
        mean, sd = expected.mean, expected.sd
        if expected.of in figures:
            figures.remove(expected.of)
        elif expected.of:
            own = _average(columns, expected.of)
            mean, sd = mean * own, sd * own
    by = float(np.prod([_average(columns, name) for name in figures]))
    return (mean / by, sd / by) if by > 0.0 else (mean, sd)


def _average(columns: Columns, name: str) -> float:
    """Return the mean of a figure of the cars."""
    return float(np.mean(columns[name]))


def find_limits(terms: Sequence[Term], columns: Columns) -> tuple[Floats, Floats]:
    """Return the ends of the plausible range of each coefficient, infinite where physics sets none."""
    figures = {name: _average(columns, name) for name in CarParameters._fields if name in columns}
    ranges = [compute_plausible_range(term, figures) or (-inf, inf) for term in terms]
    low, high = np.array(ranges, dtype=np.float64).reshape(-1, 2).T
    return low, high


def build_curve_prior() -> Gaussian:
    """Return the prior of the seven numbers of the accessory curve of a car, over its accessory scale."""
    low, high = np.array([accessories.parameters[name].bounds for name in (*LEVELS, *CHOKE_POINTS)]).T
    return Gaussian(flatten_curve(ACCESSORIES), np.diag(((high - low) / BOUNDS_OVER_SD) ** 2))


def find_curve_limits() -> tuple[Floats, Floats]:
    """Return the limits of the seven numbers of the accessory curve: declared bounds, apart by `LEAST_GAP`."""
    low, high = np.array([accessories.parameters[name].bounds for name in (*LEVELS, *CHOKE_POINTS)]).T
    for i in range(len(LEVELS), len(low) - 1):
        middle = (high[i] + low[i + 1]) / 2.0
        high[i] = min(high[i], middle - LEAST_GAP / 2.0)
        low[i + 1] = max(low[i + 1], middle + LEAST_GAP / 2.0)
    return low, high


def is_curved(term: Term) -> bool:
    """Return whether a term is the accessories by a curve."""
    return term.columns == (ACCESSORIES_COLUMN,)
