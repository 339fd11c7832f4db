"""Names and drivers of rides, as the wire reports them."""

from collections import deque
from collections.abc import Iterable
from math import inf
from typing import Any, Final

from socast.core.batch import NO_RIDE
from socast.core.wire.messages import Ride

NAMES: Final = 10_000
"""Number of ride names that are remembered, in addition to `NAMES_PER_VEHICLE` per vehicle."""
NAMES_PER_VEHICLE: Final = 2
DRIVERS: Final = 10_000
"""Number of rides whose driver is remembered, in addition to `DRIVERS_PER_VEHICLE` per vehicle."""
DRIVERS_PER_VEHICLE: Final = 8


class RideNames(dict[Any, float]):
    """Assign a code to each ride name, and return the name of a code.

    Indexing with a name that has no code yet assigns the next one. None maps to `NO_RIDE`.

    Attributes
    ----------
    generation : int
        Number of times that names were forgotten or loaded; codes hold as long as it is the same.
    """

    def __init__(self) -> None:
        super().__init__()
        self._opened = 0
        self.generation = 0
        self._assign({})

    def __missing__(self, name: str) -> float:
        code = self[name] = float(self._opened)
        self._name_of[code] = name
        self._opened += 1
        return code

    def are_many(self, vehicles: int) -> bool:
        """Return whether so many names are known of a number of vehicles that some should be forgotten."""
        return len(self) > NAMES_PER_VEHICLE * vehicles + NAMES

    def names(self, codes: Iterable[float]) -> list[str | None]:
        """Return the name of each code, None where it has none."""
        return [self._name_of.get(code) for code in codes]

    def keep(self, codes: set[float]) -> None:
        """Forget all names except those of some codes."""
        self._assign({code: name for code, name in self._name_of.items() if code in codes})

    def dump(self) -> Any:
        """Return the state as plain lists."""
        return [list(self._name_of.items()), self._opened]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        names, self._opened = state
        self._assign(dict(names))

    def _assign(self, names: dict[float, str | None]) -> None:
        """Replace all names by those of a mapping from codes."""
        self.generation += 1
        self.clear()
        self[None] = NO_RIDE
        self.update({name: code for code, name in names.items()})
        self._name_of: dict[float, str | None] = {NO_RIDE: None, **names}


class RideDrivers:
    """Remember the driver of each ride, as dispatch reports it. The oldest rides are forgotten first.

    A report waits until a ride is looked up that ended after it. The driver of a ride is therefore the one that was
    reported last before its end, however late the ride is looked up.
    """

    def __init__(self) -> None:
        self._driver_of: dict[str, str] = {}
        self._reports: deque[tuple[int, str, str, int]] = deque()  # place, ride, driver, most rides to remember
        self._vehicles = 0

    def observe(self, ride: Ride, lane: int, place: int) -> None:
        """Take the report of a driver."""
        if ride.driver_id is not None:
            self._vehicles = max(self._vehicles, lane + 1)
            most = DRIVERS_PER_VEHICLE * self._vehicles + DRIVERS
            self._reports.append((place, f"{ride.vehicle_id}/{ride.ride_id}", ride.driver_id, most))

    def find(self, vehicle_id: str, ride_id: str | None, place: float) -> str | None:
        """Return the driver of a ride that ended at a place, None where unknown; places must ascend."""
        self.settle(place)
        return self._driver_of.get(f"{vehicle_id}/{ride_id}")

    def find_all(
        self, vehicle_ids: Iterable[str], ride_ids: Iterable[str | None], places: Iterable[float]
    ) -> list[str | None]:
        """Return the drivers of rides in the order of the places at which they ended, see `find`."""
        return [self.find(*ride) for ride in zip(vehicle_ids, ride_ids, places, strict=True)]

    def settle(self, place: float = inf) -> None:
        """Remember the drivers reported up to a place, and forget the oldest rides where too many are known."""
        while self._reports and self._reports[0][0] <= place:
            _, ride, driver, most = self._reports.popleft()
            self._driver_of[ride] = driver
            if len(self._driver_of) > most:
                del self._driver_of[next(iter(self._driver_of))]

    def dump(self) -> Any:
        """Return the state as plain values."""
        return [dict(self._driver_of), list(self._reports), self._vehicles]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        drivers, reports, self._vehicles = state
        self._driver_of, self._reports = dict(drivers), deque(map(tuple, reports))
