"""The day of each car of a divided fleet, by the repaired time of its own samples.

Consumers that divide a fleet receive its samples in different orders. What a car contributes to the daily update, and
which tables its forecasts use, must then follow from its own samples alone:

- From `lead` before midnight UTC by its own time, a car contributes to the daily update after the next one.
- From midnight on, its forecasts use the tables of the new day.

In between, the consumers end the day, exchange what their cars have contributed, and make the new tables.
"""

from typing import Any, Final

import numpy as np

from socast.core.batch import Floats, Ints, grown, take_lanes
from socast.core.columns import SECONDS_PER_DAY

UNKNOWN_DAY: Final = -1
"""Day of a car without a sample."""
LAST_DAY: Final = 100_000
"""A later day is that of a wrong clock."""
CAR_DAY: Final = np.dtype(
    [
        ("collects", "i8"),  # day of the update to which the car contributes
        ("collects_at", "i8"),  # place among the pending messages from which it does
        ("collected", "i8"),  # the day before
        ("serves", "i8"),  # day of the tables that its forecasts use
        ("serves_at", "i8"),
        ("served", "i8"),
        ("frozen", "i8"),  # newest update for which the yield of its display was taken
    ]
)
"""Days of a car, as numbers since 1970."""
_UNKNOWN: Final = np.array((UNKNOWN_DAY,) * len(CAR_DAY.names or ()), CAR_DAY)[()]


class CarDays:
    """Follow the days of all cars.

    Parameters
    ----------
    lead : float
        Time before midnight from which a car contributes to the update after the next one. [s]

    Attributes
    ----------
    of_lane : (lanes,) CAR_DAY
    """

    def __init__(self, lead: float) -> None:
        self._lead = lead
        self.of_lane = np.zeros(0, CAR_DAY)
        self._is_moving = False

    def grow(self, lanes: int) -> None:
        """Make room for a number of lanes."""
        self.of_lane = grown(self.of_lane, lanes, _UNKNOWN)

    def add_rows(self, lane: Ints, time: Floats, place: Ints) -> tuple[Ints, Ints]:
        """Take rows, and return the lanes that collect for another day from one of them on, and that serve another."""
        changed = []
        for name, lead in (("collect", self._lead), ("serve", 0.0)):
            now, at, before = f"{name}s", f"{name}s_at", f"{name}ed" if name == "collect" else "served"
            day = np.clip(np.nan_to_num(np.floor((time + lead) / SECONDS_PER_DAY)), 0, LAST_DAY).astype(np.int64)
            rows = np.flatnonzero(day > self.of_lane[now][lane])
            for row in rows.tolist():
                car = self.of_lane[lane[row]]
                if day[row] > car[now]:
                    car[before], car[at], car[now] = car[now], place[row], day[row]
            changed.append(np.unique(lane[rows]))
            self._is_moving |= len(rows) > 0
        return changed[0], changed[1]

    def find_collected(self, lanes: Ints, at: Ints) -> Ints:
        """Return the day to which cars contribute at places among the pending messages."""
        days = self.of_lane[lanes]
        return np.where(at >= days["collects_at"], days["collects"], days["collected"])

    def find_served(self, lanes: Ints, at: Ints) -> Ints:
        """Return the day whose tables cars use at places among the pending messages."""
        days = self.of_lane[lanes]
        return np.where(at >= days["serves_at"], days["serves"], days["served"])

    def settle(self) -> None:
        """Note that nothing is pending, so that places begin anew."""
        if self._is_moving:
            self.of_lane["collects_at"] = self.of_lane["serves_at"] = -1
            self._is_moving = False

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self.of_lane = take_lanes(self.of_lane, lanes)

    def dump(self) -> Any:
        """Return the state as bytes."""
        return self.of_lane.tobytes()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self.of_lane = np.frombuffer(state, CAR_DAY).copy()
        self._is_moving = True
        self.settle()
