"""Track the plan of each car, and what it says about the rest of the shift, as plans arrive and rides end.

The newest plan replaces the one before, unless it is for a later shift: dispatch may plan tomorrow while today's shift
is in progress. A plan states when its shift ends, not when it begins, so the end decides its shift. The plan
of a later shift waits until that shift.

A ride that has ended uses up the next planned ride, and a car that departs after charging uses up the next planned
charge, in whatever order the plan has them.
"""

from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, RowsOfLanes, grown, take_keys, take_lanes
from socast.core.forecast.learning.consumption_terms import TEMPERATURES
from socast.core.forecast.learning.leg_energy import LegEnergyTables
from socast.core.forecast.outlook import OVERTIME, is_plan_current
from socast.core.forecast.planned_legs import PLAN_PROGRESS, PlannedLegs, compute_planned_legs
from socast.core.totals.accumulator import Totals
from socast.core.wire.messages import Plan

PLAN_LAG: Final = 60.0
"""A ride that ends within this time after a plan was sent is not among its legs. [s]"""
SHORTEST_RIDE: Final = 0.2
"""A shorter ride is a false start, and no leg of the plan. [km]"""
LONGEST_SHIFT: Final = 16 * 3600.0
"""A shift that ends later than this from now is not the one in progress. [s]"""
PROLONGATION: Final = 6 * 3600.0
"""A plan that ends this much later than the present plan is for a later shift. [s]"""
CUT_SHORT_MARGIN: Final = 900.0
"""A recording that ends earlier than this before the planned end of a shift cuts the shift short. [s]"""

_PLAN_CAME, _RIDE_ENDED, _ROW = range(3)  # kinds of steps, in the order in which they apply at the same place

_Step = tuple[int, int, int, int]
"""What may change a plan: place in the batch, kind, number among those of the kind, lane."""
GetTables = Callable[[int, int], LegEnergyTables | None]
"""Returns the tables of the vehicle model that the car of a lane had at a place in the batch."""
LIKE_LEG: Final = 0.3, 0.6
"""Relative difference of distance and of duration up to which a ride may be the next leg. [1]"""
SAME_LEG: Final = 0.1, 0.25
"""The same for a later leg. [1]"""
MOST_SKIPPED: Final = 2
"""Largest number of legs that are left out one after another."""


LANE_PLAN: Final = np.dtype(
    [
        ("ride_km", "f8"),  # distance of the ride in progress [km]
        ("arrived", "f8"),  # when the car came to charge last [s]
        ("departed", "f8"),  # when the last charge ended after which it departed [s]
        ("planned", "f8"),  # charge that was planned as it came, NaN without a planned charge [1]
        ("riding", "?"),
    ]
)
"""What the tracker remembers of each lane beside its plan."""
_KEPT: Final = "ride_km", "riding", "arrived", "departed", "planned"
"""Fields of it in a state."""


class PlanArrival(NamedTuple):
    """Hold a plan that arrived for a lane at the place `at` in the batch."""

    at: int
    lane: int
    plan: Plan


class DriverNamed(NamedTuple):
    """Hold the driver of a lane from the place `at` in the batch on."""

    at: int
    lane: int
    driver: str


