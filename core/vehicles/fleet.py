"""Which vehicle model each lane is, as of each row."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from core.batch import Floats, Ints, grown
from core.vehicles.catalogue import VehicleModel, vehicle_model
from core.wire.messages import Vehicle

UNKNOWN: Final = 0
"""Kind of a car that has not said what it is, or whose model is not known."""
SILENT: Final = "no_vehicle_message"
"""Reason: the car has not said what it is."""


class CarParameters(NamedTuple):
    """Parameters of the car at each row, (n,) float64 each, NaN where unknown; the ride table has columns of these names.

    Parameters
    ----------
    mass_kg : Kerb mass. [kg]
    rolling_resistance : Coefficient of warm tyres on dry asphalt. [1]
    drag_area_m2 : Drag coefficient times frontal area. [m^2]
    nominal_capacity_kwh : Rated energy of the new battery. [kWh]
    accessory_scale : Accessory power over that of the reference curve. [1]
    """

    mass_kg: Floats
    rolling_resistance: Floats
    drag_area_m2: Floats
    nominal_capacity_kwh: Floats
    accessory_scale: Floats


class Change(NamedTuple):
    """From this row of the batch on, the car in this lane is of this kind."""

    lane: int
    row: int
    kind: int


class Cars:
    """The kinds of car heard of, and the kind of every lane.

    A kind is a vehicle model with its overrides; equal ones share a row of `parameters`.
    """

    def __init__(self) -> None:
        self.messages: list[Vehicle | None] = [None]
        self.models: list[VehicleModel | None] = [None]
        self.parameters: Floats = np.full((1, len(CarParameters._fields)), np.nan)
        self.capacity: Floats = np.full(1, np.nan)
        self.of_lane: Ints = np.zeros(0, np.int64)
        self.unpredictable: Counter[str] = Counter()
        self._reasons: list[str | None] = [None]
        self._kinds: dict[bytes, int] = {}

    def name(self, kind: int) -> str | None:
        """Return the vehicle model's key as the car sent it."""
        message = self.messages[kind]
        return None if message is None else message.model

    def unpredicted(self, kind: int) -> str | None:
        """Return why no energy is predicted for a car of this kind, `None` where it is."""
        return SILENT if kind == UNKNOWN else self._reasons[kind]

    def parameters_of(self, kinds: Ints) -> CarParameters:
        """Return the parameters of cars of some kinds, (n,) each."""
        return CarParameters(*self.parameters.take(kinds, axis=0).T)

    def is_one(self, lane: int, message: Vehicle) -> bool:
        """Tell whether a message says of a car what is known of it."""
        kind = int(self.of_lane[lane]) if lane < len(self.of_lane) else UNKNOWN
        return self.messages[kind] == _bare(message)

    def kinds(self, lane: Ints, changes: Sequence[tuple[int, int, Vehicle]], lanes: int) -> Ints:
        """Return the kind of car of each row, and remember what changed.

        Parameters
        ----------
        lane : (n,) int
        changes : sequence of (row, lane, Vehicle)
            Messages, each with the row before which it came.
        lanes : int
            How many there are so far.
        """
        self.of_lane = grown(self.of_lane, lanes)
        before = self.of_lane.take(lane)
        if not changes:
            return before
        told = [Change(who, row, self._kind(message)) for row, who, message in changes]
        self.unpredictable.update(why for change in told if (why := self._reasons[change.kind]) is not None)
        for change in told:
            self.of_lane[change.lane] = change.kind
        told.sort(key=lambda change: change[:2])
        span = len(lane) + 1
        keys = np.array([change.lane * span + change.row for change in told])
        last = np.searchsorted(keys, lane * span + np.arange(len(lane)), side="right") - 1
        applies = (last >= 0) & (keys[last] // span == lane)
        return np.where(applies, np.array([change.kind for change in told])[last], before)

    def _kind(self, message: Vehicle) -> int:
        """Return the kind that a message describes, opening one for a kind not seen before."""
        told = _bare(message)
        key = msgspec.json.encode(told)
        kind = self._kinds.get(key)
        if kind is not None:
            return kind
        found = vehicle_model(message)
        kind = len(self.models)
        self._reasons.append(found if isinstance(found, str) else None)
        if isinstance(found, str):
            row, capacity, model = [np.nan] * len(CarParameters._fields), np.nan, None
        else:
            row, model = [getattr(found, name) for name in CarParameters._fields], found
            capacity = found.usable_capacity_kwh or found.nominal_capacity_kwh
        self.models.append(model)
        self.messages.append(told)
        self.parameters = np.vstack([self.parameters, row])
        self.capacity = np.append(self.capacity, capacity)
        self._kinds[key] = kind
        return kind

    def dump(self) -> Any:
        """Return the state as plain lists."""
        return [[msgspec.to_builtins(m) for m in self.messages[1:]], self.of_lane.tolist(), dict(self.unpredictable)]

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        self.__init__()  # type: ignore[misc]
        for message in state[0]:
            self._kind(msgspec.convert(message, Vehicle))
        self.of_lane = np.array(state[1], np.int64)
        self.unpredictable = Counter(state[2])


def _bare(message: Vehicle) -> Vehicle:
    """Return what a message says of any such car."""
    return msgspec.structs.replace(message, vehicle_id="", time_s=0.0, in_service_date=None)
