"""What the plan of each car says of the rest of its shift, kept up to date as plans come and rides end.

The latest plan replaces the one before, unless it is of a later shift: dispatch plans tomorrow while today's shift is
under way. A plan tells when its shift ends, not when it begins, so that is told from the end. Such a plan waits.
"""

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from core.batch import Floats, grown
from core.forecast.learning.leg_energy import TEMPERATURES, Tables
from core.forecast.outlook import COURSE, OVERTIME, Legs, legs, timely
from core.totals.accumulator import Totals
from core.wire.messages import Plan

PLAN_LAG: Final = 60.0
"""A ride that ends so soon after a plan came is not among its legs any more. [s]"""
SHORTEST_RIDE: Final = 0.2
"""A ride that went less far was a false start, and no leg of the plan. [km]"""
LONGEST_SHIFT: Final = 16 * 3600.0
"""A shift that ends later than so long from now is not the one under way. [s]"""
PROLONGED: Final = 6 * 3600.0
"""Nor is one that ends so much later than the shift under way was planned to. [s]"""

_CAME, _ENDED, _ROW = range(3)  # what a plan may change at, in this order

TablesOf = Callable[[int], Tables | None]


class Arrival(NamedTuple):
    """A plan that came for a lane before row `at` of the batch."""

    at: int
    lane: int
    plan: Plan


class Driving(NamedTuple):
    """Who drives a lane from row `at` of the batch on."""

    at: int
    lane: int
    driver: str


class Planned(NamedTuple):
    """A plan, how many of its legs are done, what the ride in progress had driven when it came, and its energies."""

    plan: Plan
    done: int = 0
    driven_km: float = 0.0
    legs: Legs | None = None

    def over(self, time: float) -> bool:
        """Tell whether its shift is over at a time, overtime allowed for while legs are left. [s]"""
        done = self.done >= len(self.plan.legs)
        return time > self.plan.shift_end_s + (0.0 if done else OVERTIME)


