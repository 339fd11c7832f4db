"""Simulate a faulty data logger: sample the car every few seconds, add faults at given rates, and count them."""

from collections import Counter
from itertools import repeat
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.columns import KMH
from socast.core.wire.messages import Message, Telemetry
from socast.tools.simulator.cars import Car
from socast.tools.simulator.physics import State
from socast.tools.simulator.settings import PERIOD, STEP, Faults
from socast.tools.simulator.shift import NO_RIDE, Shift
from socast.tools.simulator.trace import Trace
from socast.tools.simulator.weather import draw_autoregressive
from socast.tools.simulator.world import to_wgs84

FIELDS: Final = Telemetry.__struct_fields__
LACK_PROBABILITY: Final = {
    "wheel_speed": 0.45,
    "battery_voltage_v": 0.25,
    "ambient_c": 0.30,
    "ride_id": 0.15,
    "odometer_km": 0.30,
    "occupants": 0.50,
    "hvac_w": 0.90,
    "battery_temperature_c": 0.40,
    "elevation_m": 0.10,
    "seq": 0.15,
}
"""Probability that a car that is not fully equipped lacks each item. [1]"""
SPIKES: Final = {
    "speed_kmh": 655.35,
    "soc_pct": 127.5,
    "ambient_c": -273.1,
    "battery_voltage_v": 6553.5,
    "battery_current_a": -3276.8,
    "elevation_m": -32768.0,
    "latitude_deg": 214.748365,
}
"""Value of each field when its sensor fails: the limits of the integers that transport it."""

DIGITS: Final = {
    "time_s": 3,
    "latitude_deg": 6,
    "longitude_deg": 6,
    "odometer_km": 2,
    "soc_pct": 3,
    "battery_voltage_v": 2,
    "battery_current_a": 2,
    "hvac_w": 0,
}
"""Decimal places that are sent for each field; all other fields have one."""

TICK: Final = 1.0
"""Time between two looks of a logger that sends a sample only when a value has changed. [s]"""
LONGEST_SILENCE: Final = 60.0
"""Time after which such a logger sends a sample although nothing has changed. [s]"""
DEADBANDS: Final = {"speed_kmh": 2.0, "battery_current_a": 5.0, "soc_pct": 0.5, "ambient_c": 1.0, "hvac_w": 300.0}
"""Change of each field from which such a logger sends a sample, in the unit of the field; also a change of the ride."""

REPEATED_AFTER_NS: Final = 300_000_000
"""Time after which a sample that is sent twice comes again. [ns]"""

Columns = dict[str, Any]
_encode: Final = msgspec.json.Encoder().encode


class Equipment(NamedTuple):
    """Hold what the logger of a car lacks, and how often it samples.

    Parameters
    ----------
    lacks : tuple of str
        Names of fields; `wheel_speed` if the logger reports the speed of GPS instead.
    period : float
        Time between two samples; 0 for a logger that sends a sample only when a value has changed. [s]
    """

    lacks: tuple[str, ...]
    period: float = PERIOD


def make_equipment(faults: Faults, rng: np.random.Generator) -> Equipment:
    """Draw what the logger of a car lacks."""
    plain, draws = rng.uniform() < faults.unequipped, rng.uniform(size=len(LACK_PROBABILITY))
    lacks = [name for (name, rate), draw in zip(LACK_PROBABILITY.items(), draws, strict=True) if plain and draw < rate]
    if "battery_voltage_v" in lacks:
        lacks.append("battery_current_a")
    return Equipment(tuple(lacks))


def log_shift(
    name: str,
    shift: Shift,
    trace: Trace,
    state: State,
    car: Car,
    equipment: Equipment,
    faults: Faults,
    rng: np.random.Generator,
    shown: Floats | None = None,
) -> tuple[list[Message], Counter[str]]:
    """Return the telemetry of a shift and the number of faults of each kind.

    Parameters
    ----------
    shown : (n,) float, optional
        What the display of the state of charge shows, NaN for nothing; None shows the true one. [%]
    """
    counts: Counter[str] = Counter()
    steps = round((equipment.period or TICK) / STEP)
    at = np.arange(steps - 1, len(trace.time), steps)
    columns = _measure(shift, trace, state, car, faults, rng, at, shown)
    _freeze_fixes(columns, trace, equipment, faults, rng, at, counts)
    if not equipment.period:
        columns = _select_changed(columns)
    kept = _drop(columns, faults, rng, counts)
    columns = {field: column[kept] for field, column in columns.items()}
    time = columns["time_s"]
    lists = _tabulate(name, columns | {"time_s": _wrong_clock(time, faults, rng, counts)}, equipment, shift)
    _spoil(lists, equipment, faults, rng, counts)
    counts["samples_sent"] += len(time)
    payloads = list(map(_encode, map(Telemetry, *lists.values())))
    return _send(f"fleet/{name}/telemetry", payloads, time, faults, rng, counts), counts


