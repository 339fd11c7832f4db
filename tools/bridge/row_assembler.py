"""Assemble the signals of cars, which come one by one, to rows of telemetry.

A row holds what a car said within one period. It is complete when the car says something of a later time, or when the
period is over on the clock of the receiver. A source that sends a signal only when it changes says by its silence that
the signal is as before: a signal without news is held for a while, except those that change while a car drives.

The module knows no transport. Every value may carry a ticket, which the assembler returns with the row that holds the
value, so that the caller can acknowledge the value after the row was sent.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final, NamedTuple

from socast.core.wire.messages import IDENTITY, Message, Telemetry, encode
from socast.tools.importers.drive import DECIMALS
from socast.tools.importers.table.column_map import NOMINAL_VOLTAGE
from socast.tools.importers.table.presets import get_preset
from socast.tools.importers.table.row_messages import introduce_vehicle
from socast.tools.importers.table.sampling import find_holds
from socast.tools.importers.table.units import POWER, Conversion, find_conversion

FIX: Final = "fix"
"""Whether the receiver of positions has a fix; no field of a sample, but positions without one are left out."""
TRUE: Final = frozenset({"yes", "true", "on", "1"})
"""Words for true, in small letters."""
FALSE: Final = frozenset({"no", "false", "off", "0"})
"""Words for false, in small letters."""
FLAGS: Final = frozenset({"charging", FIX})
"""Fields that are true or false."""
LARGEST: Final = 1e12
"""Largest value of a signal; larger ones, infinity and NaN are no values."""
PERIOD_S: Final = 1.0
"""Default time that a row covers. [s]"""
HOLD_S: Final = 1500.0
"""Default time for which a signal without news is held: OVMS modules repeat all metrics after 1200 s. [s]"""
PREFER_S: Final = 600.0
"""Time for which the other sources of a field are ignored after its preferred one. [s]"""
FORGET_S: Final = 7 * 86400.0
"""Silence after which a car is forgotten. [s]"""
MOST_VEHICLES: Final = 100_000
"""Largest number of cars that are known at a time."""
EARLIEST_S: Final = 978_307_200.0
"""Earliest credible time of a car, 1 January 2001; clocks that were never set show earlier ones. [Unix s]"""
LATEST_S: Final = 4_102_444_800.0
"""Latest credible time of a car, 1 January 2100. [Unix s]"""
POSITION: Final = "latitude_deg", "longitude_deg"
"""Fields of which one that did not change is held beside news of the other."""
FAST: Final = "speed_kmh"
"""A field that changes fast."""


class Signal(NamedTuple):
    """Describe the source of a field.

    Parameters
    ----------
    conversion : Conversion
        From the unit and the sign of the source to those of the wire contract.
    rank : int
        A source with a lower rank is preferred where several give the same field.
    """

    field: str
    conversion: Conversion = Conversion(1.0)
    rank: int = 0


def make_signal(field: str, unit: str, *, sign: int = 1, rank: int = 0) -> Signal:
    """Return a signal whose unit and sign are converted to those of the wire contract."""
    if field in FLAGS:
        return Signal(field, rank=rank)
    conversion = find_conversion(unit, field)
    return Signal(field, Conversion(sign * conversion.factor, sign * conversion.offset), rank)


def read_signals(preset: str) -> dict[str, Signal]:
    """Return the signals of an ecosystem as the preset for its exports describes them, with slashes for dots.

    Examples
    --------
    >>> read_signals("ovms")["v/p/gpsspeed"]
    Signal(field='speed_kmh', conversion=Conversion(factor=1.0, offset=0.0), rank=1)
    """
    return {
        (place.column or "").replace(".", "/"): make_signal(field, place.unit or "", sign=place.sign or 1, rank=rank)
        for field, places in get_preset(preset).fields.items()
        for rank, place in enumerate(places)
    }


def parse_number(signal: Signal, value: object) -> float | None:
    """Return a value in the unit of the wire contract; None if it is not a value of the signal.

    Examples
    --------
    >>> parse_number(make_signal("battery_current_a", "A", sign=-1), "12.5")
    -12.5
    >>> parse_number(make_signal("charging", ""), "yes"), parse_number(make_signal("soc_pct", "%"), "nan")
    (1.0, None)
    """
    if isinstance(value, str):
        word = value.strip().lower()
        if signal.field in FLAGS:
            return 1.0 if word in TRUE else 0.0 if word in FALSE else None
        try:
            value = float(word)
        except ValueError:
            return None
    if isinstance(value, bool) != (signal.field in FLAGS) or not isinstance(value, int | float):
        return None
    try:
        number = float(value) * signal.conversion.factor + signal.conversion.offset
    except OverflowError:
        return None
    return number if abs(number) < LARGEST else None


Signals = Mapping[str, Signal]
"""Name of a signal in its ecosystem -> what it gives."""


class Value(NamedTuple):
    """Hold one value of one signal.

    Parameters
    ----------
    field : str
        Field of a sample, `socast.tools.importers.table.units.POWER` or `FIX`.
    value : float
        Value in the unit of the wire contract; 0 or 1 for a truth value.
    received_s : float
        Time of receipt. [Unix s]
    time_s : float, optional
        Time of the value by the sender's clock. [Unix s]
    rank : int
        Rank of the source among those of the field.
    """

    vehicle: str
    field: str
    value: float
    received_s: float
    time_s: float | None = None
    rank: int = 0
    ticket: Any = None


@dataclass(slots=True)
class _Row:
    """Hold an open row."""

    begin_s: float
    opened_s: float
    time_s: float
    values: dict[str, float] = field(default_factory=dict)
    tickets: list[Any] = field(default_factory=list)


@dataclass(slots=True)
class _Car:
    """Hold what is known of a car."""

    heard_s: float
    seq: int = 0
    clock: tuple[float, float, int] | None = None  # its time, when it came, and over which connection [s], [s]
    has_fix: bool = True
    row: _Row | None = None
    held: dict[str, tuple[float, float]] = field(default_factory=dict)
    sources: dict[str, tuple[int, float]] = field(default_factory=dict)
    tickets: list[Any] = field(default_factory=list)


class RowAssembler:
    """Assemble rows.

    Parameters
    ----------
    period_s : float
        Time that a row covers, which is the shortest time between two rows of a car. [s]
    hold_s : float
        Longest time for which a signal without news is held, if it changes fast; see
        `socast.tools.importers.table.sampling.find_holds`. [s]
    models : mapping of str to str
        Vehicle model by car; the key `*` is for all others. A car with a model is introduced by a vehicle message.
    nominal_voltage : float
        Voltage of a battery of which only the power is known. [V]

    Attributes
    ----------
    counts : Counter of str
        `rows`, `values`, `overwritten` (replaced by a newer value of the same row), `other_source` (another source of
        the field is preferred), `no_fix`, `bad_vehicle`, `bad_time` and `too_many_vehicles`.
    """

    def __init__(
        self,
        period_s: float = PERIOD_S,
        hold_s: float = HOLD_S,
        models: Mapping[str, str] | None = None,
        nominal_voltage: float = NOMINAL_VOLTAGE,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._period, self._holds, self._voltage = period_s, find_holds(hold_s), nominal_voltage
        self._models = models or {}
        self._cars: dict[str, _Car] = {}
        self._open: dict[str, _Car] = {}
        self._messages: list[Message] = []
        self._tickets: list[Any] = []
        self._connection = 0

    @property
    def vehicles(self) -> int:
        """Return the number of cars that are known."""
        return len(self._cars)

    def take(self, value: Value) -> None:
        """Take a value."""
        car = self._find(value.vehicle, value.received_s, value.ticket)
        if car is None or not self._accept(car, value):
            return
        time_s = value.time_s if value.time_s is not None else self._read_clock(car, value.received_s)
        if not EARLIEST_S <= time_s <= LATEST_S:
            self.drop("bad_time", value.ticket)
            return
        row = car.row
        if row is not None and abs(time_s - row.begin_s) >= self._period:
            self._close(value.vehicle, car)
            row = None
        if row is None:
            row = car.row = _Row(time_s, value.received_s, time_s, tickets=car.tickets)
            car.tickets = []
            self._open[value.vehicle] = car
        self.counts["values"] += 1
        self.counts["overwritten"] += value.field in row.values
        row.values[value.field] = value.value
        row.time_s = max(row.time_s, time_s)
        if value.ticket is not None:
            row.tickets.append(value.ticket)

    def set_clock(self, vehicle: str, time_s: float, received_s: float, ticket: Any = None) -> None:
        """Take the time of a car's own clock, which holds for the values around it."""
        car = self._find(vehicle, received_s, ticket)
        if car is None:
            return
        if not EARLIEST_S <= time_s <= LATEST_S:
            self.drop("bad_time", ticket)
            return
        row, is_first = car.row, car.clock is None
        car.clock = time_s, received_s, self._connection
        if row is not None and not is_first and abs(time_s - row.begin_s) >= self._period:
            self._close(vehicle, car)
            row = None
        if row is not None:
            row.begin_s, row.time_s = (time_s, time_s) if is_first else (row.begin_s, max(row.time_s, time_s))
        if ticket is not None:
            (row or car).tickets.append(ticket)

    def interrupt(self) -> None:
        """Note that the connection to the senders was lost, and what comes now may have been said long ago.

        The values of a car with a clock then belong to the last time that it gave, until it gives the next one.
        """
        self._connection += 1

    def disconnect(self, vehicle: str) -> None:
        """Forget the held signals of a car whose sender has gone."""
        if car := self._cars.get(vehicle):
            self._close(vehicle, car)
            car.held.clear()
            car.clock, car.has_fix = None, True

    def drop(self, cause: str, ticket: Any = None) -> None:
        """Count a value that gives no row, and return its ticket with the next rows."""
        self.counts[cause] += 1
        self._free(ticket)

    def close_due(self, now_s: float = inf) -> None:
        """Complete the rows whose period is over on the clock of the receiver."""
        for vehicle, car in [*self._open.items()]:
            if car.row is not None and not 0.0 <= now_s - car.row.opened_s < self._period:
                self._close(vehicle, car)

    def pop(self) -> tuple[list[Message], list[Any]]:
        """Return the messages of complete rows, and the tickets of all values that need no longer be kept."""
        messages, tickets = self._messages, self._tickets
        self._messages, self._tickets = [], []
        return messages, tickets

    def forget_silent(self, now_s: float) -> None:
        """Forget the cars that were silent for long, as seen at a time. [Unix s]"""
        silent = [name for name, car in self._cars.items() if now_s - car.heard_s > FORGET_S and car.row is None]
        for name in silent:
            self._tickets += self._cars.pop(name).tickets

    def _find(self, vehicle: str, received_s: float, ticket: Any) -> _Car | None:
        """Return a car, new ones included; None where its name is invalid or too many are known."""
        car = self._cars.get(vehicle)
        if car is not None:
            car.heard_s = received_s
            return car
        if not IDENTITY.fullmatch(vehicle):
            self.drop("bad_vehicle", ticket)
            return None
        if len(self._cars) >= MOST_VEHICLES:
            self.forget_silent(received_s)
        if len(self._cars) >= MOST_VEHICLES:
            self.drop("too_many_vehicles", ticket)
            return None
        return self._cars.setdefault(vehicle, _Car(received_s))

    def _accept(self, car: _Car, value: Value) -> bool:
        """Return whether a value goes into a row; drop it otherwise."""
        name, now = value.field, value.received_s
        if name == FIX:
            car.has_fix = value.value > 0
            self._free(value.ticket)
            return False
        if name in POSITION and not car.has_fix:
            self.drop("no_fix", value.ticket)
            return False
        rank, since = car.sources.get(name, (value.rank, now))
        if value.rank > rank and now - since < PREFER_S:
            self.drop("other_source", value.ticket)
            return False
        car.sources[name] = (value.rank, now)
        return True

    def _read_clock(self, car: _Car, received_s: float) -> float:
        """Return the time of a value that came without one: by the clock of the car, else by that of the receiver."""
        if car.clock is None:
            return received_s
        time_s, came_s, connection = car.clock
        return time_s + max(0.0, received_s - came_s) if connection == self._connection else time_s

    def _free(self, ticket: Any) -> None:
        if ticket is not None:
            self._tickets.append(ticket)

    def _close(self, vehicle: str, car: _Car) -> None:
        """Complete the open row of a car."""
        row, car.row = car.row, None
        self._open.pop(vehicle, None)
        if row is None:
            return
        if not car.seq and (model := self._models.get(vehicle, self._models.get("*"))):
            self._messages.append(introduce_vehicle(vehicle, round(row.time_s, 3), model, period_s=0.0))
        values = dict(self._fill(car, row))
        for name, number in row.values.items():
            car.held[name] = (number, row.time_s)
        sample = Telemetry(vehicle, round(row.time_s, 3), seq=car.seq, **self._to_wire(values))
        car.seq += 1
        self.counts["rows"] += 1
        self._messages.append(Message(f"fleet/{vehicle}/telemetry", encode(sample), 0))
        self._tickets += row.tickets

    def _fill(self, car: _Car, row: _Row) -> Iterator[tuple[str, float]]:
        """Yield the fields of a row, with those that are held."""
        yield from row.values.items()
        has_position = any(name in row.values for name in POSITION)
        for name, (number, time_s) in car.held.items():
            hold = self._holds[FAST if has_position and name in POSITION else name]
            if name not in row.values and 0.0 <= row.time_s - time_s <= hold and hold:
                yield name, number

    def _to_wire(self, values: dict[str, float]) -> dict[str, Any]:
        """Return fields as the struct of a sample takes them; a power becomes voltage and current."""
        power = values.pop(POWER, None)
        if power is not None and not {"battery_voltage_v", "battery_current_a"} <= values.keys():
            voltage = values.get("battery_voltage_v", 0.0)
            voltage = voltage if voltage > 0 else self._voltage
            values |= {"battery_voltage_v": voltage, "battery_current_a": 1000.0 * power / voltage}
        if not all(name in values for name in POSITION):
            for name in POSITION:
                values.pop(name, None)
        return {name: _round(name, number) for name, number in values.items()}


def _round(name: str, number: float) -> float | int | bool:
    """Return a number with the decimal places of its field."""
    if name in FLAGS:
        return number > 0
    if name == "occupants":
        return max(0, round(number))
    return round(number, DECIMALS[name]) + 0.0
