"""Track the vehicle model of each lane at each row."""

from collections import Counter
from collections.abc import Sequence
from math import inf
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from socast.core.batch import Floats, Ints, grown, take_lanes
from socast.core.columns import POWER_SPANS
from socast.core.settings import Limits
from socast.core.vehicles.catalogue import OUT_OF_RANGE, UNKNOWN_MODEL, VehicleModel, vehicle_model
from socast.core.wire.message_order import VehicleChange
from socast.core.wire.messages import Vehicle

UNKNOWN: Final = 0
"""Kind of a car whose model is unknown, or that has not sent a vehicle message."""
SILENT: Final = "no_vehicle_message"
"""Reason: the car has not sent a vehicle message."""

TOO_MANY_MODELS: Final = "too_many_models"
"""Reason: there are as many vehicle models, or descriptions of vehicles, as the limits allow."""


class CarParameters(NamedTuple):
    """Hold the parameters of the car at each row, NaN where they are unknown.

    The ride table has columns of the same names.

    Parameters
    ----------
    mass_kg : (n,) float
        Kerb mass. [kg]
    rolling_resistance : (n,) float
        Coefficient of warm tyres on dry asphalt. [1]
    drag_area_m2 : (n,) float
        Drag coefficient times frontal area. [m^2]
    nominal_capacity_kwh : (n,) float
        Rated energy of the new battery. [kWh]
    accessory_scale : (n,) float
        Accessory power relative to that of the reference curve. [1]
    """

    mass_kg: Floats
    rolling_resistance: Floats
    drag_area_m2: Floats
    nominal_capacity_kwh: Floats
    accessory_scale: Floats


class ReplacedKind(NamedTuple):
    """Hold the kind that the car of a lane was of up to a place among the messages."""

    at: int
    lane: int
    kind: int


