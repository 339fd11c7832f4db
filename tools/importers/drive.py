"""Convert a drive as a car recorded it to the messages that a logger on board would have sent."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import tzinfo
from operator import attrgetter
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.columns import SECONDS_PER_DAY, PowerSpan
from socast.core.wire.messages import Message, Plan, Ride, Telemetry, Vehicle, Weather, encode

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
    "odometer_km": 4,
    "speed_kmh": 3,
    "soc_pct": 4,
    "battery_voltage_v": 3,
    "battery_current_a": 5,
    "battery_temperature_c": 2,
    "ambient_c": 2,
    "hvac_w": 1,
}
"""Decimal places of each field of a sample: finer than any of the sensors."""

LONGEST_HOLD = 30.0
"""A row is valid until the next one. If the next one is later than this, the time between is a gap. [s]"""


def make_grid(duration: float, period: float) -> Floats:
    """Return evenly spaced sample times from 0 to `duration`, both included.

    Units: duration [s], period [s].

    Returns
    -------
    (m,) float64
        Times of the samples. The spacing is the one nearest to `period` that divides `duration`, so that the samples
        cover the whole drive. [s]

    Examples
    --------
    >>> make_grid(10.0, 3.0).tolist()
    [0.0, 3.3333333333333335, 6.666666666666667, 10.0]
    >>> make_grid(0.0, 3.0).tolist()
    [0.0]
    """
    if duration <= 0:
        return np.zeros(1)
    return np.linspace(0.0, duration, max(1, round(duration / period)) + 1)


def find_valid_rows(times: Floats, at: Floats, longest_hold: float = LONGEST_HOLD) -> Ints:
    """Return for each moment the index of the row that is valid then, or -1 in a gap.

    Units: times [s], at [s], longest_hold [s].

    Examples
    --------
    >>> find_valid_rows(np.array([0.0, 1.0, 100.0]), np.array([0.5, 1.0, 50.0, 100.0])).tolist()
    [0, 1, -1, 2]
    """
    rows = np.searchsorted(times, at, side="right") - 1
    until_next = np.append(np.diff(times), 0.0)
    unknown = (rows < 0) | ((until_next[rows] > longest_hold) & (at > times[rows]))
    return np.where(unknown, -1, rows)


def compute_window_means(
    times: Floats, values: Floats, at: Floats, width: float, longest_hold: float = LONGEST_HOLD
) -> Floats:
    """Return the means of a quantity over windows centred on `at`; each row is valid until the next row.

    Units: times [s], at [s], width [s], longest_hold [s].

    Parameters
    ----------
    values : (n,) float64
        Value of each row, NaN if unknown.

    Returns
    -------
    (m,) float64
        Mean over the known part of each window, the value itself if the window has no width, NaN if nothing is known.

    Notes
    -----
    If `at` is spaced by `width` from the first row to the last, the trapezoid rule over the means equals the integral
    of the rows. Each inner mean covers its whole window; the first and the last cover the half that lies inside.

    Examples
    --------
    >>> means = compute_window_means(np.arange(4.0), np.array([2.0, 4.0, 4.0, 0.0]), np.array([0.0, 1.5, 3.0]), 1.5)
    >>> means.round(3).tolist()
    [2.0, 3.667, 4.0]
    """
    step = np.diff(times)
    held = np.where(np.isfinite(values[:-1]) & (step <= longest_hold), step, 0.0)
    integral = np.concatenate(([0.0], np.cumsum(np.where(held > 0, values[:-1], 0.0) * held)))
    known = np.concatenate(([0.0], np.cumsum(held)))
    low, high = at - width / 2, at + width / 2
    span = np.interp(high, times, known) - np.interp(low, times, known)
    total = np.interp(high, times, integral) - np.interp(low, times, integral)
    rows = find_valid_rows(times, at, longest_hold)
    instant = np.where(rows >= 0, values[rows], np.nan) if len(times) == 1 else np.full(len(at), np.nan)
    return np.divide(total, span, out=instant, where=span > 1e-9)


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
    wire = [to_json_numbers(name, column) for name, column in columns.items()]
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
        about = Vehicle(drive.vehicle_id, first, drive.model, power_covers=_find_power_span(drive, period))
        messages.append(make_message(f"{fleet}/vehicle", about))
        messages.append(make_message(f"{fleet}/ride", Ride(drive.vehicle_id, first, drive.ride_id, "start")))
        messages += [make_message(f"{fleet}/telemetry", sample) for sample in telemetry]
        messages.append(make_message(f"{fleet}/ride", Ride(drive.vehicle_id, last, drive.ride_id, "end")))
    return sorted(messages, key=attrgetter("receipt_ns"))


def _find_power_span(drive: Drive, period: float) -> PowerSpan | None:
    """Return that samples hold mean powers, where several rows with a power belong to each; else None."""
    if "battery_voltage_v" not in drive.rows:
        return None
    known = drive.elapsed[np.isfinite(drive.rows["battery_voltage_v"] * drive.rows["battery_current_a"])]
    return "around" if len(known) > 1 and float(np.median(np.diff(known))) <= period / 2.0 else None


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


def to_json_numbers(name: str, column: Floats) -> list[Any]:
    """Return a column as JSON holds it: rounded, whole numbers of occupants, and truth of charging; None if unknown."""
    known = np.isfinite(column)
    filled = np.where(known, column, 0.0)
    if name in {"charging", "occupants"}:
        known &= filled >= 0
        typed = (filled > 0).tolist() if name == "charging" else np.round(np.maximum(filled, 0)).astype("i8").tolist()
    else:
        typed = (np.round(filled, DECIMALS[name]) + 0.0).tolist()  # no -0.0
    if known.all():
        return list(typed)
    return [value if there else None for value, there in zip(typed, known.tolist(), strict=True)]
