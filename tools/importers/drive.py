"""Convert a drive as a car recorded it to the messages that a logger on board would have sent."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import tzinfo
from operator import attrgetter
from typing import Final, NamedTuple

import msgspec
import numpy as np

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.wire.messages import Message, Plan, Ride, Telemetry, Vehicle, Weather, encode
from socast.tools.importers.resample import compute_window_means, find_valid_rows, make_grid

LONGEST_DRIVE: Final = SECONDS_PER_DAY
"""A file with a longer drive holds something else. [s]"""

AVERAGED: Final = ("speed_kmh", "hvac_w")
"""Fields sent as the mean over the period of a sample, so that sums over samples equal the sums over the rows.

Every other field is sent as it was at the time of the sample, or as the mean if it was not known at that time.
`make_samples` describes voltage and current.
"""

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
"""Decimal places of each field of a sample: finer than any of the sensors."""


class ReadOptions(NamedTuple):
    """Select what an importer reads from a file; every importer takes the same options.

    Parameters
    ----------
    zone : tzinfo
        Time zone of the clock in the file.
    vehicles : collection of int
        Numbers of the cars to read; empty reads all electric cars. Data sets of one car ignore it.
    """

    zone: tzinfo
    vehicles: Collection[int] = ()


class Drive(NamedTuple):
    """Hold one trip as recorded, with rows at the times at which the car wrote them.

    Parameters
    ----------
    vehicle_id, model, ride_id : str
        Names as in the wire contract; `model` is a key of the vehicle catalogue.
    start : float
        Unix time of the first row. [s]
    elapsed : (n,) float64
        Time of each row since the first, ascending. [s]
    rows : mapping of str to (n,) float64
        Values of each field of a telemetry sample, in the unit of the wire contract; NaN if unknown.
    notes : tuple of str
        What was repaired, for a person to read.
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
        """Unix time of the last row. [s]"""
        return self.start + float(self.elapsed[-1])


def sort_drives(drives: Iterable[Drive]) -> list[Drive]:
    """Sort drives by time and postpone those that would overlap.

    Notes
    -----
    A car makes one trip at a time. A trip that would begin before the previous one ends begins one second after that
    end instead. The data sets round start times, and the list of the BMW has two pairs that overlap.
    """
    free_from: dict[str, float] = {}
    ordered = []
    for drive in sorted(drives, key=lambda d: (d.start, d.vehicle_id, d.ride_id)):
        placed = _postpone(drive, max(0.0, free_from.get(drive.vehicle_id, drive.start) - drive.start))
        free_from[drive.vehicle_id] = placed.end + 1.0
        ordered.append(placed)
    return sorted(ordered, key=lambda d: (d.start, d.vehicle_id))


def make_samples(drive: Drive, period: float) -> list[Telemetry]:
    """Return the samples that a logger with the given period would have sent.

    Parameters
    ----------
    period : float
        Desired time between two samples; the nearest one that divides the drive is used. [s]

    Returns
    -------
    list of Telemetry
        Samples in order of time, none in gaps of the recording; `seq` counts on across gaps.

    Notes
    -----
    Speed and heating power are means over the period around the time of the sample. The same holds for the power of
    the battery: the voltage is its mean, and the current is the mean power divided by that voltage. So the product of
    both integrates to the energy of the drive.
    """
    offsets = make_grid(float(drive.elapsed[-1]), period)
    width = offsets[1] if len(offsets) > 1 else 0.0
    valid = find_valid_rows(drive.elapsed, offsets)
    logged = np.flatnonzero(valid >= 0)
    offsets, valid = offsets[logged], valid[logged]

    def mean(values: Floats) -> Floats:
        return compute_window_means(drive.elapsed, values, offsets, width)

    columns = {name: mean(v) if name in AVERAGED else _fill(v[valid], mean(v)) for name, v in drive.rows.items()}
    if "battery_voltage_v" in drive.rows:
        volts, amperes = drive.rows["battery_voltage_v"], drive.rows["battery_current_a"]
        both = np.where(np.isfinite(amperes), volts, np.nan)
        voltage, power = mean(both), mean(volts * amperes)
        columns["battery_voltage_v"] = voltage
        columns["battery_current_a"] = np.divide(power, voltage, out=np.full_like(power, np.nan), where=voltage > 0)
    stamps = np.round(drive.start + offsets, 3).tolist()
    wire = [_to_json_numbers(name, column) for name, column in columns.items()]
    return [
        Telemetry(drive.vehicle_id, stamp, drive.ride_id, seq, **dict(zip(columns, values, strict=True)))
        for stamp, seq, *values in zip(stamps, logged.tolist(), *wire, strict=True)
    ]


def make_messages(drives: Sequence[Drive], period: float) -> list[Message]:
    """Return the messages of drives, sorted by time.

    Units: period [s].

    Returns
    -------
    list of Message
        For each drive its weather, a `vehicle` message, the `start` of the ride, its samples and its `end`.
    """
    messages: list[Message] = []
    for drive in drives:
        telemetry = make_samples(drive, period)
        first, last = telemetry[0].time_s, telemetry[-1].time_s
        fleet = f"fleet/{drive.vehicle_id}"
        messages += [make_message(f"weather/{seen.station_id}", seen) for seen in drive.weather]
        messages.append(make_message(f"{fleet}/vehicle", Vehicle(drive.vehicle_id, first, drive.model)))
        messages.append(make_message(f"{fleet}/ride", Ride(drive.vehicle_id, first, drive.ride_id, "start")))
        messages += [make_message(f"{fleet}/telemetry", sample) for sample in telemetry]
        messages.append(make_message(f"{fleet}/ride", Ride(drive.vehicle_id, last, drive.ride_id, "end")))
    return sorted(messages, key=attrgetter("receipt_ns"))


def move_drive(drive: Drive, by: float) -> Drive:
    """Return a drive and its weather moved in time."""
    weather = tuple(msgspec.structs.replace(seen, time_s=seen.time_s + by) for seen in drive.weather)
    return drive._replace(start=drive.start + by, weather=weather)


def make_message(key: str, value: Telemetry | Vehicle | Ride | Plan | Weather) -> Message:
    """Return a message that is received at its own time stamp."""
    return Message(key, encode(value), round(value.time_s * 1000) * 1_000_000)


def _fill(instant: Floats, nearby: Floats) -> Floats:
    """Return the value at the moment, or the mean over the period of the sample if it is unknown."""
    return np.where(np.isfinite(instant), instant, nearby)


def _postpone(drive: Drive, by: float) -> Drive:
    """Return a drive that begins later, with a note; return it unchanged if the delay is zero."""
    if by == 0:
        return drive
    note = f"{drive.source}: ride {drive.ride_id} overlapped the ride before it, moved by {by:.0f} s"
    return move_drive(drive, by)._replace(notes=(*drive.notes, note))


def _to_json_numbers(name: str, column: Floats) -> list[float | None]:
    """Return a column as JSON holds it: rounded, None if unknown."""
    known = np.isfinite(column)
    rounded = np.round(np.where(known, column, 0.0), DECIMALS[name]) + 0.0  # no -0.0
    return [value if there else None for value, there in zip(rounded.tolist(), known.tolist(), strict=True)]
