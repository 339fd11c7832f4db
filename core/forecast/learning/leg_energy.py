"""What is expected of a leg of so many kilometres and minutes, by vehicle model.

A plan tells of a leg how far and how long, not how often the car will speed up, nor what it heats. That is what earlier
rides tell (`core.forecast.habits`), by pace and outside temperature. Both are knots; what lies between two of them is of
each by how near it is.
"""

from typing import Final, NamedTuple

import numpy as np

from core.batch import Floats

PACES: Final = np.array([1.0, 1.5, 2.2, 3.0, 4.3, 7.5, 15.0])
"""Paces of rides: minutes for a kilometre, as the energy of a kilometre grows linearly with its time. [min/km]"""
TEMPERATURES: Final = np.array([-25.0, -15.0, -7.0, 0.0, 7.0, 14.0, 21.0, 28.0, 35.0])
"""[°C]"""
TYPICAL_KM: Final = 4.0
"""A ride of usual length. [km]"""
REGAINED: Final = 0.6
"""Share that comes back into the battery of what a descent has beyond what the way takes. Estimated."""
STEEPEST: Final = 300.0
"""Descent that a leg can have; what is told beyond it gives nothing back. [m/km]"""


class Terms(NamedTuple):
    """What the energy of n legs is a sum of.

    Parameters
    ----------
    km : (n, paces) float
        Of each pace.
    waiting : (n,) float
        Time beyond the slowest. [h]
    extras : (n, 3) float
        What `up`, `down` and `start` go with.
    """

    km: Floats
    waiting: Floats
    extras: Floats


class Tables(NamedTuple):
    """What is expected of a vehicle model.

    Parameters
    ----------
    per_km : (paces, temperatures) float
        Energy of a leg. [kWh/km]
    climbed_per_km, descended_per_km : (paces,) float
        Of the rides that this was learned from. [m/km]
    up, down, start : float
        What a metre more, gained or lost, adds [kWh/m], and what a ride adds however short. [kWh]
    standing : (temperatures,) float
        Power of a car that waits. [kW]
    approach : (temperatures,) float
        Energy of the empty way to a ride, on average, over that of standing as long. [kWh]
    factor, power : (temperatures,) float
        By which the predicted energy of rides is to be multiplied [1], and what is to be added to it. [kW]
    resting_factor, resting_power : (temperatures,) float
        The same of rests.
    all_per_km : (temperatures,) float
        Energy of rides and rests together, over the kilometres of rides. [kWh/km]
    all_power : (temperatures,) float
        The same over the hours of both. [kW]
    pause : float
        Time of a rest, on average. [h]
    """

    per_km: Floats
    climbed_per_km: Floats
    descended_per_km: Floats
    up: float
    down: float
    start: float
    standing: Floats
    approach: Floats
    factor: Floats
    power: Floats
    resting_factor: Floats
    resting_power: Floats
    all_per_km: Floats
    all_power: Floats
    pause: float

    def legs(self, km: Floats, seconds: Floats, gained: Floats, lost: Floats, *, begun: bool = False) -> Floats:
        """Return the energy of legs at each temperature, (legs, temperatures). [kWh]

        Below zero where a descent gives back more than the way takes, but never more than the descent itself gives.

        Parameters
        ----------
        km, seconds : (legs,) float
        gained, lost : (legs,) float
            NaN stands for as much as is usual. [m]
        begun : bool
            Of legs whose ride has begun: what a ride adds however short is past. Half of such a leg takes half as much.
        """
        terms = self.terms(km, seconds, gained, lost)
        terms.extras[:, 2] -= begun
        plain = terms.km @ self.per_km + np.outer(terms.waiting, self.standing)
        taken = plain + (terms.extras @ np.array([self.up, self.down, self.start]))[:, np.newaxis]
        least = np.minimum(self.down, 0.0) * np.minimum(np.nan_to_num(lost, nan=0.0), STEEPEST * km)
        return np.asarray(np.maximum(np.maximum(taken, REGAINED * taken), least[:, np.newaxis]))

    def terms(self, km: Floats, seconds: Floats, gained: Floats, lost: Floats) -> Terms:
        """Return what the energy of legs is a sum of; NaN stands for climbs as usual."""
        minutes = seconds / 60.0
        weights = tents(np.divide(minutes, km, out=np.full(len(km), PACES[-1]), where=km > 0.0), PACES)
        more = np.nan_to_num(gained - weights @ self.climbed_per_km * km, nan=0.0)
        less = np.nan_to_num(lost - weights @ self.descended_per_km * km, nan=0.0)
        waiting = np.maximum(minutes - PACES[-1] * km, 0.0) / 60.0
        return Terms(weights * km[:, np.newaxis], waiting, np.column_stack([more, less, 1.0 - km / TYPICAL_KM]))


def tents(values: Floats, knots: Floats) -> Floats:
    """Return the weight of each knot for each value, which add up to 1, (n, knots); beyond the last, that one's.

    Examples
    --------
    >>> tents(np.array([15.0, 99.0]), np.array([10.0, 20.0, 40.0])).tolist()
    [[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]
    """
    values = np.clip(values, knots[0], knots[-1])
    low = np.clip(np.searchsorted(knots, values, side="right") - 1, 0, len(knots) - 2)
    share = (values - knots[low]) / (knots[low + 1] - knots[low])
    out = np.zeros((len(values), len(knots)))
    rows = np.arange(len(values))
    out[rows, low], out[rows, low + 1] = 1.0 - share, share
    return out
