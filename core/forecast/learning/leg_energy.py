"""Energy of a leg of given distance and duration, by vehicle model, pace and outside temperature.

A plan states how far and how long a leg is, not how often the car accelerates nor how much it heats. That is known from
earlier rides (`socast.core.forecast.learning.ride_stats`) at knots of pace and temperature. Between two knots the
values are interpolated linearly.
"""

from math import isnan
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit

from socast.core.batch import Floats

PACES: Final = np.array([1.0, 1.5, 2.2, 3.0, 4.3, 7.5, 15.0])
"""Knots of pace. The energy per kilometre grows linearly with the time per kilometre. [min/km]"""
TEMPERATURES: Final = np.array([-25.0, -15.0, -7.0, 0.0, 7.0, 14.0, 21.0, 28.0, 35.0])
"""Knots of the outside temperature. [°C]"""
TYPICAL_KM: Final = 4.0
"""Length of a typical ride. [km]"""
RECOVERED_SHARE: Final = 0.6
"""Share of the surplus energy of a descent that returns to the battery. Estimated. [1]"""
STEEPEST_DESCENT: Final = 300.0
"""Largest descent of a leg that returns energy; a reported descent beyond it returns none. [m/km]"""
LEAST_KM: Final = 1e-9
"""A shorter distance is none; the time per kilometre would overflow. [km]"""
LEAST_ENERGY_PER_KM: Final = 0.01
"""Smallest energy of a level way. [kWh/km]"""
LARGEST_PER_KM: Final = 5.0
"""Largest plausible energy of rides and idle periods over the kilometres of rides. [kWh/km]"""
LARGEST_POWER: Final = 100.0
"""Largest plausible mean of their power. [kW]"""


class LegTerms(NamedTuple):
    """Hold the terms whose weighted sum is the energy of a leg.

    Parameters
    ----------
    knot : int
        Index of the knot of pace before that of the leg.
    near_km, far_km : float
        Distance at that knot, and at the next one. [km]
    waiting : float
        Time beyond that of the slowest pace. [h]
    climb, descent : float
        Metres gained and lost beyond the usual. [m]
    start : float
        Number of ride beginnings, less those that a leg of typical length includes. [1]
    """

    knot: int
    near_km: float
    far_km: float
    waiting: float
    climb: float
    descent: float
    start: float


class LegEnergyTables(NamedTuple):
    """Hold the consumption of a vehicle model, as learned from its rides and idle periods.

    Parameters
    ----------
    leg_energy_per_km : (paces, temperatures) float
        Energy of a leg. [kWh/km]
    climbed_per_km, descended_per_km : (paces,) float
        Mean climb and descent of the rides behind the table. [m/km]
    climb_energy, descent_energy : float
        Energy of an additional metre gained, or lost. [kWh/m]
    start_energy : float
        Energy of a ride however short. [kWh]
    standing_power : (temperatures,) float
        Power of a car that waits. [kW]
    approach_energy : (temperatures,) float
        Mean energy of the empty way to a ride, beyond that of standing as long. [kWh]
    ride_factor : (temperatures,) float
        Correction factor of the predicted energy of rides. [1]
    ride_power : (temperatures,) float
        Correction that is added to the predicted power of rides. [kW]
    idle_factor, idle_power : (temperatures,) float
        The same corrections for idle periods. [1], [kW]
    energy_per_km : (temperatures,) float
        Energy of rides and idle periods together, over the kilometres of rides. [kWh/km]
    mean_power : (temperatures,) float
        The same energy over the hours of both. [kW]
    relative_sd : (temperatures,) float
        Standard deviation of the energy at a temperature, larger where no rides were, over that energy. [1]
    mean_pause : float
        Mean duration of an idle period. [h]
    ride_pace : float
        Time per kilometre of rides together. [min/km]
    driven_energy_per_km : float
        Correction that is added for each kilometre driven, 0 for learned tables. [kWh/km]
    level_sd : float
        Standard deviation of the level of the tables, 0 for learned tables. A shift reveals it. [1]
    """

    leg_energy_per_km: Floats
    climbed_per_km: Floats
    descended_per_km: Floats
    climb_energy: float
    descent_energy: float
    start_energy: float
    standing_power: Floats
    approach_energy: Floats
    ride_factor: Floats
    ride_power: Floats
    idle_factor: Floats
    idle_power: Floats
    energy_per_km: Floats
    mean_power: Floats
    relative_sd: Floats
    mean_pause: float
    ride_pace: float
    driven_energy_per_km: float = 0.0
    level_sd: float = 0.0

    def get_ride_correction(self) -> tuple[Floats, Floats]:
        """Return the factor and the power that correct the predicted energy of rides at each temperature."""
        return self.ride_factor, self.ride_power

    @property
    def driving_energy_per_km(self) -> Floats:
        """Energy of a kilometre on a long way that has begun, at the usual pace, (temperatures,). [kWh/km]"""
        at_pace = compute_knot_weights(np.array([self.ride_pace]), PACES)[0] @ self.leg_energy_per_km
        return np.asarray(np.maximum(at_pace - self.start_energy / TYPICAL_KM, LEAST_ENERGY_PER_KM))

    def is_plausible(self) -> bool:
        """Return whether the consumption is positive and possible at every temperature; else no car has such tables."""
        limits = (self.energy_per_km, LARGEST_PER_KM), (self.mean_power, LARGEST_POWER)
        return not any(((values <= 0.0) | (values > most)).any() for values, most in limits)

    def compute_leg_energy(self, km: Floats, seconds: Floats, gained: Floats, lost: Floats) -> tuple[Floats, Floats]:
        """Return the energy of legs at each temperature.

        Parameters
        ----------
        gained, lost : (legs,) float
            Climb and descent, NaN for the usual ones. [m]

        Returns
        -------
        energy : (legs, temperatures) float
            [kWh] It is negative where a descent returns more than the leg takes, but never by more than the descent
            itself returns.
        begun_energy : (legs, temperatures) float
            The same once the rides have begun. The energy of the beginning is then spent, so that half of such a leg
            takes half of its energy. [kWh]
        """
        out = np.empty((2, len(km), len(TEMPERATURES)))
        energies = np.array([self.climb_energy, self.descent_energy, self.start_energy])
        levels = np.concatenate([self.leg_energy_per_km, self.standing_power[np.newaxis]])
        _compute_leg_energy(np.array([km, seconds, gained, lost]), self._stack_climbs(), energies, levels, out)
        return out[0], out[1]

    def compute_terms(self, km: float, seconds: float, gained: float, lost: float) -> LegTerms:
        """Return the terms of the energy of a leg; its climb and descent are NaN for the usual ones. [m]"""
        terms: LegTerms = _compute_terms(km, seconds, gained, lost, self._stack_climbs())
        return terms

    def _stack_climbs(self) -> Floats:
        """Return the usual climb and descent at each pace, (2, paces). [m/km]"""
        return np.array([self.climbed_per_km, self.descended_per_km])


