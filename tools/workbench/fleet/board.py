"""The newest values of every car as columns, and the history of each car, from messages alone.

A board takes the telemetry that cars send and the forecasts that `socast` publishes, whether a replay makes them or a
live service does. It never computes a forecast.
"""

import logging
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby
from math import isfinite, nan
from threading import RLock
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.files import UNREADABLE
from socast.core.forecast.status import find_ended_shifts
from socast.core.wire.live_fields import list_live_fields
from socast.core.wire.messages import Address, Finding, Forecast, Interval, Message, address
from socast.core.wire.sample_reader import Samples, holds_samples, read_samples
from socast.tools.workbench.fleet.density import TraceDensity
from socast.tools.workbench.fleet.fleet_time import SILENT_S, FleetTime, find_newest
from socast.tools.workbench.fleet.newest_values import COLUMNS, compile_kernel, make_unknown_cars, write_samples

POINT: Final = ("soc_pct", "ride_energy_predicted_kwh", "ride_energy_measured_kwh", "ride")
"""Values of a point of a history, beside its time; `ride` numbers the rides of the car."""
MOST_POINTS: Final = 4000
"""Largest number of points of a history; the older half is then dropped."""
MOST_CARS: Final = 50_000
"""Largest number of cars; later ones are not shown."""
MOST_COUNT: Final = 2**53
"""Largest number of samples by cause that a forecast may give."""
MOST_FINDINGS: Final = 200
"""Largest number of findings that are kept, the newest."""
MOST_BYTES: Final = 1 << 16
"""Largest message that holds no samples. [B]"""
LONGEST_NAME: Final = 256
"""Largest number of characters of the name of a ride or of a vehicle model."""
LATEST_S: Final = 2.0**33
"""Latest time of a forecast, in the year 2242. [Unix s]"""
UNDECODABLE, IMPOSSIBLE, TOO_LARGE, SURPLUS, DEFECT = "undecodable", "impossible", "too_large", "surplus", "defect"
REFUSED: Final = (UNDECODABLE, IMPOSSIBLE, TOO_LARGE, SURPLUS, DEFECT)
"""Causes for which a message is left out: no message of the contract, values that cannot be, its size, more cars than
`MOST_CARS`, and a defect of the board."""
_log = logging.getLogger("socast.workbench")


class _Vehicle(msgspec.Struct):
    """Hold the model of a vehicle message."""

    model: str


class BoardState(NamedTuple):
    """Hold what `Board.load` needs to return to an earlier state; histories only grow, so their lengths will do."""

    vehicle_ids: list[str]
    values: NDArray[np.void]
    models: dict[str, str]
    quality: dict[str, dict[str, int]]
    ride_ids: dict[str, str | None]
    lengths: list[int]
    findings: dict[str, Finding]
    rides: int
    time: FleetTime