class ActivePlan(NamedTuple):
    """Hold the plan in force of a car.

    Parameters
    ----------
    done, charged : Number of rides and of charges that are done.
    driven_km : Distance that the ride in progress had driven when the plan arrived. [km]
    legs : The legs with their energies, once these are known.
    """

    plan: Plan
    done: int = 0
    driven_km: float = 0.0
    legs: PlannedLegs | None = None
    charged: int = 0

    def list_charges(self) -> list[float]:
        """Return the charge after each planned charge that is left. [1]"""
        planned = [leg.charge_to_soc_pct / 100.0 for leg in self.plan.legs if leg.charge_to_soc_pct is not None]
        return planned[self.charged :]

    def count_done(self, km: float, seconds: float) -> int:
        """Return how many legs are done with a ride: those before it as well, whose passengers did not come.

        It is a later leg only if it is as long as that one, and not as long as the next one.
        """
        rides = [leg for leg in self.plan.legs if leg.charge_to_soc_pct is None][self.done :]
        for skipped, leg in enumerate(rides[: MOST_SKIPPED + 1]):
            play = SAME_LEG if skipped else LIKE_LEG
            if _differ_by(leg.distance_km or 0.0, km) < play[0] and _differ_by(leg.duration_s, seconds) < play[1]:
                return skipped + 1
        return 1

    def is_over(self, time: float) -> bool:
        """Return whether its shift is over at a time, with overtime while legs are left. [s]"""
        rides = sum(leg.charge_to_soc_pct is None for leg in self.plan.legs)
        done = self.done >= rides and not self.list_charges()
        return time > self.plan.shift_end_s + (0.0 if done else OVERTIME)