class Courses:
    """The plan of each lane, and what it says of the rest of the shift.

    Attributes
    ----------
    of_lane : (lanes,) COURSE
    plans : dict of int to Planned
        In force.
    later : dict of int to Plan
        Of a later shift, where dispatch has told that too.
    """

    def __init__(self) -> None:
        self.of_lane = np.zeros(0, COURSE)
        self.plans: dict[int, Planned] = {}
        self.later: dict[int, Plan] = {}
        self._ride_km = np.zeros(0)
        self._riding = np.zeros(0, np.bool_)
        self._waiting = np.zeros(0, np.bool_)  # lanes of `later`

    def follow(
        self, running: Totals, rides: Totals, arrivals: Sequence[Arrival], tables: TablesOf, lanes: int
    ) -> NDArray[np.void]:
        """Take the plans that came and the rides that ended; return what holds at each row of running totals.

        Parameters
        ----------
        running : Totals
            Of n rows.
        rides : Totals
            That ended.
        arrivals : sequence of Arrival
        tables : callable
            What is expected of a lane's car.
        lanes : int
            How many there are so far.

        Returns
        -------
        (n,) COURSE
        """
        self.of_lane, self._ride_km = grown(self.of_lane, lanes), grown(self._ride_km, lanes)
        self._riding, self._waiting = grown(self._riding, lanes), grown(self._waiting, lanes)
        out = self.of_lane[running.lane]
        km, time = ride_km(running), running.at_last("time")
        ended = rides.amount("distance") * 1e-3, rides.at_last("time")
        over = np.zeros(len(km), np.bool_)  # rows of rides that have ended since
        for at, what, i, lane in self._steps(running, rides, arrivals):
            if what == _ROW and not self._turns(lane, float(time[i])):
                continue
            mine = running.lane == lane
            before = mine & (running.at < at)
            if what == _ENDED:
                over |= before
                self._ended(lane, float(ended[0][i]), float(ended[1][i]))
            else:
                rows = np.flatnonzero(before & ~over)
                driven = float(km[rows[-1]] if len(rows) else self._ride_km[lane])
                plan = self.later[lane] if what == _ROW else arrivals[i].plan
                self._came(lane, plan, float(time[i]) if what == _ROW else plan.time_s, driven)
            self.of_lane[lane] = self._now(lane, tables)
            out[mine & (running.at >= at)] = self.of_lane[lane]
        now = running.lane[~over]
        self._ride_km[now], self._riding[now] = km[~over], running.ride[~over] >= 0
        return out

    def left(self, lane: int, time: float, given: Plan | None = None, known: Tables | None = None) -> Legs | None:
        """Return what is left of a plan, the leg that is being driven shortened; None where there is no plan.

        Parameters
        ----------
        lane : int
        time : float
            Now. [s]
        given : Plan, optional
            As if it came now, instead of the one in force.
        known : Tables, optional
            What is expected of the lane's car.
        """
        if given is not None:
            given = msgspec.structs.replace(given, time_s=time)
            planned = Planned(given, 0, float(self._ride_km[lane]), legs(given, known))
        elif (kept := self.plans.get(lane)) is None or not timely(kept.plan.time_s, kept.plan.shift_end_s, time):
            return None
        else:
            planned = kept
        driven = float(self._ride_km[lane]) - planned.driven_km
        whole = planned.legs or legs(planned.plan, None)
        return whole.left(planned.done, driven if self._riding[lane] else None)

    def riding(self, lane: int) -> bool:
        """Tell whether a lane's car is on a ride."""
        return bool(self._riding[lane])

    def _steps(self, running: Totals, rides: Totals, arrivals: Sequence[Arrival]) -> list[tuple[int, int, int, int]]:
        """Return in order what may change plans, (row, what, number, lane); rows only of lanes whose plan may wait."""
        steps = [(arrival.at, _CAME, i, arrival.lane) for i, arrival in enumerate(arrivals)]
        where = zip(rides.at.tolist(), rides.lane.tolist(), strict=True)
        steps += [(at, _ENDED, i, lane) for i, (at, lane) in enumerate(where)]
        may = self._waiting[running.lane]
        if arrivals:
            may |= np.isin(running.lane, [arrival.lane for arrival in arrivals])
        rows = np.flatnonzero(may)
        found = zip(running.at[rows].tolist(), rows.tolist(), running.lane[rows].tolist(), strict=True)
        return sorted([*steps, *((at, _ROW, i, lane) for at, i, lane in found)])

    def _came(self, lane: int, plan: Plan, time: float, driven_km: float) -> None:
        """Take a plan: it replaces the one in force, or waits in place of another of a later shift."""
        if self._waits(lane, plan, time):
            self.later[lane] = plan
        else:
            self.plans[lane] = Planned(plan, 0, driven_km)
            if lane in self.later and self.later[lane].shift_end_s <= plan.shift_end_s + PROLONGED:
                del self.later[lane]  # of the same shift, and older
        self._waiting[lane] = lane in self.later

    def _turns(self, lane: int, time: float) -> bool:
        """Tell whether the plan of a later shift is to be followed from now on."""
        return lane in self.later and not self._waits(lane, self.later[lane], time)

    def _waits(self, lane: int, plan: Plan, time: float) -> bool:
        """Tell whether a plan is of a later shift than the one under way."""
        planned = self.plans.get(lane)
        if plan.shift_end_s > time + LONGEST_SHIFT:
            return True
        if planned is None or planned.over(time):
            return False
        return plan.shift_end_s > planned.plan.shift_end_s + PROLONGED

    def _ended(self, lane: int, km: float, time: float) -> None:
        """Note that a ride has ended: a leg of the plan is done, unless the plan came as it ended."""
        self._ride_km[lane], self._riding[lane] = 0.0, False
        planned = self.plans.get(lane)
        if planned is not None:
            done = km >= SHORTEST_RIDE and time - planned.plan.time_s >= PLAN_LAG
            self.plans[lane] = planned._replace(done=planned.done + done, driven_km=0.0)

    def _now(self, lane: int, tables: TablesOf) -> NDArray[np.void]:
        """Return what the plan of a lane says now; nothing, where it has none or its car is not known well enough."""
        planned, known = self.plans.get(lane), tables(lane)
        if planned is None or known is None:
            return np.zeros((), COURSE)
        found = planned.legs or legs(planned.plan, known)
        self.plans[lane] = planned._replace(legs=found)
        return found.course(planned.done, planned.driven_km)

    def dump(self) -> Any:
        """Return the state as plain values."""
        plans = [
            (lane, plan, done, driven_km, found and (found.energy.tobytes(), found.begun.tobytes()))
            for lane, (plan, done, driven_km, found) in self.plans.items()
        ]
        return plans, list(self.later.items()), self.of_lane.tobytes(), self._ride_km.tolist(), self._riding.tolist()

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        plans, later, courses, driven, riding = state
        self.of_lane = np.frombuffer(courses, COURSE).copy()
        self._ride_km = np.array(driven, dtype=np.float64)
        self._riding = np.array(riding, dtype=np.bool_)
        self.plans = {}
        for lane, raw, done, driven_km, energies in plans:
            plan = msgspec.convert(raw, Plan)
            both = (np.frombuffer(each).reshape(-1, len(TEMPERATURES)) for each in energies or ())
            found = energies and Legs.of(plan, *both)
            self.plans[int(lane)] = Planned(plan, done, driven_km, found)
        self.later = {int(lane): msgspec.convert(raw, Plan) for lane, raw in later}
        self._waiting = np.isin(np.arange(len(self._riding)), list(self.later))


def ride_km(running: Totals) -> Floats:
    """Return what was driven of rides in progress, 0 between rides, (n,). [km]"""
    return np.where(running.ride >= 0, running.amount("distance") * 1e-3, 0.0)