@njit(cache=True)
def _compute_leg_energy(legs: Any, climbs: Any, energies: Any, levels: Any, out: Any) -> None:
    """Compute the energy of legs; `energies` are those of climb, descent and start, `levels` of paces and waiting."""
    climb_energy, descent_energy, start_energy = energies
    for i in range(legs.shape[1]):
        km, seconds, gained, lost = legs[:, i]
        terms = _compute_terms(km, seconds, gained, lost, climbs)
        returned = min(0.0 if isnan(lost) else lost, STEEPEST_DESCENT * km) * min(descent_energy, 0.0)
        for begun in range(2):
            climbing = terms.climb * climb_energy + terms.descent * descent_energy
            extra = climbing + (terms.start - begun) * start_energy
            for j in range(out.shape[2]):
                level = terms.near_km * levels[terms.knot, j] + terms.far_km * levels[terms.knot + 1, j]
                taken = level + terms.waiting * levels[-1, j] + extra
                out[begun, i, j] = max(taken, RECOVERED_SHARE * taken, returned)


@njit(cache=True)
def _compute_terms(km: float, seconds: float, gained: float, lost: float, climbs: Any) -> Any:
    """Return the terms of a leg; `climbs` are the usual climb and descent at each pace. [m/km]"""
    pace = seconds / 60.0 / km if km > LEAST_KM else PACES[-1]
    pace = min(max(pace, PACES[0]), PACES[-1])
    knot = 0
    while knot < len(PACES) - 2 and PACES[knot + 1] <= pace:
        knot += 1
    share = (pace - PACES[knot]) / (PACES[knot + 1] - PACES[knot])
    climbed = (1.0 - share) * climbs[0, knot] + share * climbs[0, knot + 1]
    descended = (1.0 - share) * climbs[1, knot] + share * climbs[1, knot + 1]
    climb = 0.0 if isnan(gained) else gained - climbed * km
    descent = 0.0 if isnan(lost) else lost - descended * km
    waiting = max(seconds / 60.0 - PACES[-1] * km, 0.0) / 60.0
    return LegTerms(knot, (1.0 - share) * km, share * km, waiting, climb, descent, 1.0 - km / TYPICAL_KM)


def compute_knot_weights(values: Floats, knots: Floats) -> Floats:
    """Return the weights of linear interpolation between knots.

    Returns
    -------
    (n, knots) float
        They add up to 1. Beyond the last knot, that knot has all the weight.

    Examples
    --------
    >>> compute_knot_weights(np.array([15.0, 99.0]), np.array([10.0, 20.0, 40.0])).tolist()
    [[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]
    """
    values = np.clip(values, knots[0], knots[-1])
    low = np.clip(np.searchsorted(knots, values, side="right") - 1, 0, len(knots) - 2)
    share = (values - knots[low]) / (knots[low + 1] - knots[low])
    out = np.zeros((len(values), len(knots)))
    rows = np.arange(len(values))
    out[rows, low], out[rows, low + 1] = 1.0 - share, share
    return out
