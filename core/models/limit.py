"""Limit the energy that a model may predict, by what the rides of its training took.

Coefficients that hold for the rides of a fit can be absurd for another ride: a product of columns that was nearly zero
in all of them may be large there. Such a prediction is of no use, and its size hides the errors of all others. A fit
therefore states an energy per kilometre and a power, and no prediction exceeds their sum over the ride.

Both are `FACTOR` times the mean of the training rides, so they hold for a Twizy and for a van. A climb of 20 % takes
less, and so does a ride at 130 km/h or an hour of heating at standstill in a cold night. `LEAST_KM` leaves room for the
kinetic energy and the climb of a part of a ride.
"""

from typing import Final, Self

import msgspec
import numpy as np

from socast.core.batch import Floats

FACTOR: Final = 4.0
"""Largest energy per distance, plus largest power, over the means of the training rides. [1]"""
LEAST_KM: Final = 2.0
"""Distance that is added to that of each ride. [km]"""
LIMIT_NEEDS: Final = ("distance_km", "duration_s")
"""Columns that a limit reads."""


class EnergyLimit(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Hold the largest energy that a fit predicts, taken from the battery or returned to it.

    Parameters
    ----------
    kwh_per_km : float
        Energy per distance. [kWh/km]
    power_kw : float
        Energy per duration, in addition. [kW]
    """

    kwh_per_km: float
    power_kw: float

    @classmethod
    def of_training(cls, energy_kwh: float, distance_km: float, duration_s: float) -> Self | None:
        """Return the limit that follows from sums over the training rides, None where they do not tell one.

        Parameters
        ----------
        energy_kwh : float
            Sum of the absolute measured energies. [kWh]
        distance_km, duration_s : float
            Sums over the same rides. [km], [s]

        Examples
        --------
        >>> EnergyLimit.of_training(10.0, 50.0, 7200.0)
        EnergyLimit(kwh_per_km=0.8, power_kw=20.0)
        """
        if not (energy_kwh > 0.0 and distance_km > 0.0 and duration_s > 0.0):
            return None
        return cls(
            kwh_per_km=FACTOR * energy_kwh / distance_km,
            power_kw=FACTOR * energy_kwh / (duration_s / 3600.0),
        )

    def compute_energy(self, distance_km: Floats, duration_s: Floats) -> Floats:
        """Return the largest energy of rides; infinite where distance or duration are unknown. [kWh]

        Examples
        --------
        >>> EnergyLimit(kwh_per_km=0.8, power_kw=20.0).compute_energy(np.array([8.0, np.nan]), np.full(2, 360.0))
        array([10., inf])
        """
        most = self.kwh_per_km * (distance_km + LEAST_KM) + self.power_kw * (duration_s / 3600.0)
        return np.where(np.isfinite(most), most, np.inf)


def sum_training(energy_kwh: Floats, distance_km: Floats, duration_s: Floats) -> Floats:
    """Return the sums over rides that `EnergyLimit.of_training` takes, of the rides that know all three; (3,)."""
    columns = np.stack([np.abs(energy_kwh), distance_km, duration_s])
    return columns[:, np.isfinite(columns).all(axis=0)].sum(axis=1)
