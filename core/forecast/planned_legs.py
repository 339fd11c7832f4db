"""Legs of a plan with their energies, and what is left of them while a car drives."""

from math import isnan, nan
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.compiled_cache import njit
from socast.core.forecast.learning.consumption_terms import LEAST_KM, TEMPERATURES
from socast.core.forecast.learning.leg_energy import LegEnergyTables
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
    energy, begun_energy : Energy of each leg, and once it has begun, (legs, temperatures) float. [kWh]
    km, seconds : Distance [km] and duration [s], (legs,) float. A charge has no distance and takes no energy.
    charge_to : Charge after a charge, NaN of rides, (legs,) float. [1]
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
        charges = (nan if leg.charge_to_soc_pct is None else leg.charge_to_soc_pct / 100.0 for leg in plan.legs)
        rows = [(leg.distance_km or 0.0, leg.duration_s, to) for leg, to in zip(plan.legs, charges, strict=True)]
        km, seconds, charge_to = np.array(rows, np.float64).reshape(-1, 3).T.copy()
        shape = len(rows), _KNOTS  # a forged state may have fewer, and a kernel would read beyond them
        return cls(plan, energy.reshape(shape), begun_energy.reshape(shape), km, seconds, charge_to)

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
        if not self.plan.legs or self.plan.legs[0].distance_km is None:
            return self
        shares, energy = np.ones(len(self.km)), self.energy.copy()
        energy[0], shares[:1] = self.begun_energy[0], compute_share_left(self.km[:1], np.array([driven_km]))
        return self._replace(energy=energy).scale(shares)

    def keep_share(self, share: float, first: int) -> "PlannedLegs":
        """Return the same legs, where a share of those from an index on is left."""
        return self if share == 1.0 else self.scale(np.where(np.arange(len(self.km)) < first, 1.0, share))

    def scale(self, shares: Floats) -> "PlannedLegs":
        """Return a share of each leg."""
        scaled = zip(self.plan.legs, shares.tolist(), strict=True)
        legs = [leg if share == 1.0 else _take_share(leg, share) for leg, share in scaled]
        energy, begun = (shares[:, np.newaxis] * each for each in (self.energy, self.begun_energy))
        return PlannedLegs.create(msgspec.structs.replace(self.plan, legs=legs), energy, begun)

    def insert(self, place: int, inserted: "PlannedLegs") -> "PlannedLegs":
        """Return these legs with those of another plan inserted before the leg at an index."""
        legs = [*self.plan.legs[:place], *inserted.plan.legs, *self.plan.legs[place:]]
        parts = ((self.energy, inserted.energy), (self.begun_energy, inserted.begun_energy))
        energy, begun = (np.concatenate([present[:place], more, present[place:]]) for present, more in parts)
        return PlannedLegs.create(msgspec.structs.replace(self.plan, legs=legs), energy, begun)

    def compute_progress(self, driven_km: float, rides: int = 0, charges: int = 0) -> NDArray[np.void]:
        """Return what these legs need after a number of rides and of charges, as one PLAN_PROGRESS."""
        out = np.zeros(1, PLAN_PROGRESS)
        row = out[0]
        row["planned"], row["end"], row["reserve"] = 1.0, self.plan.shift_end_s, self.plan.reserve_soc_pct / 100.0
        row["came"], row["driven_km"] = self.plan.time_s, driven_km
        _sum_up(self.km, self.seconds, self.charge_to, self.energy, self.begun_energy, rides, charges, out)
        return row


@njit(cache=True)
def _sum_up(
    km: Any, seconds: Any, charge_to: Any, energy: Any, begun_energy: Any, rides: int, charges: int, out: Any
) -> None:
    """Add the legs that are left after a number of rides and of charges to an empty PLAN_PROGRESS."""
    left = out[0]
    for i in range(len(km)):
        if isnan(charge_to[i]):
            rides -= 1
            if rides < 0:
                _add_ride(left, km[i], seconds[i], energy[i], begun_energy[i])
        else:
            charges -= 1
            if charges < 0:
                _add_charge(left, seconds[i], charge_to[i])


@njit(cache=False)
def _add_ride(left: Any, km: float, seconds: float, energy: Any, begun_energy: Any) -> None:
    """Add the next ride to the stretch that it is in."""
    if left.charges > 0.0:
        left.after_legs += 1.0
        left.after_km += km
        left.after_s += seconds
        _add(left.after_kwh, energy)
        return
    if left.legs == 0.0:
        left.leg_km, left.leg_s = km, seconds
        _add(left.leg_kwh, energy)
        _add(left.begun_kwh, begun_energy)
    else:
        left.later_km += km
        left.later_s += seconds
        _add(left.later_kwh, energy)
    left.legs += 1.0


@njit(cache=False)
def _add_charge(left: Any, seconds: float, charge_to: float) -> None:
    """Add the next charge; what came after the charge before lies between charges."""
    if left.charges == 0.0:
        left.charge_s = seconds
    else:
        left.between_legs += left.after_legs
        left.between_s += left.after_s + seconds
    left.charges += 1.0
    left.charge_to = charge_to
    left.after_legs = left.after_s = 0.0
    for j in range(_KNOTS):
        left.after_kwh[j] = 0.0


@njit(cache=False)
def _add(sums: Any, energy: Any) -> None:
    """Add the energy of a leg at each temperature."""
    for j in range(_KNOTS):
        sums[j] += energy[j]


def compute_planned_legs(plan: Plan, tables: LegEnergyTables | None) -> PlannedLegs:
    """Return the legs of a plan with their energies."""
    unknown = np.full((len(plan.legs), _KNOTS), np.nan)
    legs = PlannedLegs.create(plan, unknown, unknown)
    if tables is None or not plan.legs:
        return legs
    climbs = [
        (nan if leg.gained_m is None else leg.gained_m, nan if leg.lost_m is None else leg.lost_m) for leg in plan.legs
    ]
    gained, lost = np.array(climbs, np.float64).T.copy()
    energy, begun_energy = tables.compute_leg_energy(legs.km, legs.seconds, gained, lost)
    is_charge = np.isfinite(legs.charge_to)
    energy[is_charge] = begun_energy[is_charge] = 0.0
    return legs._replace(energy=energy, begun_energy=begun_energy)


def _take_share(leg: Leg, share: float) -> Leg:
    """Return a share of a ride."""
    return Leg(**{name: value and share * value for name, value in msgspec.structs.asdict(leg).items()})


def compute_share_left(leg_km: Floats, driven_km: Floats) -> Floats:
    """Return the share of legs that is left.

    Examples
    --------
    >>> compute_share_left(np.array([4.0, 4.0, 0.0]), np.array([1.0, 9.0, 1.0])).tolist()
    [0.75, 0.0, 1.0]
    """
    done = np.divide(np.maximum(driven_km, 0.0), leg_km, out=np.zeros(len(leg_km)), where=leg_km > LEAST_KM)
    return np.asarray(np.clip(1.0 - done, 0.0, 1.0))
