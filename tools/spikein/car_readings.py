"""Read what the cars of recordings measured, and what weather stations observed, with the message of each sample."""

from array import array
from collections import defaultdict
from collections.abc import Iterable
from itertools import compress
from typing import Final, NamedTuple

import msgspec
import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.files import UNREADABLE
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import PREFIX, BatchError, read_rows
from socast.core.wire.json_scanner import POSITION
from socast.core.wire.messages import BATCH, Message, Telemetry, Vehicle, Weather, address

LIMITS: Final = Limits()
"""Limits of a batch, as consumers have them."""
FIELDS: Final = (
    "time_s",
    "latitude_deg",
    "longitude_deg",
    "elevation_m",
    "speed_kmh",
    "soc_pct",
    "battery_voltage_v",
    "battery_current_a",
    "battery_temperature_c",
    "ambient_c",
    "occupants",
    "charging",
)
"""Fields of telemetry that an effect or its power needs."""
_PLACES: Final = tuple(POSITION[name] for name in FIELDS)


class CarReadings(NamedTuple):
    """Hold the samples of a car in the order of their times.

    Parameters
    ----------
    model : str
        Key of the vehicle model; empty where no message told it.
    message, place : (n,) int64
        Number of the message of each sample, and place of the sample in it.
    values : dict of str to (n,) float
        Values of `FIELDS` in wire units, NaN where unknown.
    """

    vehicle_id: str
    model: str
    message: Ints
    place: Ints
    values: dict[str, Floats]


class FleetReadings(NamedTuple):
    """Hold the samples of all cars and the observations of all stations."""

    cars: list[CarReadings]
    weather: list[Weather]


class FleetReader:
    """Collect the samples of messages; what cannot be read is left out, as consumers leave it out."""

    def __init__(self) -> None:
        self._rows: dict[str, array[float]] = defaultdict(lambda: array("d"))
        self._models: dict[str, str] = {}
        self._weather: list[Weather] = []
        self._telemetry = msgspec.json.Decoder(Telemetry | list[Telemetry])
        self._vehicle = msgspec.json.Decoder(Vehicle)
        self._observation = msgspec.json.Decoder(Weather)
        self._count = 0

    def take(self, messages: Iterable[Message]) -> None:
        """Read messages; their numbers count on."""
        for message in messages:
            known = address(message.key)
            try:
                if known is not None:
                    self._take(known.kind, known.identity, message.payload)
            except (*UNREADABLE, BatchError):
                pass
            self._count += 1

    def finish(self) -> FleetReadings:
        """Return what was read."""
        cars = [self._make_car(name, rows) for name, rows in sorted(self._rows.items())]
        self._weather.sort(key=lambda each: each.time_s)
        return FleetReadings(cars, self._weather)

    def _take(self, kind: str, identity: str, payload: bytes) -> None:
        """Read one message."""
        if payload.startswith(PREFIX) and kind in {"telemetry", BATCH}:
            rows = read_rows(payload, LIMITS.list_samples)
            names = [rows.vehicles.get(at) for at in range(len(rows.is_usable))]
            table = rows.table[_PLACES, :].T.tolist()
            used = rows.is_usable.tolist()
            for place, name, values in compress(zip(range(len(names)), names, table, strict=True), used):
                if kind == BATCH or name == identity:
                    self._rows[name].extend((self._count, place, *values))
        elif kind == "telemetry":
            decoded = self._telemetry.decode(payload)
            for place, sample in enumerate(decoded if isinstance(decoded, list) else [decoded]):
                values = [getattr(sample, name) for name in FIELDS]
                self._rows[identity].extend(
                    (self._count, place, *(np.nan if each is None else each for each in values))
                )
        elif kind == "vehicle":
            self._models[identity] = self._vehicle.decode(payload).model
        elif kind == "weather" and (observed := self._observation.decode(payload)).issued_s is None:
            self._weather.append(observed)

    def _make_car(self, name: str, rows: "array[float]") -> CarReadings:
        """Return the samples of a car as columns, in the order of their times."""
        table = np.frombuffer(rows).reshape(-1, 2 + len(FIELDS))
        table = table[np.argsort(table[:, 2], kind="stable")]
        columns = dict(zip(FIELDS, table[:, 2:].T.copy(), strict=True))
        return CarReadings(name, self._models.get(name, ""), table[:, 0].astype(int), table[:, 1].astype(int), columns)
