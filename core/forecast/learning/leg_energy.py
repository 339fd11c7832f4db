"""Energy of the legs of a plan, of waiting and of a usual shift of a vehicle model, at each outside temperature.

A plan states how far and how long a leg is, not how often the car accelerates nor how much it heats. That is known from
earlier rides (`socast.core.forecast.learning.energy_regression`) at knots of temperature. Between two knots the values
are interpolated linearly.
"""

from math import isnan
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.compiled_cache import njit, watch_sources
from socast.core.forecast.learning import consumption_terms
from socast.core.forecast.learning.consumption_terms import (
    DRIVING,
    EXPANSION,
    GAINED,
    KM,
    LOST,
    START,
    STRETCH_AMOUNTS,
    TEMPERATURES,
    WAITING,
    WARM_UP,
    compute_stretch_amounts,
    fill_ride_amounts,
)

RECOVERED_SHARE: Final = 0.6
"""Share of the surplus energy of a descent that returns to the battery: of what is beyond the needs of the leg, the
friction brakes take a part. Estimated. [1]"""
STEEPEST_DESCENT: Final = 300.0
"""Largest descent of a leg that returns energy; a reported descent beyond it returns none. [m/km]"""
LEAST_ENERGY_PER_KM: Final = 0.01
"""Smallest energy of a level way. [kWh/km]"""
LEAST_POWER: Final = 0.05
"""Smallest power of a car that is switched on. [kW]"""


class UsualMix(NamedTuple):
    """Hold the amounts of the usual rides and idle periods of a vehicle model, and the number of idle periods."""

    rides: Floats
    idle: Floats
    idle_periods: float


