"""Divide the predictions of a model into parts, with 95 % intervals.

A prediction is a sum: the energies of the terms, each times the factor of the car, the correction by boosted trees, and
what a limit of the prediction takes away. Two of the parts are not those of the coefficients alone:

- What acts over time, such as heating, also takes energy while the car stands. That is a part of its own, `WAITING`:
  the share of the time of each ride in which the car stood, of each term that acts over time.
- Slowing gives kinetic energy back at what speeding up paid for it, and what of it is lost counts in the losses in
  braking. A fit has a coefficient for each of the three. Those of slowing and braking trade against each other, because
  cars brake while they slow; the sum of both is determined well.

The interval of a part has up to three sources:

- The standard errors of the coefficients, with what they have in common.
- `FORM_ERROR`. A coefficient is the mean cost of a cause at the battery if the cause has exactly the form of its
  column. Powertrains cost more or less per energy at the wheels by load, climate control differs between driving and
  standing, and tyres resist more at speed, which no data tell from air drag. More rides do not reduce this error.
- Unknown heights. A car without a position or a map has no heights, and its climbs and descents count as none. What
  they take is expected to be like that of rides with heights.
"""

from collections import defaultdict
from collections.abc import Mapping
from math import hypot, isfinite, nan, sqrt
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from msgspec import UNSET
from msgspec.structs import replace
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.effects import Effect, get_library, group_by_topic
from socast.core.evaluate.compare.models import ComparedRides
from socast.core.fit.model_summary import find_freedom
from socast.core.fit.ride_blocks import get_numbers
from socast.core.models import ANY, VEHICLE_MODEL, LinearModel, Term
from socast.core.models.features import ACCESSORIES_COLUMN, EFFECT_PREFIX
from socast.core.stats.scores import compute_half_widths

LIMIT: Final = "limit of the prediction"
"""Name of the part that the limit of a model takes away from its terms."""
UNEXPLAINED: Final = "unexplained"
WAITING: Final = "waiting"
"""Name of the part that terms over time take while the car stands."""
STANDING: Final = "standing_s"
"""Column of the ride table that tells how long. [s]"""
SPEEDING_UP, SLOWING, BRAKING = "inertia_positive", "inertia_negative", "braking"
"""Terms of kinetic energy paid, given back and lost."""
AIR_DRAG: Final = frozenset({"aero_drag", "aero_drag_wind"})
"""Effects of air drag besides those of the topic `air`."""
CLIMBS: Final = frozenset({"climbing", "climbing_up", "climbing_down"})
"""Effects that are zero where heights are unknown."""
FORM_ERROR: Final = 0.05
"""Half of the 95 % interval of the energy of a part that no data reduce, over that energy: the cost of a cause at the
battery differs from the mean cost of driving, by the load at which it acts. Chosen on simulated fleets. [1]"""
DRAG_FORM_ERROR: Final = 0.2
"""The same of air drag, which no data tell from tyres whose resistance grows with the square of the speed. [1]"""


class PredictionParts(NamedTuple):
    """Hold the parts of predictions of n rides.

    Parameters
    ----------
    energies : mapping of str to (n,) float
        Energy by name of the part; the sum is the prediction. [kWh]
    columns : (n, terms) float
        Energy of each term per unit of its coefficient. [kWh/unit]
    standing : (n, terms) float
        Share of it while the car stands. [1]
    keys : (n,) object
        Fit that applies to each ride.
    without_heights : (n,) bool
        Whether the heights of a ride are unknown.
    """

    model: LinearModel
    energies: Mapping[str, Floats]
    columns: Floats
    standing: Floats
    keys: NDArray[np.object_]
    without_heights: NDArray[np.bool_]

    @property
    def split_terms(self) -> set[str]:
        """Terms whose energy while the car stands is in `WAITING`."""
        return {term.name for term, share in zip(self.model.terms, self.standing.T, strict=True) if share.any()}

    def compute_half_widths(self) -> dict[str, float]:
        """Return half of the 95 % intervals by part of all rides, and that of their prediction as `UNEXPLAINED`. [kWh]

        There are none for a model without standard errors, and none of climbing where no ride has heights. They say
        nothing of single cars or months, which differ from the mean of all rides by more.
        """
        squares = defaultdict[str, float](float)
        for key in set(self.keys):
            covariance = self.model.fits[key].covariance
            if covariance is None:
                return {}
            width = float(compute_half_widths(1.0, max(find_freedom(self.model, key), 1)))
            for name, weights in self._weigh(self.keys == key).items():
                squares[name] += width**2 * max(float(weights @ np.array(covariance) @ weights), 0.0)
        halves = {name: sqrt(each) for name, each in squares.items()}
        terms = {term.name: term for term in self.model.terms}
        for name in self.energies.keys() & halves.keys():
            drag = name in terms and is_air_drag(terms[name])
            form = (DRAG_FORM_ERROR if drag else FORM_ERROR) * float(self.energies[name].sum())
            climbs = 2.0 * self._spread_climbs(name) if name in terms and _climbs(terms[name]) else 0.0
            halves[name] = hypot(halves[name], form, climbs)
        return {name: half for name, half in halves.items() if isfinite(half)}

    def _weigh(self, rows: NDArray[np.bool_]) -> dict[str, Floats]:
        """Return the energy of each part per unit of each coefficient. [kWh/unit]"""
        columns, standing = self.columns[rows], self.columns[rows] * self.standing[rows]
        terms = [term.name for term in self.model.terms]
        weights = dict(zip(terms, np.diag((columns - standing).sum(axis=0)), strict=True))
        if shares_kinetic_energy(self.model):
            faster, slower = terms.index(SPEEDING_UP), terms.index(SLOWING)
            paid = weights[SLOWING][slower]
            weights[SLOWING][[slower, faster]] = 0.0, paid
            weights[BRAKING][[slower, faster]] += paid, -paid
        return weights | {WAITING: standing.sum(axis=0), UNEXPLAINED: columns.sum(axis=0)}

    def _spread_climbs(self, name: str) -> float:
        """Return the root mean square of what rides without heights took, NaN where no ride has heights. [kWh]"""
        count = int(self.without_heights.sum())
        known = self.energies[name][~self.without_heights]
        if not (count and len(known)):
            return nan if count else 0.0
        return sqrt(count * float(np.var(known)) + (count * float(np.mean(known))) ** 2)