class History:
    """Hold the values of a car over time.

    Attributes
    ----------
    dropped : int
        Number of old points that were dropped.
    """

    def __init__(self) -> None:
        self.time, self.values, self.dropped, self.ride = array("d"), array("f"), 0, 0

    def __len__(self) -> int:
        """Return the number of points since the beginning."""
        return self.dropped + len(self.time)

    def add(self, time: float, values: Sequence[float]) -> None:
        """Append a point; one that does not follow the last in time is left out."""
        if self.time and time <= self.time[-1]:
            return
        self.time.append(time)
        self.values.extend(values)
        if len(self.time) > MOST_POINTS:
            half = MOST_POINTS // 2
            self.dropped += half
            del self.time[:half]
            del self.values[: half * len(POINT)]

    def truncate(self, length: int) -> None:
        """Drop the points after a length since the beginning."""
        kept = max(0, length - self.dropped)
        del self.time[kept:]
        del self.values[kept * len(POINT) :]
        self.ride = int(self.values[-1]) if self.values else 0

    def tabulate(self) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return the times, (n,), and the values, (n, len(POINT))."""
        return np.array(self.time), np.array(self.values, np.float32).reshape(-1, len(POINT))


class Board:
    """Hold the newest values of every car.

    Attributes
    ----------
    lock : RLock
        Lock of everything below; a reader of several attributes holds it.
    vehicle_ids : list of str
        Cars in the order of their rows.
    epoch : int
        Number that changes when rows change their meaning, after a seek.
    """

    def __init__(self) -> None:
        compile_kernel()
        self.lock = RLock()
        self.vehicle_ids: list[str] = []
        self.epoch = 0
        self.rides: list[dict[str, Any]] = []
        self.density = TraceDensity()
        self.counts: Counter[str] = Counter()
        self.models: dict[str, str] = {}
        self.quality: dict[str, dict[str, int]] = {}
        self.findings: dict[str, Finding] = {}
        self._ride_ids: dict[str, str | None] = {}
        self._rows: dict[str, int] = {}
        self._values = make_unknown_cars(64)
        self._time = FleetTime()
        self._histories: list[History] = []
        self._decode = {
            "forecast": msgspec.json.Decoder(Forecast).decode,
            "vehicle": msgspec.json.Decoder(_Vehicle).decode,
            "finding": msgspec.json.Decoder(Finding).decode,
        }

    def __len__(self) -> int:
        """Return the number of cars."""
        return len(self.vehicle_ids)

    def column(self, name: str) -> NDArray[np.float64]:
        """Return a view of a column, one value per car."""
        return self._values[name][: len(self)]

    @property
    def newest(self) -> float:
        """Newest time of the cars that are not silent, except wrong clocks; NaN without a car. [Unix s]"""
        return find_newest(self.column("time"), ~self.find_silent())

    def get_ages(self) -> NDArray[np.float64]:
        """Return the time since the last forecast of each car, as other cars show it. [s]"""
        return self._time.progress - self.column("heard")

    def find_silent(self) -> NDArray[np.bool_]:
        """Return which cars are silent."""
        return self.get_ages() > SILENT_S

    def find_over(self) -> NDArray[np.bool_]:
        """Return of which cars the shift is over, as far as forecasts tell."""
        riding = self.column("riding") > 0.0
        return find_ended_shifts(self.column("time"), self.get_ages(), self.column("shift_end_s"), riding)

    def find(self, vehicle_id: str) -> int | None:
        """Return the row of a car, None for one that has sent nothing."""
        return self._rows.get(vehicle_id)

    def get_values(self, vehicle_id: str) -> dict[str, float]:
        """Return the newest values of a car by column."""
        return dict(zip(COLUMNS, self._values[self._rows[vehicle_id]].item(), strict=True))

    def get_ride(self, vehicle_id: str) -> str | None:
        """Return the name of the ride in progress of a car."""
        return self._ride_ids.get(vehicle_id)

    def get_history(self, vehicle_id: str) -> History:
        """Return the history of a car."""
        return self._histories[self._rows[vehicle_id]]

    def take(self, messages: Iterable[Message]) -> None:
        """Take messages in their order; those of `REFUSED` are counted by cause and left out."""
        with self.lock:
            for are_samples, part in groupby(messages, holds_samples):
                if are_samples:
                    self._guard(self._take_telemetry, list(part))
                else:  # one by one, so that none counts twice where one fails
                    for message in part:
                        self._guard(self._take_others, [message])

    def count_refused(self) -> dict[str, int]:
        """Return the number of messages that were left out, by cause."""
        return {cause: self.counts[cause] for cause in REFUSED if self.counts[cause]}

    def _guard(self, take: Callable[[list[Message]], None], messages: list[Message]) -> None:
        """Take messages; if that fails, take them one by one, so that only those that fail are left out."""
        try:
            take(messages)
        except Exception:  # noqa: BLE001 - whatever a stranger sends, the board goes on
            if len(messages) > 1:
                for message in messages:
                    self._guard(take, [message])
                return
            if not self.counts[DEFECT]:
                _log.exception("a message under %s was left out by a defect; later ones are counted", messages[0].key)
            self.counts[DEFECT] += 1

    def _take_telemetry(self, messages: list[Message]) -> None:
        """Take samples and batches."""
        for samples in read_samples(messages, self.counts):
            self._take_samples(samples)

    def _take_others(self, messages: list[Message]) -> None:
        """Take messages that hold no samples."""
        for message in messages:
            where = address(message.key)
            decode = self._decode.get(where.kind) if where else None
            if where is not None and decode is not None:
                self.counts[self._take_other(where, decode, message.payload)] += 1

    def _take_other(self, where: Address, decode: Callable[[bytes], Any], payload: bytes) -> str:
        """Take a message that holds no samples; return its kind, or why it is left out."""
        if len(payload) > MOST_BYTES:
            return TOO_LARGE
        try:
            value = decode(payload)
        except UNREADABLE:
            return UNDECODABLE
        if not _is_possible(value):
            return IMPOSSIBLE
        if not isinstance(value, Finding):
            known: Mapping[str, Any] = self.models if isinstance(value, _Vehicle) else self._rows
            if len(known) >= MOST_CARS and where.identity not in known:
                return SURPLUS
        self._take_value(where.identity, value)
        return where.kind

    def _take_value(self, identity: str, value: Any) -> None:
        """Take the content of a message that holds no samples."""
        if isinstance(value, Finding):
            self.findings.pop(identity, None)
            self.findings[identity] = value
            while len(self.findings) > MOST_FINDINGS:
                del self.findings[next(iter(self.findings))]
        elif isinstance(value, _Vehicle):
            self.models[identity] = value.model
        else:
            self._take_forecast(identity, self._find_row(identity), value)

    def _find_row(self, vehicle_id: str) -> int:
        """Return the row of a car, a new one for a new car; -1 above `MOST_CARS`."""
        row = self._rows.get(vehicle_id, -1)
        if row < 0 and len(self) < MOST_CARS:
            row = self._rows[vehicle_id] = len(self)
            self.vehicle_ids.append(vehicle_id)
            self._histories.append(History())
            if len(self) > len(self._values):
                self._values = np.concatenate([self._values, make_unknown_cars(len(self._values))])
            self._time.join(self._values[row])
        return row

    def _take_samples(self, samples: Samples) -> None:
        """Take samples of telemetry."""
        columns = samples.columns
        rows = np.array([self._find_row(vehicle_id) for vehicle_id in samples.vehicle_ids], np.int64)
        if surplus := int(np.sum(rows < 0)):
            self.counts[SURPLUS] += surplus
        is_taken = write_samples(self._values, rows, columns)
        self.density.add(columns.latitude[is_taken], columns.longitude[is_taken])

    def _take_forecast(self, vehicle_id: str, row: int, forecast: Forecast) -> None:
        """Take a forecast, and add a point to the history."""
        history, before = self._histories[row], self._ride_ids.get(vehicle_id)
        self._ride_ids[vehicle_id] = forecast.ride_id
        riding = forecast.ride_id is not None or forecast.ride_duration_s > 0.0
        history.ride += forecast.ride_id != before
        quality = msgspec.to_builtins(forecast.quality)
        self.quality[vehicle_id] = quality
        self._time = self._time.hear(self._values, row, forecast.time_s)
        car = self._values[row]
        for field in list_live_fields(Forecast):
            for name, value in zip(field.columns, _list_values(getattr(forecast, field.name)), strict=False):
                car[name] = value
        car["faults"], car["riding"] = sum(quality.values()), float(riding)
        history.add(forecast.time_s, (*(car[name] for name in POINT[:-1]), history.ride))

    def dump(self) -> BoardState:
        """Return the state, to which `load` can return as long as the board lives."""
        with self.lock:
            return BoardState(
                self.vehicle_ids.copy(),
                self._values[: len(self)].copy(),
                self.models.copy(),
                self.quality.copy(),
                self._ride_ids.copy(),
                [len(history) for history in self._histories],
                self.findings.copy(),
                len(self.rides),
                self._time,
            )

    def load(self, state: BoardState) -> None:
        """Return to an earlier state of this board."""
        with self.lock:
            self.vehicle_ids = state.vehicle_ids.copy()
            self._rows = {name: row for row, name in enumerate(self.vehicle_ids)}
            self._values = np.concatenate([state.values, make_unknown_cars(64)])
            self.models, self.quality = state.models.copy(), state.quality.copy()
            self._ride_ids, self.findings = state.ride_ids.copy(), state.findings.copy()
            self._time = state.time
            del self._histories[len(self) :], self.rides[state.rides :]
            for history, length in zip(self._histories, state.lengths, strict=True):
                history.truncate(length)
            self.epoch += 1


def _is_possible(value: Finding | Forecast | _Vehicle) -> bool:
    """Return whether numbers and names can be such; a stranger may send them of any size."""
    if isinstance(value, _Vehicle):
        return len(value.model) <= LONGEST_NAME
    if isinstance(value, Finding):
        return isfinite(value.probability)
    counts = msgspec.structs.astuple(value.quality)
    is_named = value.ride_id is None or len(value.ride_id) <= LONGEST_NAME
    return is_named and 0.0 <= value.time_s <= LATEST_S and all(0 <= count <= MOST_COUNT for count in counts)


def _list_values(value: Interval | float | None) -> tuple[float, ...]:
    """Return the values of the columns of a field: a number, or mean and percentiles; NaN where unknown."""
    if isinstance(value, Interval):
        return value.mean, value.p05, value.p95
    return (nan, nan, nan) if value is None else (value,)