class Cars:
    """Hold the known kinds of car and the kind of every lane.

    A kind is a vehicle model with its overrides. Cars with the same model and overrides are of one kind and share a row
    of `parameters`.

    Parameters
    ----------
    limits : Limits
        A message that would exceed them is counted as `too_many_models` and does not change its car.

    Attributes
    ----------
    messages : list of (Vehicle or None)
        Message that describes each kind, without vehicle, time and date.
    models : list of (VehicleModel or None)
        Vehicle model of each kind, None where it is unknown.
    parameters : (kinds, 5) float
        `CarParameters` of each kind, NaN where unknown.
    capacity : (kinds,) float
        Usable capacity of each kind, nominal where the usable one is unknown. [kWh]
    period : (kinds,) float
        Period of the loggers of each kind as announced, NaN where it was not. [s]
    power_span : (kinds,) float
        What the power of a sample covers, as its place in `POWER_SPANS`.
    of_lane : (lanes,) int
        Kind of the car of each lane.
    unpredictable : Counter of str
        Number of vehicle messages without a prediction, by reason.
    """

    def __init__(self, limits: Limits = Limits()) -> None:  # noqa: B008 - immutable
        self._limits = limits
        self._names: set[str] = set()
        self.messages: list[Vehicle | None] = [None]
        self.models: list[VehicleModel | None] = [None]
        self.parameters: Floats = np.full((1, len(CarParameters._fields)), np.nan)
        self.capacity: Floats = np.full(1, np.nan)
        self.period: Floats = np.full(1, np.nan)
        self.power_span: Floats = np.zeros(1)
        self.of_lane: Ints = np.zeros(0, np.int64)
        self.unpredictable: Counter[str] = Counter()
        self._reasons: list[str | None] = [None]
        self._kinds: dict[bytes, int] = {}

    def name(self, kind: int) -> str | None:
        """Return the key of the vehicle model as the car sent it, None where it is unknown."""
        message = self.messages[kind]
        return None if message is None else message.model

    def unpredicted(self, kind: int) -> str | None:
        """Return why the energy of a car of this kind cannot be predicted, `None` where it can."""
        return SILENT if kind == UNKNOWN else self._reasons[kind]

    def group_unknown(self, vehicle_ids: Sequence[str]) -> dict[str, list[str]]:
        """Return the cars whose vehicle model is not in the catalogue, by the model that they sent."""
        unknown: dict[str, list[str]] = {}
        for vehicle, kind in zip(vehicle_ids, self.of_lane.tolist(), strict=False):
            if self._reasons[kind] == UNKNOWN_MODEL:
                unknown.setdefault(self.name(kind) or "", []).append(vehicle)
        return unknown

    def parameters_of(self, kinds: Ints) -> CarParameters:
        """Return the parameters of cars."""
        return CarParameters(*self.parameters.take(kinds, axis=0).T)

    def kinds(
        self, lane: Ints, changes: Sequence[VehicleChange], lanes: int, replaced: list[ReplacedKind] | None = None
    ) -> Ints:
        """Apply vehicle messages, and return the kind of car of each row."""
        self.of_lane = grown(self.of_lane, lanes)
        before = self.of_lane.take(lane)
        if not changes:
            return before
        applied: list[tuple[int, int, int]] = []
        for row, who, message, place in changes:
            kind, known = self.find_kind(message), int(self.of_lane[who])
            why = TOO_MANY_MODELS if kind is None else self._reasons[kind]
            if why is not None:
                self.unpredictable[why] += 1
            if kind is not None and kind != known:
                self.of_lane[who] = kind
                applied.append((who, row, kind))
                if replaced is not None:
                    replaced.append(ReplacedKind(place, who, known))
        return _apply_changes(before, lane, applied) if applied else before

    def find_kind(self, message: Vehicle) -> int | None:
        """Return the kind that a message describes, and add it if it is new; None where there are too many."""
        content = _strip_identity(message)
        key = msgspec.json.encode(content)
        kind = self._kinds.get(key)
        if kind is not None:
            return kind
        is_new = content.model not in self._names
        if (is_new and len(self._names) >= self._limits.vehicle_models) or len(self.models) > self._limits.vehicles:
            return None
        self._names.add(content.model)
        described = vehicle_model(message)
        kind = len(self.models)
        self._reasons.append(described if isinstance(described, str) else None)
        if isinstance(described, str):
            row, capacity, model = [np.nan] * len(CarParameters._fields), np.nan, None
        else:
            row, model = [getattr(described, name) for name in CarParameters._fields], described
            capacity = described.usable_capacity_kwh or described.nominal_capacity_kwh
        self.models.append(model)
        self.messages.append(content)
        self.parameters = np.vstack([self.parameters, row])
        self.capacity = np.append(self.capacity, capacity)
        period = None if described == OUT_OF_RANGE else content.period_s
        self.period = np.append(self.period, np.nan if period is None else period)
        self.power_span = np.append(self.power_span, float(POWER_SPANS.index(content.power_covers or "moment")))
        self._kinds[key] = kind
        return kind

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self.of_lane = take_lanes(self.of_lane, lanes)

    def dump(self) -> Any:
        """Return the state as plain lists, for a snapshot."""
        return [[msgspec.to_builtins(m) for m in self.messages[1:]], self.of_lane.tolist(), dict(self.unpredictable)]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        limits = self._limits
        self.__init__(limits._replace(vehicles=inf, vehicle_models=inf))  # type: ignore[misc]
        for message in state[0]:
            self.find_kind(msgspec.convert(message, Vehicle))
        self.of_lane = np.array(state[1], np.int64)
        self.unpredictable = Counter(state[2])
        self._limits = limits


def _apply_changes(before: Ints, lane: Ints, applied: list[tuple[int, int, int]]) -> Ints:
    """Return the kind of each row after changes, each (lane, row, kind) in the order of their arrival."""
    applied.sort(key=lambda change: change[:2])
    span = len(lane) + 1
    keys = np.array([who * span + row for who, row, _ in applied])
    last = np.searchsorted(keys, lane * span + np.arange(len(lane)), side="right") - 1
    applies = (last >= 0) & (keys[last] // span == lane)
    return np.where(applies, np.array([kind for *_, kind in applied])[last], before)


def _strip_identity(message: Vehicle) -> Vehicle:
    """Return a message without vehicle, time and date, so that only the description of the car remains."""
    return msgspec.structs.replace(message, vehicle_id="", time_s=0.0, in_service_date=None)
