"""From a drive as a car recorded it to the messages that a logger aboard would have sent."""

from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from typing import Final, NamedTuple

import msgspec
import numpy as np

from core.batch import Floats
from core.wire.messages import Message, Plan, Ride, Telemetry, Vehicle, Weather, encode
from tools.importers.resample import grid, held_means, held_rows

LONGEST_DRIVE: Final = 86_400.0
"""No drive lasts longer; a file that says so holds something else. [s]"""

MEANS: Final = ("speed_kmh", "hvac_w")
"""What is sent as the mean over a sample's period, so that sums over samples are the sums over the rows.
Everything else is sent as it stood at the sample's time, or as a mean where it was not known just then; for voltage and
current see `samples`."""

DECIMALS: Final = {
    "latitude_deg": 7,
    "longitude_deg": 7,
    "elevation_m": 2,
    "speed_kmh": 3,
    "soc_pct": 4,
    "battery_voltage_v": 3,
    "battery_current_a": 5,
    "battery_temperature_c": 2,
    "ambient_c": 2,
    "hvac_w": 1,
}
"""Digits kept behind the point of each field of a sample: finer than any of the sensors."""


class Drive(NamedTuple):
    """One trip as recorded, at the car's own pace.

    Parameters
    ----------
    vehicle_id, model, ride_id : str
        As the wire contract has them; `model` is a key of the vehicle catalogue.
    start : float. Unix time of the first row. [s]
    elapsed : (n,) float64. When each row was written, since the first, ascending. [s]
    rows : mapping of str to (n,) float64
        Field of a telemetry sample -> its values in the wire's unit; NaN where unknown.
    source : str. The file's name.
    weather : tuple of Weather. Observations that came with it.
    notes : tuple of str. What had to be mended, for a person to read.
    """

    vehicle_id: str
    model: str
    ride_id: str
    start: float
    elapsed: Floats
    rows: Mapping[str, Floats]
    source: str
    weather: tuple[Weather, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def end(self) -> float:
        """Unix time of the last row [s]."""
        return self.start + float(self.elapsed[-1])


def in_order(drives: Iterable[Drive]) -> list[Drive]:
    """Sort drives by time and move those that would overlap.

    A car makes one trip at a time. Where a trip would begin before the end of the one before it (the data sets round
    start times, and the BMW's list has two pairs that collide), it is moved to a second after that end.

    Returns
    -------
    list of Drive
        By start; a moved drive has a note that says so.
    """
    free_from: dict[str, float] = {}
    ordered = []
    for drive in sorted(drives, key=lambda d: (d.start, d.vehicle_id, d.ride_id)):
        placed = _after(drive, max(0.0, free_from.get(drive.vehicle_id, drive.start) - drive.start))
        free_from[drive.vehicle_id] = placed.end + 1.0
        ordered.append(placed)
    return sorted(ordered, key=lambda d: (d.start, d.vehicle_id))


def samples(drive: Drive, period: float) -> list[Telemetry]:
    """Return what a logger with the given period would have sent.

    Speed and heating power are means over the period around the sample's time. So is the power of the battery:
    voltage is its mean and current the mean power over it, so that their product integrates to the drive's energy.

    Parameters
    ----------
    drive : Drive
    period : float. Time between two samples; the one nearest to it is taken that divides the drive. [s]

    Returns
    -------
    list of Telemetry
        None for the time of gaps in the recording; `seq` counts on across them.
    """
    offsets = grid(float(drive.elapsed[-1]), period)
    width = offsets[1] if len(offsets) > 1 else 0.0
    held = held_rows(drive.elapsed, offsets)
    logged = np.flatnonzero(held >= 0)
    offsets, held = offsets[logged], held[logged]

    def mean(values: Floats) -> Floats:
        return held_means(drive.elapsed, values, offsets, width)

    columns = {name: mean(v) if name in MEANS else _or(v[held], mean(v)) for name, v in drive.rows.items()}
    if "battery_voltage_v" in drive.rows:
        volts, amperes = drive.rows["battery_voltage_v"], drive.rows["battery_current_a"]
        both = np.where(np.isfinite(amperes), volts, np.nan)
        voltage, power = mean(both), mean(volts * amperes)
        columns["battery_voltage_v"] = voltage
        columns["battery_current_a"] = np.divide(power, voltage, out=np.full_like(power, np.nan), where=voltage > 0)
    stamps = np.round(drive.start + offsets, 3).tolist()
    wire = [_numbers(name, column) for name, column in columns.items()]
    return [
        Telemetry(drive.vehicle_id, stamp, drive.ride_id, seq, **dict(zip(columns, values, strict=True)))
        for stamp, seq, *values in zip(stamps, logged.tolist(), *wire, strict=True)
    ]


def messages(drives: Sequence[Drive], period: float) -> list[Message]:
    """Return the recording of drives that are in order, sorted by time.

    Each drive is its weather, a `vehicle` message, the ride's `start`, its samples and its `end`.

    Parameters
    ----------
    drives : sequence of Drive
    period : float. Time between two samples. [s]
    """
    out: list[Message] = []
    for drive in drives:
        telemetry = samples(drive, period)
        first, last = telemetry[0].time_s, telemetry[-1].time_s
        fleet = f"fleet/{drive.vehicle_id}"
        out += [message(f"weather/{seen.station_id}", seen) for seen in drive.weather]
        out.append(message(f"{fleet}/vehicle", Vehicle(drive.vehicle_id, first, drive.model)))
        out.append(message(f"{fleet}/ride", Ride(drive.vehicle_id, first, drive.ride_id, "start")))
        out += [message(f"{fleet}/telemetry", sample) for sample in telemetry]
        out.append(message(f"{fleet}/ride", Ride(drive.vehicle_id, last, drive.ride_id, "end")))
    return sorted(out, key=attrgetter("receipt_ns"))


def moved(drive: Drive, by: float) -> Drive:
    """Return a drive, and the weather that came with it, later by some seconds."""
    weather = tuple(msgspec.structs.replace(seen, time_s=seen.time_s + by) for seen in drive.weather)
    return drive._replace(start=drive.start + by, weather=weather)


def message(key: str, value: Telemetry | Vehicle | Ride | Plan | Weather) -> Message:
    """Return a message received at the moment that it speaks of."""
    return Message(key, encode(value), round(value.time_s * 1000) * 1_000_000)


def _or(instant: Floats, nearby: Floats) -> Floats:
    """Return what was known at the moment, or else within the sample's period."""
    return np.where(np.isfinite(instant), instant, nearby)


def _after(drive: Drive, by: float) -> Drive:
    """Return a drive that begins later, with a note, or as it is where it need not."""
    if by == 0:
        return drive
    note = f"{drive.source}: ride {drive.ride_id} overlapped the one before it, moved by {by:.0f} s"
    return moved(drive, by)._replace(notes=(*drive.notes, note))


def _numbers(name: str, column: Floats) -> list[float | None]:
    """Return a column as JSON has it: rounded, None where unknown."""
    known = np.isfinite(column)
    rounded = np.round(np.where(known, column, 0.0), DECIMALS[name]) + 0.0  # no -0.0
    return [value if there else None for value, there in zip(rounded.tolist(), known.tolist(), strict=True)]
