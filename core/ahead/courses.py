"""What the plan of each car says of the rest of its shift, kept up to date as plans come and rides end."""

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from core.ahead.expected import Tables
from core.ahead.outlook import COURSE, Legs, legs
from core.batch import Floats, grown
from core.codec import Leg, Plan
from core.sums import Totals

PLAN_LAG: Final = 60.0
"""A ride that ends so soon after a plan came is not among its legs any more. [s]"""
SHORTEST_RIDE: Final = 0.2
"""A ride that went less far was a false start, and no leg of the plan. [km]"""

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
    done: int
    driven_km: float
    legs: Legs | None


class Courses:
    """The plan of each lane, and what it says of the rest of the shift."""

    def __init__(self) -> None:
        self.of_lane = np.zeros(0, COURSE)
        self.plans: dict[int, Planned] = {}
        self._ride_km = np.zeros(0)
        self._riding = np.zeros(0, np.bool_)

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
        self._riding = grown(self._riding, lanes)
        out = self.of_lane[running.lane]
        km = ride_km(running)
        ended = rides.amount("distance") * 1e-3, rides.at_last("time")
        steps = [(arrival.at, 0, i, arrival.lane) for i, arrival in enumerate(arrivals)]
        where = zip(rides.at.tolist(), rides.lane.tolist(), strict=True)
        steps += [(at, 1, i, lane) for i, (at, lane) in enumerate(where)]
        over = np.zeros(len(km), np.bool_)  # rows of rides that have ended since
        for at, what, i, lane in sorted(steps):
            mine = running.lane == lane
            before = mine & (running.at < at)
            if what == 0:
                rows = np.flatnonzero(before & ~over)
                driven = float(km[rows[-1]] if len(rows) else self._ride_km[lane])
                self.plans[lane] = Planned(arrivals[i].plan, 0, driven, None)
            else:
                over |= before
                self._ended(lane, float(ended[0][i]), float(ended[1][i]))
            self.of_lane[lane] = self._now(lane, tables)
            out[mine & (running.at >= at)] = self.of_lane[lane]
        now = running.lane[~over]
        self._ride_km[now], self._riding[now] = km[~over], running.ride[~over] >= 0
        return out

    def riding(self, lane: int) -> bool:
        """Tell whether a lane's car is on a ride."""
        return bool(self._riding[lane])

    def left(self, lane: int) -> tuple[Plan, list[Leg]] | None:
        """Return the plan of a lane, and its legs that remain, the one that is being driven shortened."""
        planned = self.plans.get(lane)
        if planned is None:
            return None
        legs = planned.plan.legs[planned.done :]
        driven = float(self._ride_km[lane]) - planned.driven_km
        if self._riding[lane] and legs and legs[0].distance_km > 0.0:
            share = min(max(1.0 - driven / legs[0].distance_km, 0.0), 1.0)
            parts = {name: value and share * value for name, value in msgspec.structs.asdict(legs[0]).items()}
            legs = [Leg(**parts), *legs[1:]]
        return planned.plan, legs

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
            (lane, each.plan, each.done, each.driven_km, None if each.legs is None else each.legs.energy.tolist())
            for lane, each in self.plans.items()
        ]
        return plans, self.of_lane.tobytes(), self._ride_km.tolist(), self._riding.tolist()

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        plans, courses, driven, riding = state
        self.of_lane = np.frombuffer(courses, COURSE).copy()
        self._ride_km = np.array(driven, dtype=np.float64)
        self._riding = np.array(riding, dtype=np.bool_)
        self.plans = {}
        for lane, raw, done, driven_km, energy in plans:
            plan = msgspec.convert(raw, Plan)
            found = None if energy is None else Legs.of(plan, np.array(energy, dtype=np.float64))
            self.plans[int(lane)] = Planned(plan, done, driven_km, found)


def ride_km(running: Totals) -> Floats:
    """Return what was driven of rides in progress, 0 between rides, (n,). [km]"""
    return np.where(running.ride >= 0, running.amount("distance") * 1e-3, 0.0)
