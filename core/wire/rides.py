"""Names and drivers of rides, as the wire reports them."""

from collections.abc import Iterable
from typing import Any, Final

from core.batch import NO_RIDE
from core.wire.messages import Ride

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
    """Remember the driver of each ride, as dispatch reports it. The oldest rides are forgotten first."""

    def __init__(self) -> None:
        self._driver_of: dict[str, str] = {}

    def observe(self, ride: Ride, vehicles: int) -> None:
        """Remember the driver of a ride, and forget the oldest ride where too many are known.

        Parameters
        ----------
        ride : Ride
        vehicles : int
            Number of vehicles seen so far.
        """
        if ride.driver_id is None:
            return
        self._driver_of[f"{ride.vehicle_id}/{ride.ride_id}"] = ride.driver_id
        if len(self._driver_of) > DRIVERS_PER_VEHICLE * vehicles + DRIVERS:
            del self._driver_of[next(iter(self._driver_of))]

    def find(self, vehicle_id: str, ride_id: str | None) -> str | None:
        """Return the driver of a ride, None where unknown."""
        return self._driver_of.get(f"{vehicle_id}/{ride_id}")

    def dump(self) -> dict[str, str]:
        """Return the state as a plain mapping."""
        return dict(self._driver_of)

    def load(self, state: dict[str, str]) -> None:
        """Replace the state by one that `dump` returned."""
        self._driver_of = dict(state)
