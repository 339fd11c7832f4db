"""Legs of a plan with their energies, and what is left of them while a car drives."""

from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from core.batch import Floats
from core.forecast.learning.leg_energy import LEAST_KM, TEMPERATURES, LegEnergyTables
from core.wire.messages import Leg, Plan

_KNOTS: Final = len(TEMPERATURES)

PLAN_PROGRESS: Final = np.dtype(
    [
        ("planned", "f8"),  # 1 where there is a plan whose energy is known
        ("came", "f8"),  # when the plan was sent [s]
        ("end", "f8"),  # of the shift [s]
        ("reserve", "f8"),  # [1]
        ("legs", "f8"),  # number of legs left
        ("leg_kwh", "f8", (_KNOTS,)),  # energy of the next leg at each temperature [kWh]
        ("begun_kwh", "f8", (_KNOTS,)),  # the same once the leg has begun [kWh]
        ("leg_km", "f8"),  # [km]
        ("leg_s", "f8"),  # [s]
        ("driven_km", "f8"),  # of the ride in progress when the plan came [km]
        ("later_kwh", "f8", (_KNOTS,)),  # energy of all legs after the next [kWh]
        ("later_km", "f8"),  # [km]
        ("later_s", "f8"),  # [s]
    ]
)
"""What a plan says about the rest of a shift."""


class PlannedLegs(NamedTuple):
    """Hold the legs of a plan with their energies.

    Parameters
    ----------
    plan : Plan
    energy : (legs, temperatures) float
        [kWh]
    begun_energy : (legs, temperatures) float
        Energy of each leg once it has begun. [kWh]
    km, seconds : (legs,) float
        Distance [km] and duration [s].
    """

    plan: Plan
    energy: Floats
    begun_energy: Floats
    km: Floats
    seconds: Floats

    @classmethod
    def create(cls, plan: Plan, energy: Floats, begun_energy: Floats) -> "PlannedLegs":
        """Return the legs of a plan that take these energies."""
        km = np.array([leg.distance_km for leg in plan.legs], dtype=np.float64)
        seconds = np.array([leg.duration_s for leg in plan.legs], dtype=np.float64)
        return cls(plan, energy.reshape(-1, _KNOTS), begun_energy.reshape(-1, _KNOTS), km, seconds)

    def get_remaining(self, done: int, driven_km: float | None = None) -> "PlannedLegs":
        """Return the legs that are left.

        Parameters
        ----------
        done : int
            Number of legs done.
        driven_km : float, optional
            Distance driven of the next leg; None where it has not begun. [km]
        """
        legs, energy, begun = self.plan.legs[done:], self.energy[done:].copy(), self.begun_energy[done:].copy()
        if legs and driven_km is not None:
            share = float(compute_share_left(np.array([legs[0].distance_km]), np.array([driven_km]))[0])
            parts = {name: value and share * value for name, value in msgspec.structs.asdict(legs[0]).items()}
            legs = [Leg(**parts), *legs[1:]]
            energy[0] = begun[0] = share * begun[0]
        return PlannedLegs.create(msgspec.structs.replace(self.plan, legs=legs), energy, begun)

    def insert(self, place: int, inserted: "PlannedLegs") -> "PlannedLegs":
        """Return these legs with those of another plan inserted before the leg at an index."""
        legs = [*self.plan.legs[:place], *inserted.plan.legs, *self.plan.legs[place:]]
        parts = ((self.energy, inserted.energy), (self.begun_energy, inserted.begun_energy))
        energy, begun = (np.concatenate([present[:place], more, present[place:]]) for present, more in parts)
        return PlannedLegs.create(msgspec.structs.replace(self.plan, legs=legs), energy, begun)

    def compute_progress(self, done: int, driven_km: float) -> NDArray[np.void]:
        """Return what is left, as one PLAN_PROGRESS.

        Parameters
        ----------
        done : int
            Number of legs done.
        driven_km : float
            Distance that the ride in progress had driven when the plan came. [km]
        """
        out = np.zeros(1, PLAN_PROGRESS)[0]
        out["planned"], out["end"], out["reserve"] = 1.0, self.plan.shift_end_s, self.plan.reserve_soc_pct / 100.0
        out["came"], out["driven_km"] = self.plan.time_s, driven_km
        out["legs"] = max(len(self.km) - done, 0)
        if done < len(self.km):
            out["leg_kwh"], out["begun_kwh"] = self.energy[done], self.begun_energy[done]
            out["leg_km"], out["leg_s"] = self.km[done], self.seconds[done]
            out["later_kwh"] = self.energy[done + 1 :].sum(axis=0)
            out["later_km"], out["later_s"] = self.km[done + 1 :].sum(), self.seconds[done + 1 :].sum()
        return out


def compute_planned_legs(plan: Plan, tables: LegEnergyTables | None) -> PlannedLegs:
    """Return the legs of a plan with their energies.

    Parameters
    ----------
    plan : Plan
    tables : LegEnergyTables or None
        Of the car's vehicle model; without them the energies are NaN.

    Returns
    -------
    PlannedLegs
    """
    unknown = np.full((len(plan.legs), _KNOTS), np.nan)
    legs = PlannedLegs.create(plan, unknown, unknown)
    if tables is None or not plan.legs:
        return legs
    gained = np.array([np.nan if leg.gained_m is None else leg.gained_m for leg in plan.legs], dtype=np.float64)
    lost = np.array([np.nan if leg.lost_m is None else leg.lost_m for leg in plan.legs], dtype=np.float64)
    energy, begun_energy = (
        tables.compute_leg_energy(legs.km, legs.seconds, gained, lost, begun=begun) for begun in (False, True)
    )
    return legs._replace(energy=energy, begun_energy=begun_energy)


def compute_share_left(leg_km: Floats, driven_km: Floats) -> Floats:
    """Return the share of legs that is left.

    Parameters
    ----------
    leg_km, driven_km : (n,) float
        Length of each leg, and distance driven of it. [km]

    Returns
    -------
    (n,) float
        [1]

    Examples
    --------
    >>> compute_share_left(np.array([4.0, 4.0, 0.0]), np.array([1.0, 9.0, 1.0])).tolist()
    [0.75, 0.0, 1.0]
    """
    done = np.divide(np.maximum(driven_km, 0.0), leg_km, out=np.zeros(len(leg_km)), where=leg_km > LEAST_KM)
    return np.asarray(np.clip(1.0 - done, 0.0, 1.0))