def _measure(
    shift: Shift,
    trace: Trace,
    state: State,
    car: Car,
    faults: Faults,
    rng: np.random.Generator,
    at: Ints,
    shown: Floats | None,
) -> Columns:
    """Return the samples of a logger at some steps, without dropouts, with noise and quantisation."""
    noise = [draw_autoregressive(rng, len(at), keep) for keep in (0.9, 0.9, 0.5)]
    latitude, longitude = to_wgs84(trace.x[at] + faults.gps_noise * noise[0], trace.y[at] + faults.gps_noise * noise[1])
    speed, soc = shift.timeline.after[at], np.clip(100 * state.soc[at], 0, 100) if shown is None else shown[at]
    if faults.quantised > 0:
        soc = np.floor(soc / car.soc_step) * car.soc_step
    driven = car.odometer + np.cumsum(shift.timeline.moved)[at] * car.speedometer
    return {
        "time_s": trace.time[at],
        "ride_id": shift.timeline.ride[at],
        "seq": np.arange(len(at)),
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "elevation_m": trace.elevation[at] + faults.elevation_noise * noise[2],
        "speed_kmh": speed * car.speedometer / KMH,
        "gps_speed": np.maximum(speed + 0.08 * faults.gps_noise * rng.normal(size=len(at)) * (speed > 0), 0) / KMH,
        "odometer_km": driven / 1000,
        "soc_pct": soc,
        "battery_voltage_v": state.voltage[at],
        "battery_current_a": state.current[at],
        "battery_temperature_c": state.pack[at],
        "ambient_c": trace.ambient[at],
        "hvac_w": state.hvac[at],
        "occupants": trace.occupants[at].astype(int),
        "charging": trace.plugged[at] > 0,
    }


def _freeze_fixes(
    columns: Columns,
    trace: Trace,
    equipment: Equipment,
    faults: Faults,
    rng: np.random.Generator,
    at: Ints,
    counts: Counter[str],
) -> None:
    """Freeze positions in tunnels, so that they jump at the exit."""
    inside = trace.tunnel[at] > 0
    edges = np.flatnonzero(np.diff(inside.astype(int), prepend=0, append=0))
    for enter, leave in zip(edges[0::2], edges[1::2], strict=True):
        if enter == 0 or leave >= len(inside) or rng.uniform() >= faults.tunnel:
            continue
        counts["tunnel"] += 1
        for field in ("latitude_deg", "longitude_deg", "elevation_m"):
            columns[field][enter:leave] = columns[field][enter - 1]
        last, first = at[enter - 1], at[leave]
        chord = np.hypot(trace.x[first] - trace.x[last], trace.y[first] - trace.y[last])
        columns["gps_speed"][enter:leave] = 0.0
        columns["gps_speed"][leave] = chord / (equipment.period or TICK) / KMH
    gps_speed = columns.pop("gps_speed")
    if "wheel_speed" in equipment.lacks:
        columns["speed_kmh"] = gps_speed


def _select_changed(columns: Columns) -> Columns:
    """Return the samples that a logger sends which samples on change, with their own counter."""
    watched = [(columns[field], least) for field, least in DEADBANDS.items()]
    time, ride = columns["time_s"], columns["ride_id"]
    sent = [0]
    for i in range(1, len(time)):
        last = sent[-1]
        changed = ride[i] != ride[last] or any(abs(values[i] - values[last]) >= least for values, least in watched)
        if changed or time[i] - time[last] >= LONGEST_SILENCE:
            sent.append(i)
    return {field: column[sent] for field, column in columns.items()} | {"seq": np.arange(len(sent))}


def _wrong_clock(time: Floats, faults: Faults, rng: np.random.Generator, counts: Counter[str]) -> Floats:
    """Return the time stamps of a clock that steps, jitters and sometimes repeats a stamp. [s]"""
    n = len(time)
    steps = np.flatnonzero(rng.uniform(size=n) < faults.clock_step)
    sizes = rng.uniform(5.0, 120.0, n) * rng.choice([-1.0, 1.0], n)
    stamp, offset = time.copy(), 0.0
    for first in steps:
        offset = float(sizes[first]) if offset == 0 else 0.0
        stamp[first:] = time[first:] + offset
    jittered = rng.uniform(size=n) < faults.jitter
    stamp += np.where(jittered, rng.uniform(-0.9, 0.9, n), 0.0)
    repeated = np.flatnonzero(rng.uniform(size=n - 1) < faults.repeated) + 1
    for i in repeated:
        stamp[i] = stamp[i - 1]
    counts.update(clock_step=len(steps), jitter=int(jittered.sum()), repeated=len(repeated))
    return stamp