class PlanTracker:
    """Track the plan of each lane, and what it says about the rest of the shift.

    Attributes
    ----------
    progress : (lanes,) PLAN_PROGRESS
    outcomes : list of (float, float)
        Charges that planned chargings of the last batch were to lead to, and those with which the cars departed. [1]
    """

    def __init__(self) -> None:
        self.progress = np.zeros(0, PLAN_PROGRESS)
        self.plans: dict[int, ActivePlan] = {}
        self.later: dict[int, Plan] = {}
        self.outcomes: list[tuple[float, float]] = []
        self._lanes = np.zeros(0, LANE_PLAN)

    def process(
        self,
        running: Totals,
        rides: Totals,
        arrivals: Sequence[PlanArrival],
        estimates: NDArray[np.void],
        get_tables: GetTables,
        lanes: int,
    ) -> NDArray[np.void]:
        """Process arrived plans, and ended rides and charges; return the progress at each row of running totals."""
        self.progress, self._lanes = grown(self.progress, lanes), grown(self._lanes, lanes)
        self.outcomes = []
        out = self.progress.take(running.lane)  # `take` and `put` copy records ten times as fast as an index
        km, time = get_ride_km(running), running.at_last("time")
        ended_km, ended_s = rides.amount("distance") * 1e-3, rides.amount("duration")
        ended_time = rides.at_last("time")
        over = np.zeros(len(km), np.bool_)  # rows of rides that have ended since
        charged = estimates["arrived"] > self._lanes["arrived"][running.lane]
        charged |= (estimates["departed"] == 1.0) & (estimates["unplugged"] > self._lanes["departed"][running.lane])
        rows_of_lanes = RowsOfLanes(running.lane)
        steps = self._list_steps(running, rides, arrivals, charged)
        while steps:
            at, kind, i, lane = heappop(steps)
            begins = kind == _ROW and self._begins_later_shift(lane, float(time[i]))
            if kind == _ROW and not ((charged[i] and self._follow_charge(lane, estimates[i])) or begins):
                continue
            rows = rows_of_lanes.find(lane)
            before = int(np.searchsorted(running.at[rows], at))
            if kind == _RIDE_ENDED:
                over[rows[:before]] = True
                self._end_ride(lane, float(ended_km[i]), float(ended_s[i]), float(ended_time[i]))
            elif kind == _PLAN_CAME or begins:
                rides_on = before > 0 and not over[rows[before - 1]]
                driven = float(km[rows[before - 1]] if rides_on else self._lanes["ride_km"][lane])
                plan = self.later[lane] if kind == _ROW else arrivals[i].plan
                waited = lane in self.later
                self._add_plan(lane, plan, float(time[i]) if kind == _ROW else plan.time_s, driven)
                if lane in self.later and not waited:
                    for row in rows[before:].tolist():
                        heappush(steps, (int(running.at[row]), _ROW, row, lane))
            self.progress[lane] = self._compute_progress(lane, get_tables(lane, at))
            out.put(rows[before:], self.progress[lane : lane + 1])
        now = running.lane[~over]
        self._lanes["ride_km"][now], self._lanes["riding"][now] = km[~over], running.ride[~over] >= 0
        return out

    def renew_energies(self, time: float, get_tables: Callable[[int], LegEnergyTables | None]) -> None:
        """Compute the energies of plans whose shifts are not over at a time anew, by the tables of each lane."""
        for lane, active in self.plans.items():
            if active.plan.shift_end_s + OVERTIME >= time:
                self.plans[lane] = active._replace(legs=None)
                self.progress[lane] = self._compute_progress(lane, get_tables(lane))

    def get_remaining_legs(
        self, lane: int, time: float, given: Plan | None = None, tables: LegEnergyTables | None = None
    ) -> PlannedLegs | None:
        """Return what is left of a plan, with the leg in progress shortened; None where there is no plan.

        A given plan is used instead of the one in force, as if it arrived now.
        """
        active = self.plans.get(lane)
        if given is not None:
            given = msgspec.structs.replace(given, time_s=time)
            active = ActivePlan(given, 0, float(self._lanes["ride_km"][lane]), compute_planned_legs(given, tables))
        elif active is None or not is_plan_current(active.plan.time_s, active.plan.shift_end_s, time):
            return None
        driven = float(self._lanes["ride_km"][lane]) - active.driven_km
        left = (active.legs or compute_planned_legs(active.plan, None)).drop_done(active.done, active.charged)
        return left.shorten(driven) if self._lanes["riding"][lane] else left

    def is_riding(self, lane: int) -> bool:
        """Return whether a lane's car is on a ride."""
        return bool(self._lanes["riding"][lane])

    def _list_steps(
        self, running: Totals, rides: Totals, arrivals: Sequence[PlanArrival], charged: NDArray[np.bool_]
    ) -> list[_Step]:
        """Return in order what may change plans; rows only of lanes whose plan waits, or that have charged."""
        steps = [(arrival.at, _PLAN_CAME, i, arrival.lane) for i, arrival in enumerate(arrivals)]
        ends = zip(rides.at.tolist(), rides.lane.tolist(), strict=True)
        steps += [(at, _RIDE_ENDED, i, lane) for i, (at, lane) in enumerate(ends)]
        rows = np.flatnonzero(np.isin(running.lane, list(self.later)) | charged)
        waiting = zip(running.at[rows].tolist(), rows.tolist(), running.lane[rows].tolist(), strict=True)
        return sorted([*steps, *((at, _ROW, i, lane) for at, i, lane in waiting)])

    def _add_plan(self, lane: int, plan: Plan, time: float, driven_km: float) -> None:
        """Put a plan in force, or let it wait in place of another one of a later shift."""
        if self._is_for_later_shift(lane, plan, time):
            self.later[lane] = plan
        else:
            self.plans[lane] = ActivePlan(plan, 0, driven_km)
            if lane in self.later and self.later[lane].shift_end_s <= plan.shift_end_s + PROLONGATION:
                del self.later[lane]  # an older plan of the same shift

    def _begins_later_shift(self, lane: int, time: float) -> bool:
        """Return whether the waiting plan of a later shift is in force from now on."""
        return lane in self.later and not self._is_for_later_shift(lane, self.later[lane], time)

    def _is_for_later_shift(self, lane: int, plan: Plan, time: float) -> bool:
        """Return whether a plan is for a later shift than the one in progress."""
        active = self.plans.get(lane)
        if plan.shift_end_s > time + LONGEST_SHIFT:
            return True
        if active is None or active.is_over(time):
            return False
        return plan.shift_end_s > active.plan.shift_end_s + PROLONGATION

    def _end_ride(self, lane: int, km: float, seconds: float, time: float) -> None:
        """Count a leg as done when its ride has ended, unless the plan was sent as the ride ended."""
        self._lanes["ride_km"][lane], self._lanes["riding"][lane] = 0.0, False
        active = self.plans.get(lane)
        if active is not None:
            is_done = km >= SHORTEST_RIDE and time - active.plan.time_s >= PLAN_LAG
            done = active.done + (active.count_done(km, seconds) if is_done else 0)
            self.plans[lane] = active._replace(done=done, driven_km=0.0)

    def _follow_charge(self, lane: int, estimate: NDArray[np.void]) -> bool:
        """Note what is planned as a car comes to charge, and what it reached as it departs, which ends the leg.

        Return whether a leg has ended. A plan that was sent as the charge ended, or later, is about what follows.
        """
        active, arrived, unplugged = self.plans.get(lane), float(estimate["arrived"]), float(estimate["unplugged"])
        left = [] if active is None else active.list_charges()
        if arrived > self._lanes["arrived"][lane]:
            self._lanes["arrived"][lane], self._lanes["planned"][lane] = arrived, left[0] if left else np.nan
        if not (unplugged > self._lanes["departed"][lane] and estimate["departed"] == 1.0):
            return False
        self._lanes["departed"][lane] = unplugged
        if np.isfinite(self._lanes["planned"][lane]):
            self.outcomes.append((float(self._lanes["planned"][lane]), float(estimate["charged_soc"])))
        if active is None or not left or unplugged - active.plan.time_s < PLAN_LAG:
            return False
        self.plans[lane] = active._replace(charged=active.charged + 1)
        return True

    def _compute_progress(self, lane: int, tables: LegEnergyTables | None) -> NDArray[np.void]:
        """Return the progress of a lane's plan; an empty one without a plan or without tables of the car."""
        active = self.plans.get(lane)
        if active is None or tables is None:
            return np.zeros((), PLAN_PROGRESS)
        legs = active.legs or compute_planned_legs(active.plan, tables)
        self.plans[lane] = active._replace(legs=legs)
        return legs.compute_progress(active.driven_km, active.done, active.charged)

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self.plans, self.later = take_keys(self.plans, lanes), take_keys(self.later, lanes)
        self.progress, self._lanes = take_lanes(self.progress, lanes), take_lanes(self._lanes, lanes)

    def dump(self) -> Any:
        """Return the state as plain values."""
        plans = [
            (lane, plan, done, driven_km, legs and (legs.energy.tobytes(), legs.begun_energy.tobytes()), charged)
            for lane, (plan, done, driven_km, legs, charged) in self.plans.items()
        ]
        ride_km, riding, *charges = (self._lanes[name].tolist() for name in _KEPT)
        return plans, list(self.later.items()), self.progress.tobytes(), ride_km, riding, charges

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        plans, later, progress, ride_km, riding, charges = state
        self.progress = np.frombuffer(progress, PLAN_PROGRESS).copy()
        self._lanes = np.zeros(len(ride_km), LANE_PLAN)
        for name, values in zip(_KEPT, (ride_km, riding, *charges), strict=True):
            self._lanes[name] = values
        self.plans = {}
        for lane, raw, done, driven_km, energies, charged in plans:
            plan = msgspec.convert(raw, Plan)
            arrays = (np.frombuffer(each).reshape(-1, len(TEMPERATURES)).copy() for each in energies or ())
            legs = energies and PlannedLegs.create(plan, *arrays)
            self.plans[int(lane)] = ActivePlan(plan, done, driven_km, legs, charged)
        self.later = {int(lane): msgspec.convert(raw, Plan) for lane, raw in later}


def _differ_by(planned: float, driven: float) -> float:
    """Return by how much a quantity of a ride differs from the planned one. [1]"""
    return abs(driven - planned) / max(planned, 1e-9)


def get_ride_km(running: Totals) -> Floats:
    """Return the distance of the rides in progress, 0 between rides, (n,). [km]"""
    return np.where(running.ride >= 0, running.amount("distance") * 1e-3, 0.0)