def split_predictions(model: LinearModel, chosen: ComparedRides) -> PredictionParts:
    """Return the parts of the predictions of rides."""
    rides, predicted = chosen.rides, chosen.predicted[model.name]
    unlimited = replace(model, fits={key: replace(fit, limit=UNSET) for key, fit in model.fits.items()})
    energies = unlimited.predict_parts(rides)
    if model.count_limited(rides, predicted):
        energies[LIMIT] = predicted - np.sum(list(energies.values()), axis=0)
    standing = _find_standing(model, rides)
    if standing.any():
        waiting = np.zeros(len(predicted))
        for term, share in zip(model.terms, standing.T, strict=True):
            waiting += energies[term.name] * share
            energies[term.name] = energies[term.name] * (1.0 - share)
        energies[WAITING] = waiting
    columns = _compute_columns(model, rides)
    kinds = rides[VEHICLE_MODEL].to_numpy(dtype=object)
    keys = np.array([kind if kind in model.fits else ANY for kind in kinds], dtype=object)
    terms = [term.name for term in model.terms]
    if shares_kinetic_energy(model):
        faster, slower = terms.index(SPEEDING_UP), terms.index(SLOWING)
        costs = {key: np.array(fit.coefficients) for key, fit in model.fits.items()}
        unpaid = columns[:, slower] * np.array([costs[key][slower] - costs[key][faster] for key in keys])
        energies[SLOWING] = energies[SLOWING] - unpaid
        energies[BRAKING] = energies[BRAKING] + unpaid
    climbs = columns[:, [i for i, term in enumerate(model.terms) if _climbs(term)]]
    without_heights = (climbs == 0.0).all(axis=1) if climbs.shape[1] else np.zeros(len(rides), np.bool_)
    return PredictionParts(model, energies, columns, standing, keys, without_heights)


def shares_kinetic_energy(model: LinearModel) -> bool:
    """Return whether a model tells apart kinetic energy that is paid, given back and lost."""
    return {SPEEDING_UP, SLOWING, BRAKING} <= {term.name for term in model.terms}


def _find_standing(model: LinearModel, rides: pd.DataFrame) -> Floats:
    """Return the share of each term of each ride while the car stands, (n, terms); 0 where the tables tell none."""
    stood, time = (
        np.nan_to_num(get_numbers(rides, name)) if name in rides else np.zeros(len(rides))
        for name in (STANDING, "duration_s")
    )
    share = np.divide(stood, time, out=np.zeros(len(rides)), where=time > 0.0)
    return np.outer(np.clip(share, 0.0, 1.0), [acts_over_time(term) for term in model.terms])


def _compute_columns(model: LinearModel, rides: pd.DataFrame) -> Floats:
    """Return the energy of each term per unit of its coefficient, (n, terms). [kWh/unit]"""
    ones = (1.0,) * len(model.terms)
    fits = {key: replace(fit, coefficients=ones, limit=UNSET) for key, fit in model.fits.items()}
    parts = replace(model, fits=fits, correction=None).predict_parts(rides)
    return np.reshape([parts[term.name] for term in model.terms], (len(model.terms), len(rides))).T


def _list_effects(term: Term) -> list[Effect]:
    """Return the effects of the library that a term multiplies."""
    names = [column.removeprefix(EFFECT_PREFIX) for column in term.columns if column.startswith(EFFECT_PREFIX)]
    found = [get_library().get(name.partition("@")[0]) for name in names]
    return [each for each in found if each is not None]


def is_air_drag(term: Term) -> bool:
    """Return whether a term is drag of the air, which grows with the square of the speed."""
    known = AIR_DRAG | {each.name for each in group_by_topic()["air"]}
    return any(each.name in known for each in _list_effects(term))


def acts_over_time(term: Term) -> bool:
    """Return whether the energy of a term grows with the time of a ride."""
    return bool({ACCESSORIES_COLUMN, "duration_s"} & set(term.columns)) or any(
        each.per == "time" for each in _list_effects(term)
    )


def _climbs(term: Term) -> bool:
    """Return whether a term is zero in rides whose heights are unknown."""
    return any(each.name in CLIMBS for each in _list_effects(term))