def _drop(columns: Columns, faults: Faults, rng: np.random.Generator, counts: Counter[str]) -> np.ndarray:
    """Return a mask of the samples that are sent; restart the counter after a power cycle. (n,) bool"""
    n = len(columns["seq"])
    kept = np.ones(n, bool)
    draws, longer, shorter = rng.uniform(size=(2, n)), rng.integers(2, 41, n), rng.integers(5, 21, n)
    for begin in np.flatnonzero(draws[0] < faults.gap):
        kept[begin : begin + longer[begin]] = False
        counts["gap"] += 1
    for begin in np.flatnonzero(draws[1] < faults.power_cycle):
        resumed = begin + shorter[begin]
        kept[begin:resumed] = False
        columns["seq"][resumed:] = np.arange(max(0, n - resumed))
        counts["power_cycle"] += 1
    counts["samples_lost"] += int(n - kept.sum())
    return kept


def _tabulate(name: str, columns: Columns, equipment: Equipment, shift: Shift) -> dict[str, list[Any]]:
    """Return the values of each field in the order of the wire contract, rounded as loggers do."""
    n = len(columns["seq"])
    rides: list[Any] = [trip.ride_id for trip in shift.trips] + [None]  # NO_RIDE is the last
    lists: dict[str, list[Any]] = {}
    for field in FIELDS:
        if field == "vehicle_id":
            lists[field] = [name] * n
        elif field in equipment.lacks:
            lists[field] = [None] * n
        elif field == "ride_id":
            lists[field] = [rides[ride if ride != NO_RIDE else -1] for ride in columns[field].tolist()]
        elif columns[field].dtype == float:
            lists[field] = columns[field].round(DIGITS.get(field, 1)).tolist()
        else:
            lists[field] = columns[field].tolist()
    return lists


def _spoil(
    lists: dict[str, list[Any]], equipment: Equipment, faults: Faults, rng: np.random.Generator, counts: Counter[str]
) -> None:
    """Remove values from samples, move positions to 0/0, and put values out of range."""
    draws = rng.uniform(size=(3, len(lists["time_s"])))
    present = [field for field in FIELDS[3:] if field not in equipment.lacks]
    able = [field for field in SPIKES if field not in equipment.lacks]
    for i in np.flatnonzero(draws[0] < faults.missing).tolist():
        lists[present[int(rng.integers(len(present)))]][i] = None
        counts["missing"] += 1
    for i in np.flatnonzero(draws[1] < faults.null_island).tolist():
        for field in ("latitude_deg", "longitude_deg"):
            lists[field][i] = 0.0
        counts["null_island"] += 1
    for i in np.flatnonzero(draws[2] < faults.spike).tolist():
        field = able[int(rng.integers(len(able)))]
        lists[field][i] = SPIKES[field]
        counts["spike"] += 1


def _send(
    key: str, payloads: list[bytes], time: Floats, faults: Faults, rng: np.random.Generator, counts: Counter[str]
) -> list[Message]:
    """Return the messages in order of receipt: some late, overtaken, duplicated or undecodable."""
    n = len(payloads)
    draws, delay = rng.uniform(size=(4, n)), rng.uniform(size=n)
    late, overtaken, twice, broken = (
        draws[k] < rate
        for k, rate in enumerate((faults.late, faults.out_of_order, faults.duplicate, faults.undecodable))
    )
    receipt = time + 0.1 + 0.3 * delay + np.where(late, 10 + 80 * delay, np.where(overtaken, 3.4 + 3 * delay, 0.0))
    for i in np.flatnonzero(broken):
        payloads[i] = _broken(payloads[i], rng)
    receipt_ns = np.round(receipt * 1e9).astype(np.int64)
    again = np.flatnonzero(twice)
    which, received = np.append(np.arange(n), again), np.append(receipt_ns, receipt_ns[again] + REPEATED_AFTER_NS)
    order = np.argsort(received, kind="stable")
    counts.update(
        late=int(late.sum()),
        out_of_order=int((overtaken & ~late).sum()),
        duplicate=int(twice.sum()),
        undecodable=int(broken.sum()),
    )
    sent = [payloads[i] for i in which[order].tolist()]
    return list(map(Message, repeat(key), sent, received[order].tolist()))


def _broken(payload: bytes, rng: np.random.Generator) -> bytes:
    """Return a payload that no decoder of the contract accepts: cut, garbled, or with text for its time."""
    kind = int(rng.integers(3))
    if kind == 0:
        return payload[: int(rng.integers(1, len(payload) - 1))]
    if kind == 1:
        return bytes(rng.integers(128, 256, 40, dtype=np.uint8))
    return payload.replace(b'"time_s":', b'"time_s":"soon","was":', 1)
