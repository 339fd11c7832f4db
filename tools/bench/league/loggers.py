"""Sample true drives as a logger does, write its samples as messages, and declare the faults that change them.

A fault of one kind of value needs a witness of another kind, or nothing could show it. `settle` gives the car one: an
odometer or fixes beside a wrong speed, a counter beside a clock that is set forward, a charge beside a wrong current.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.signal import lfilter

from socast.core.batch import Floats, Ints
from socast.core.columns import EARTH_RADIUS
from socast.core.wire.messages import Message
from socast.tools.bench.league.drives import Track, make_track

PERIODS: Final = (1.0, 2.0, 3.0, 5.0, 10.0, 15.0, 30.0, 60.0)
"""Times between samples. [s]"""
SHARES: Final = (0.16, 0.07, 0.45, 0.1, 0.08, 0.04, 0.05, 0.05)
"""Share of the loggers that has each."""
FIRST_DAY: Final = 1_717_200_000.0
"""1 June 2024. [Unix s]"""
LONELY: Final = 0.4
"""Share of the cars that drive on days of their own, when no other car sends. [1]"""
DAYS: Final = 120
"""Number of such days, two apart."""
PLACE: Final = (45.5, -73.6)
"""Where the roads of the league are. [deg]"""
FIELDS: Final = (
    *(("time_s", "%.3f"), ("seq", "%.0f"), ("latitude_deg", "%.6f"), ("longitude_deg", "%.6f")),
    *(("elevation_m", "%.1f"), ("speed_kmh", "%.2f"), ("odometer_km", "%.3f"), ("soc_pct", "%.1f")),
    *(("battery_voltage_v", "%.1f"), ("battery_current_a", "%.2f"), ("ambient_c", "%.1f")),
    *(("battery_temperature_c", "%.0f"), ("occupants", "%.0f"), ("charging", "%s")),
)
"""Fields of a sample with their formats, in the order of `Log.columns`."""
FIRST_LABEL: Final = 10
"""Battery temperature of the first drive [degC]; with the number of people, it names the drive of a sample."""
SENDS: Final = {
    "speed": ("speed_kmh",),
    "position": ("latitude_deg", "longitude_deg", "elevation_m"),
    "odometer": ("odometer_km",),
    "power": ("battery_voltage_v", "battery_current_a"),
    "soc": ("soc_pct",),
}
"""Fields of what a car may send."""
VALUES, SAMPLES, CLOCK, ORDER = range(4)
"""Stages in which faults act: on values, on which samples there are, on stamps, on the order of arrival."""
CAUSES: Final = {
    "clock": (
        *("gap", "clock", "time", "stamp", "counter", "sequence", "pause", "too_long", "too_short", "missing"),
        *("distance", "speed"),
    ),
    "speed": ("speed", "distance", "odometer", "bridge", "too_long"),
    "position": ("position", "fix", "distance", "speed", "slope", "bridge"),
    "odometer": ("odometer", "distance", "speed"),
    "current": ("current", "power", "energy", "meter", "contradictory"),
    "charge": ("soc", "charg", "energy", "capacity", "contradictory", "too_long"),
}
"""Words of the reasons that name each family of faults."""


@dataclass
class Car:
    """Hold what a logger is like, before any fault.

    Parameters
    ----------
    period, jitter : float
        Time between samples, and error of their stamps. [s]
    counts, names : bool
        Whether samples have a counter, and the name of the ride.
    sends : set of str
        Which of `speed`, `position`, `odometer`, `power`, `soc` it sends.
    quantum, odometer_step : float
        Step of the state of charge [%] and of the odometer [km].
    on_change : bool
        Whether the logger sends a sample when a value has changed.
    """

    name: str
    track: Track
    period: float
    jitter: float
    announces: bool
    counts: bool
    names: bool
    sends: set[str]
    quantum: float
    odometer_step: float = 0.1
    on_change: bool = False

    def describe(self) -> str:
        """Say what the logger sends."""
        period = "on change" if self.on_change else f"every {self.period:g} s"
        flags = (("announced", self.announces), ("counter", self.counts), ("ride names", self.names))
        parts = [period, *(name if flag else f"no {name}" for name, flag in flags), " ".join(sorted(self.sends))]
        return ", ".join([*parts, f"SOC in steps of {self.quantum:g} %", f"stays {' '.join(self.track.stays)}"])


@dataclass
class Log:
    """Hold the samples of a car, as columns in their order of arrival.

    Parameters
    ----------
    true : (n,) float
        When each sample was truly taken. [s]
    receipt : (n,) float
        When it was received. [s]
    columns : dict of str to (n,) float
        What it reports, by the field of the message; NaN for null.
    ride : (n,) int
        Number of the drive whose name it carries, -1 without one.
    drive : (n,) int
        Number of the drive in which it was taken, -1 between drives.
    """

    car: Car
    true: Floats
    receipt: Floats
    columns: dict[str, Floats]
    ride: Ints
    drive: Ints

    def __len__(self) -> int:
        return len(self.true)

    def take(self, rows: Any) -> None:
        """Keep some rows, in the order given."""
        self.true, self.receipt, self.ride, self.drive = (
            each[rows] for each in (self.true, self.receipt, self.ride, self.drive)
        )
        self.columns = {name: values[rows] for name, values in self.columns.items()}


def make_car(rng: np.random.Generator, number: int, drives: int, stays: tuple[str, ...]) -> Car:
    """Return a car with its logger, and what it truly did."""
    period = float(rng.choice(PERIODS, p=SHARES))
    sends = {"speed", "position", "odometer", "power", "soc"}
    for name, share in (("position", 0.08), ("odometer", 0.3), ("power", 0.2)):
        if rng.random() < share:
            sends.discard(name)
    start = FIRST_DAY + rng.uniform(0.0, 6 * 3600.0)
    if rng.random() < LONELY:
        start += (1 + number % DAYS) * 2 * 86400.0
    return Car(
        name=f"car-{number:05d}",
        track=make_track(rng, drives, start, stays),
        period=period,
        jitter=float(rng.choice((0.0, 0.02, 0.1))),
        announces=period > 5.0 or (period != 3.0 and rng.random() < 0.7),
        counts=bool(rng.random() < 0.75),
        names=bool(rng.random() < 0.3),
        sends=sends,
        quantum=float(rng.choice((0.1, 0.5, 1.0))),
    )


def sample(rng: np.random.Generator, car: Car) -> Log:
    """Return the samples of a car whose logger has no fault."""
    track, period = car.track, car.period
    times, counters = list[Floats](), list[Floats]()
    for begin, end in track.on:
        each = np.arange(begin + rng.uniform(0.0, min(period, 5.0)), end, period)
        times.append(each)
        counters.append(np.arange(len(each), dtype=float))
    true = np.concatenate(times)
    count = len(true)
    stamps = true + rng.normal(0.0, car.jitter, count)
    receipt = true + rng.uniform(0.2, 0.4, count)
    wander = _wander(rng, count, np.exp(-period / 40.0), 2.5)
    north, east = track.at("north", true) + wander[0], track.at("east", true) + wander[1]
    power, soc = track.at("power", true), track.at("soc", true)
    voltage = np.round(track.kind.volts * (0.9 + 0.15 * soc) - 0.08 * power / track.kind.volts, 1)
    charging = track.at("charging", true) > 0.5
    number, drive = _label(track, true)
    named = _find_named(track, true, rng) if car.names else np.full(count, -1)
    columns = {
        "time_s": stamps,
        "seq": np.concatenate(counters) if car.counts else np.full(count, np.nan),
        "latitude_deg": PLACE[0] + np.degrees(north / EARTH_RADIUS),
        "longitude_deg": PLACE[1] + np.degrees(east / EARTH_RADIUS / np.cos(np.radians(PLACE[0]))),
        "elevation_m": 60.0 + track.at("elevation", true) + _wander(rng, count, np.exp(-period / 60.0), 2.0)[0],
        "speed_kmh": np.round(track.at("speed", true) * 3.6, 1),
        "odometer_km": np.floor((20000.0 + 1e-3 * track.at("distance", true)) / car.odometer_step) * car.odometer_step,
        "soc_pct": np.floor(100.0 * soc / car.quantum + 0.5) * car.quantum,
        "battery_voltage_v": voltage,
        "battery_current_a": np.round(power / voltage, 1),
        "ambient_c": np.full(count, 12.0),
        "battery_temperature_c": (FIRST_LABEL + number).astype(float),
        "occupants": 1.0 + number,
        "charging": charging.astype(float),
    }
    log = Log(car, true, receipt, columns, named, drive)
    for part, fields in SENDS.items():
        if part not in car.sends:
            blank(log, fields)
    return log


def blank(log: Log, fields: tuple[str, ...], rows: Any = slice(None)) -> None:
    """Send null for some fields."""
    for name in fields:
        log.columns[name][rows] = np.nan


def _wander(rng: np.random.Generator, count: int, memory: float, spread: float) -> Floats:
    """Return two series of errors that forget slowly, (2, count)."""
    shocks = rng.normal(0.0, spread * np.sqrt(1.0 - memory * memory), (2, count))
    return np.asarray(lfilter([1.0], [1.0, -memory], shocks, axis=1))


def _label(track: Track, true: Floats) -> tuple[Ints, Ints]:
    """Return the number of the drive that each sample is nearest to, and of that in which it was taken, else -1."""
    begins, ends = np.array(track.drives).T
    halves = 0.5 * (ends[:-1] + begins[1:])
    number = np.searchsorted(halves, true)
    inside = (true >= begins[number]) & (true <= ends[number])
    return number, np.where(inside, number, -1)


def _find_named(track: Track, true: Floats, rng: np.random.Generator) -> Ints:
    """Return the number of the drive whose name each sample carries, -1 without one: a little longer than the drive."""
    named = np.full(len(true), -1)
    for number, (begin, end) in enumerate(track.drives):
        named[(true >= begin - rng.uniform(0.0, 8.0)) & (true <= end + rng.uniform(0.0, 20.0))] = number
    return named


def write_messages(log: Log) -> list[Message]:
    """Return the messages of a car, its vehicle message first."""
    car, name = log.car, log.car.name
    parts = [(field, form) for field, form in FIELDS if not np.isnan(log.columns[field]).all()]
    begin = f'{{"vehicle_id":"{name}",' + ",".join(f'"{field}":{form}' for field, form in parts)
    values = [_name_flags(log.columns[f]) if f == "charging" else log.columns[f].tolist() for f, _ in parts]
    text = "\n".join([begin % row for row in zip(*values, strict=True)]).replace("nan", "null")
    ends = {-1: "}"} | {number: f',"ride_id":"{name}.{number}"}}' for number in range(len(car.track.drives))}
    key, receipt_ns = f"fleet/{name}/telemetry", (log.receipt * 1e9).astype(np.int64).tolist()
    messages = [
        Message(key, (each + ends[ride]).encode(), when)
        for each, ride, when in zip(text.split("\n"), log.ride.tolist(), receipt_ns, strict=True)
    ]
    first = min(receipt_ns) - 1_000_000_000
    period = f',"period_s":{0.0 if car.on_change else car.period:g}' if car.announces else ""
    vehicle = f'{{"vehicle_id":"{name}","time_s":{first * 1e-9:.3f},"model":"{car.track.kind.name}"{period}}}'
    return [Message(f"fleet/{name}/vehicle", vehicle.encode(), first), *messages]


def _name_flags(values: Floats) -> list[str]:
    """Return flags as JSON."""
    return ["null" if value != value else "true" if value else "false" for value in values.tolist()]  # noqa: PLR0124


Apply = Callable[[Log, np.random.Generator], None]
Prepare = Callable[[Car, np.random.Generator], None]


class Fault(NamedTuple):
    """Describe a fault.

    Parameters
    ----------
    name, meaning, family : str
        Its name, what it does, and the key in `CAUSES` of the reasons for which a ride may be unfit.
    apply : callable
        Function that changes the samples of a car.
    spoils : tuple of str
        What it makes useless as a witness: `speed`, `position`, `odometer`, `power`, `soc`, `counter`, `stamp`. Two
        faults that spoil the same never act together.
    prepare : callable
        Function that makes the car one that can have the fault.
    """

    name: str
    meaning: str
    apply: Apply
    family: str
    stage: int
    spoils: tuple[str, ...]
    prepare: Prepare
    stays: tuple[str, ...]


FAULTS: Final[dict[str, Fault]] = {}
"""Every fault by its name."""


def keep(_: Log | Car, __: np.random.Generator) -> None:
    """Leave the samples of a car, or the car, as they are."""


def declare(
    name: str,
    meaning: str,
    apply: Apply,
    family: str,
    stage: int = VALUES,
    *spoils: str,
    prepare: Prepare = keep,
    stays: tuple[str, ...] = (),
) -> None:
    """Declare a fault."""
    FAULTS[name] = Fault(name, meaning, apply, family, stage, spoils, prepare, stays)


def fault(family: str, stage: int = VALUES, *spoils: str, **options: Any) -> Callable[[Apply], Apply]:
    """Declare a fault by a function that has its name and says what it does."""

    def register(apply: Apply) -> Apply:
        declare(apply.__name__, apply.__doc__ or "", apply, family, stage, *spoils, **options)
        return apply

    return register


def find_spoiled(faults: Sequence[Fault]) -> set[str]:
    """Return what faults make useless as a witness."""
    return {part for each in faults for part in each.spoils}


def are_compatible(one: Fault, other: Fault) -> bool:
    """Return whether two faults can act together: they spoil different things, and leave a witness of the motion."""
    takes = find_spoiled((one, other))
    blind = takes >= {"speed", "odometer", "position"}
    stays = not (one.stays and other.stays) or one.stays == other.stays
    return len(takes) == len(one.spoils) + len(other.spoils) and not blind and stays


def settle(car: Car, faults: Sequence[Fault], rng: np.random.Generator) -> None:
    """Prepare a car for its faults, and give it the witnesses by which they can be noticed."""
    for each in faults:
        each.prepare(car, rng)
    spoiled = find_spoiled(faults)
    motion = [part for part in ("odometer", "position") if part not in spoiled]
    is_blind = "speed" in spoiled or "speed" not in car.sends
    if is_blind and not any(part in car.sends for part in motion):
        car.sends.add(str(rng.choice(motion)))
    if "power" in spoiled:
        car.sends.update(("power", "soc"))
    if any(each.family == "position" and "absent" not in each.name for each in faults):
        car.sends.add("position")


def find_drives(log: Log) -> Iterator[Ints]:
    """Yield the rows of each drive."""
    for number in range(len(log.car.track.drives)):
        rows = np.flatnonzero(log.drive == number)
        if len(rows) > 3:
            yield rows


def pick_block(log: Log, rows: Ints, rng: np.random.Generator, least: float, most: float) -> Ints:
    """Return the rows of some seconds within a drive."""
    true = log.true[rows]
    duration = min(rng.uniform(least, most), 0.6 * (true[-1] - true[0]))
    begin = rng.uniform(true[0] + 10.0, max(true[0] + 11.0, true[-1] - duration))
    block = rows[(true >= begin) & (true <= begin + duration)]
    return block if len(block) else rows[len(rows) // 2 : len(rows) // 2 + 1]
