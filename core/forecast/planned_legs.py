"""Legs of a plan with their energies, and what is left of them while a car drives."""

from math import nan
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.forecast.learning.leg_energy import LEAST_KM, TEMPERATURES, LegEnergyTables
from socast.core.wire.messages import Leg, Plan

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
        # of plans with charges; the fields above are those of the rides until the next charge
        ("charges", "f8"),  # number of charges left
        ("charge_to", "f8"),  # charge after the last of them [1]
        ("charge_s", "f8"),  # duration of the next one [s]
        ("between_legs", "f8"),  # number of rides between the next charge and the last one
        ("between_s", "f8"),  # duration of these rides and of the charges after the next [s]
        ("after_legs", "f8"),  # number of rides after the last charge
        ("after_kwh", "f8", (_KNOTS,)),  # their energy [kWh]
        ("after_km", "f8"),  # distance of all rides after the next charge [km]
        ("after_s", "f8"),  # duration of the rides after the last charge [s]
    ]
)
"""What a plan says about the rest of a shift, by stretches: until the next charge, and after the last one."""


class PlannedLegs(NamedTuple):
    """Hold the legs of a plan with their energies.

    Parameters
    ----------
    energy : (legs, temperatures) float
        [kWh]
    begun_energy : (legs, temperatures) float
        Energy of each leg once it has begun. [kWh]
    km, seconds : (legs,) float
        Distance [km] and duration [s]. A charge has no distance and takes no energy.
    charge_to : (legs,) float
        Charge after a charge, NaN of rides. [1]
    """

    plan: Plan
    energy: Floats
    begun_energy: Floats
    km: Floats
    seconds: Floats
    charge_to: Floats

    @classmethod
    def create(cls, plan: Plan, energy: Floats, begun_energy: Floats) -> "PlannedLegs":
        """Return the legs of a plan that take these energies."""
        km = np.array([leg.distance_km or 0.0 for leg in plan.legs], dtype=np.float64)
        seconds = np.array([leg.duration_s for leg in plan.legs], dtype=np.float64)
        charges = [nan if leg.charge_to_soc_pct is None else leg.charge_to_soc_pct / 100.0 for leg in plan.legs]
        charge_to = np.array(charges, dtype=np.float64)
        return cls(plan, energy.reshape(-1, _KNOTS), begun_energy.reshape(-1, _KNOTS), km, seconds, charge_to)

    def drop_done(self, rides: int, charges: int) -> "PlannedLegs":
        """Return the legs that are left after a number of rides and of charges, in whatever order the car did them."""
        is_charge = np.isfinite(self.charge_to)
        left = np.where(is_charge, np.cumsum(is_charge) > charges, np.cumsum(~is_charge) > rides)
        if left.all():
            return self
        legs = [leg for leg, is_left in zip(self.plan.legs, left.tolist(), strict=True) if is_left]
        plan = msgspec.structs.replace(self.plan, legs=legs)
        return PlannedLegs.create(plan, self.energy[left], self.begun_energy[left])

    def shorten(self, driven_km: float) -> "PlannedLegs":
        """Return the same legs where the first one is a ride of which a distance has been driven. [km]"""
        legs, energy, begun = self.plan.legs, self.energy.copy(), self.begun_energy.copy()
        if legs and legs[0].distance_km is not None:
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

    def compute_progress(self, driven_km: float) -> NDArray[np.void]:
        """Return what these legs need, as one PLAN_PROGRESS."""
        out = np.zeros(1, PLAN_PROGRESS)[0]
        out["planned"], out["end"], out["reserve"] = 1.0, self.plan.shift_end_s, self.plan.reserve_soc_pct / 100.0
        out["came"], out["driven_km"] = self.plan.time_s, driven_km
        charges = np.flatnonzero(np.isfinite(self.charge_to))
        until = int(charges[0]) if len(charges) else len(self.km)
        out["legs"] = until
        if until:
            out["leg_kwh"], out["begun_kwh"] = self.energy[0], self.begun_energy[0]
            out["leg_km"], out["leg_s"] = self.km[0], self.seconds[0]
            out["later_kwh"] = self.energy[1:until].sum(axis=0)
            out["later_km"], out["later_s"] = self.km[1:until].sum(), self.seconds[1:until].sum()
        if len(charges):
            after = int(charges[-1]) + 1
            out["charges"], out["charge_to"] = len(charges), self.charge_to[charges[-1]]
            out["charge_s"], out["between_s"] = self.seconds[until], self.seconds[until + 1 : after].sum()
            out["between_legs"], out["after_legs"] = after - until - len(charges), len(self.km) - after
            out["after_kwh"], out["after_s"] = self.energy[after:].sum(axis=0), self.seconds[after:].sum()
            out["after_km"] = self.km[until:].sum()
        return out


def compute_planned_legs(plan: Plan, tables: LegEnergyTables | None) -> PlannedLegs:
    """Return the legs of a plan with their energies."""
    unknown = np.full((len(plan.legs), _KNOTS), np.nan)
    legs = PlannedLegs.create(plan, unknown, unknown)
    if tables is None or not plan.legs:
        return legs
    gained = np.array([np.nan if leg.gained_m is None else leg.gained_m for leg in plan.legs], dtype=np.float64)
    lost = np.array([np.nan if leg.lost_m is None else leg.lost_m for leg in plan.legs], dtype=np.float64)
    energy, begun_energy = (
        tables.compute_leg_energy(legs.km, legs.seconds, gained, lost, begun=begun) for begun in (False, True)
    )
    is_charge = np.isfinite(legs.charge_to)
    energy[is_charge] = begun_energy[is_charge] = 0.0
    return legs._replace(energy=energy, begun_energy=begun_energy)


def compute_share_left(leg_km: Floats, driven_km: Floats) -> Floats:
    """Return the share of legs that is left.

    Examples
    --------
    >>> compute_share_left(np.array([4.0, 4.0, 0.0]), np.array([1.0, 9.0, 1.0])).tolist()
    [0.75, 0.0, 1.0]
    """
    done = np.divide(np.maximum(driven_km, 0.0), leg_km, out=np.zeros(len(leg_km)), where=leg_km > LEAST_KM)
    return np.asarray(np.clip(1.0 - done, 0.0, 1.0))