class LegEnergyTables(NamedTuple):
    """Hold the consumption of a vehicle model, by temperature.

    Parameters
    ----------
    rates : Energy of each amount of a stretch, (temperatures, amounts) float. [kWh per amount]
    level_sd : Relative standard deviation of the energy of the usual mix. A shift reveals it. [1]
    parts_covariance : Covariance of the relative energies of driving and of waiting beside that of the usual mix,
        (temperatures, 2, 2) float. [1]
    level : Logarithm of the energy that the usual mix takes by these tables, over that by the first ones. [1]
    """

    rates: Floats
    mix: UsualMix
    level_sd: Floats
    parts_covariance: Floats
    level: float

    @classmethod
    def create(cls, mean: Floats, covariance: Floats, mix: UsualMix, level: float) -> "LegEnergyTables":
        """Return the tables of coefficients with a mean, (terms,), and a covariance, (terms, terms)."""
        rates = EXPANSION @ mean
        rates[:, KM] = np.maximum(rates[:, KM], LEAST_ENERGY_PER_KM)
        rates[:, [DRIVING, WAITING]] = np.maximum(rates[:, [DRIVING, WAITING]], LEAST_POWER)
        rates[:, [GAINED, WARM_UP]] = np.maximum(rates[:, [GAINED, WARM_UP]], 0.0)
        parts = np.array([mix.rides, mix.idle])
        terms = parts @ EXPANSION  # (temperatures, 2, terms)
        energy = np.maximum(parts @ rates[:, :, np.newaxis], 1e-9)  # (temperatures, 2, 1)
        relative = terms / energy
        share = energy / energy.sum(axis=1, keepdims=True)
        whole = (share * relative).sum(axis=1, keepdims=True)
        beside = relative - whole
        level_sd = np.sqrt(np.einsum("tpi,ij,tpj->t", whole, covariance, whole))
        return cls(rates, mix, level_sd, np.einsum("tpi,ij,tqj->tpq", beside, covariance, beside), level)

    @property
    def standing_power(self) -> Floats:
        """Power of a car that waits, (temperatures,). [kW]"""
        return np.asarray(self.rates[:, WAITING])

    @property
    def warm_up_energy(self) -> Floats:
        """Energy of the whole warm-up after a car woke, (temperatures,). [kWh]"""
        return np.asarray(self.rates[:, WARM_UP])

    @property
    def approach_energy(self) -> Floats:
        """Mean energy of the empty way to a ride, beyond that of standing as long, (temperatures,). [kWh]"""
        way = self.mix.idle.copy()
        way[WAITING] = 0.0
        return np.asarray(self.rates @ way / max(self.mix.idle_periods, 1.0))

    @property
    def energy_per_km(self) -> Floats:
        """Energy of rides and idle periods together, over the kilometres of rides, (temperatures,). [kWh/km]"""
        return self._compute_mix_energy() / float(self.mix.rides[KM])

    @property
    def mean_power(self) -> Floats:
        """The same energy over the hours of both, (temperatures,). [kW]"""
        return self._compute_mix_energy() / float((self.mix.rides + self.mix.idle)[[DRIVING, WAITING]].sum())

    @property
    def mean_pause(self) -> float:
        """Mean duration of an idle period. [h]"""
        return float(self.mix.idle[WAITING]) / max(self.mix.idle_periods, 1.0)

    @property
    def ride_pace(self) -> float:
        """Time per kilometre of rides together. [min/km]"""
        return 60.0 * float(self.mix.rides[DRIVING]) / float(self.mix.rides[KM])

    @property
    def driving_energy_per_km(self) -> Floats:
        """Energy of a kilometre on a long way that has begun, at the usual pace, (temperatures,). [kWh/km]"""
        way = np.zeros((1, STRETCH_AMOUNTS))
        gained, lost = self.climbs[:, np.newaxis]
        compute_stretch_amounts(np.ones(1, np.bool_), np.ones(1), np.array([self.ride_pace / 60.0]), gained, lost, way)
        way[0, START] = 0.0
        return np.asarray(np.maximum(self.rates @ way[0], LEAST_ENERGY_PER_KM))

    @property
    def climbs(self) -> Floats:
        """Mean climb and descent of rides, (2,). [m/km]"""
        return self.mix.rides[[GAINED, LOST]] / float(self.mix.rides[KM])

    def _compute_mix_energy(self) -> Floats:
        """Return the energy of the usual mix, (temperatures,). [kWh]"""
        return np.asarray(self.rates @ (self.mix.rides + self.mix.idle))

    def compute_leg_energy(self, km: Floats, seconds: Floats, gained: Floats, lost: Floats) -> tuple[Floats, Floats]:
        """Return the energy of legs by temperature, and the same once the rides have begun, (legs, temperatures) each.

        Units: energies [kWh]; gained [m] and lost [m], NaN for the usual ones. An energy is negative where a descent
        returns more than the leg takes, but never by more than the descent itself returns. Half of a leg that has begun
        takes half of its energy, because that of the beginning is spent.
        """
        out = np.empty((2, len(km), len(TEMPERATURES)))
        _compute_leg_energy(np.array([km, seconds, gained, lost]), self.climbs, self.rates, out)
        return out[0], out[1]


@njit(cache=True)
def _compute_leg_energy(legs: Any, climbs: Any, rates: Any, out: Any) -> None:
    """Compute the energy of legs; `climbs` are the usual climb and descent. [m/km]"""
    amounts = np.empty(STRETCH_AMOUNTS)
    for i in range(legs.shape[1]):
        km, seconds, gained, lost = legs[:, i]
        returned_m = min(0.0 if isnan(lost) else lost, STEEPEST_DESCENT * km)
        gained = climbs[0] * km if isnan(gained) else gained
        lost = climbs[1] * km if isnan(lost) else lost
        fill_ride_amounts(amounts, km, seconds / 3600.0, gained, lost)
        for begun in range(2):
            amounts[START] = 1.0 - begun
            for j in range(out.shape[2]):
                taken = 0.0
                for k in range(STRETCH_AMOUNTS):
                    taken += amounts[k] * rates[j, k]
                returned = returned_m * min(rates[j, LOST], 0.0)
                out[begun, i, j] = max(taken, RECOVERED_SHARE * taken, returned)


watch_sources(_compute_leg_energy, consumption_terms)
