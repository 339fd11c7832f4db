"""Turn sorted rows into the messages that loggers on board would have sent."""

from collections.abc import Callable, Mapping
from itertools import repeat
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import KMH, PowerSpan
from socast.core.vehicles import load_catalogue
from socast.core.vehicles.catalogue import OVERRIDES
from socast.core.vehicles.data_sheet import OF_SHEET
from socast.core.wire.messages import Message, Ride, Telemetry, Vehicle, Weather, encode
from socast.tools.importers.drive import make_message, to_json_numbers
from socast.tools.importers.table.column_map import ColumnMap
from socast.tools.importers.table.row_reader import RowReader
from socast.tools.importers.table.shared_stamps import number_in_stamp
from socast.tools.importers.table.units import OF_WEATHER, POWER, has_power

FEWEST: Final = 200
"""Rows of a driving car from which a power is judged."""
LONGEST_COMPARED: Final = 10.0
"""Longest time between two rows that are compared. [s]"""
REGULAR: Final = 0.2
"""Largest difference of the times to the rows before and after, over their mean. [1]"""
ONE_SIDED: Final = (0.8, 1.1)
"""Shares of the kinetic power beside a row that one side of it has, with which the power covers this side. [1]

63 drives of a Model 3 with means over a second (DOI 10.1016/j.patter.2024.100950) have 0.9 to 1.0; 31 drives of a BMW
i3 (DOI 10.21227/6jr9-5235) sampled every 1 or 3 s 0.4 to 0.6, and 0.9 to 1.0 as means over the time before."""
EXPLAINED: Final = 0.9
"""Least share of the variance of the power that speed and its changes explain. [1]

A meter that lags by half a step has the shares of a mean; with steps of 3 s it usually explains less."""
SLOWEST: Final = 1.0
"""Speed above which a car drives. [m/s]"""
BETWEEN: Final = 300.0
"""Time between two observations of a car, which hold the means over it; a longer gap begins anew. [s]"""
_HOUR: Final = 3600.0
_NAMES: Final = ("latitude_deg", "longitude_deg", "ambient_c", *OF_WEATHER)
DECIMALS: Final = 3
"""Decimal places of an observation."""
LONGEST_STEP: Final = 60.0
"""Longest time between two rows that says something of their period. [s]"""
OFF_GRID: Final = 0.25
"""Deviation of a time between two rows from whole periods from which it is irregular. [periods]"""
MOST_OFF_GRID: Final = 0.3
"""Largest share of irregular times of a log with a period. [1]"""
SAME: Final = 0.1
"""Ratio by which two successive times between rows may differ and be the same. [1]"""
MOST_CHANGED: Final = 0.05
"""Largest share of times between rows that equal the one before and are not the period, of a log with one period."""
LONGEST_PARKED: Final = 3600.0
"""Longest time between two rows of a parked car that shows another period. [s]"""
LONG: Final = 5.0
"""Times between rows that are not lost rows where several equal ones follow each other. [periods]"""
FEWEST_LONG: Final = 3
"""Number of such times of a log that changes its period."""
_FIELDS: Final = tuple(Telemetry.__struct_fields__[4:])  # after vehicle, time, ride and counter


class SpanEvidence(NamedTuple):
    """Hold what the rows say of a power.

    Parameters
    ----------
    share : float
        Share of the kinetic power beside a row that the one before it has in the power of the row. [1]
    explained : float
        Share of the variance of the power that speed and its changes explain. [1]
    """

    share: float
    explained: float

    @property
    def span(self) -> PowerSpan | None:
        """What the power covers, None where nothing shows that it is no moment."""
        if self.explained < EXPLAINED:
            return None
        least, most = ONE_SIDED
        return "before" if least <= self.share <= most else "after" if least <= 1.0 - self.share <= most else None


def measure_span(times: Floats, speed_kmh: Floats, power: Floats) -> SpanEvidence | None:
    """Return what rows of a car say of its power, None where too few of them do.

    Units: times [s], power [W].

    Notes
    -----
    Least squares of P_i = a K_i + b K_(i+1) + c v_i + d v_i^3 + e with K_i = (v_i^2 - v_(i-1)^2) / (2 (t_i - t_(i-1))).
    The share is a / (a + b).
    """
    speed, step = speed_kmh * KMH, np.diff(times)
    kinetic = np.divide(np.diff(speed**2), 2.0 * step, out=np.full(len(step), np.nan), where=step > 0.0)
    before, after, between = step[:-1], step[1:], speed[1:-1]
    columns = np.column_stack([kinetic[:-1], kinetic[1:], between, between**3, np.ones(len(between))])
    watts = power[1:-1]
    is_regular = (np.abs(after - before) <= REGULAR * 0.5 * (before + after)) & (before <= LONGEST_COMPARED)
    used = is_regular & np.isfinite(watts) & np.isfinite(columns).all(axis=1) & (between > SLOWEST)
    if used.sum() < FEWEST or np.ptp(watts[used]) == 0.0:
        return None
    factors, *_ = np.linalg.lstsq(columns[used], watts[used], rcond=None)
    if factors[0] + factors[1] <= 0.0:
        return None
    left = watts[used] - columns[used] @ factors
    return SpanEvidence(float(factors[0] / (factors[0] + factors[1])), float(1.0 - left.var() / watts[used].var()))


class RowWeather:
    """Make observations of the weather columns of rows, with the position of the car.

    Parameters
    ----------
    fields : collection of str
        Fields of the map.

    Attributes
    ----------
    is_sent : bool
        Whether the observations are sent.

    Notes
    -----
    The first observation of a car is its first row; each later one is the mean over the rows since the last, of the
    wind as a vector. Precipitation in rows is a rate, the amount of an hour, as weather services state it.
    """

    def __init__(self, fields: Mapping[str, object]) -> None:
        self.is_sent = True
        self._is_given = any(name in fields for name in OF_WEATHER)
        self._last: dict[int, float] = {}
        self._newest: dict[int, float] = {}
        self._places: dict[int, tuple[float, float]] = {}
        self._waiting: dict[int, list[dict[str, float]]] = {}

    def observe(self, rows: np.ndarray, vehicles: list[str]) -> dict[int, Message]:
        """Return the observations before rows, by the place of the row."""
        if not (self._is_given and self.is_sent):
            return {}
        names = [name for name in _NAMES if name in (rows.dtype.names or ())]
        known = np.logical_or.reduce([np.isfinite(rows[name]) for name in names if name in OF_WEATHER])
        made = {}
        for at in np.flatnonzero(known).tolist():
            row = {name: float(rows[name][at]) for name in names}
            if (message := self._take(int(rows["vehicle"][at]), float(rows["time"][at]), row, vehicles)) is not None:
                made[at] = message
        return made

    def _take(self, car: int, time: float, row: dict[str, float], vehicles: list[str]) -> Message | None:
        """Take a row, and return the observation that it completes."""
        place = row.get("latitude_deg", 0.0), row.get("longitude_deg", 0.0)
        if np.isfinite(place).all():
            self._places[car] = place
        waiting = self._waiting.setdefault(car, [])
        if time - self._newest.get(car, -np.inf) > BETWEEN:  # means over a gap would be those of another drive
            waiting.clear()
            self._last.pop(car, None)
        self._newest[car] = time
        waiting.append(row)
        since = time - self._last.get(car, -np.inf)
        if since < BETWEEN or car not in self._places:
            return None
        before, self._last[car] = self._last.get(car), time
        values = average_weather(waiting)
        waiting.clear()
        hours = 1.0 if before is None else (time - before) / _HOUR
        if (rate := values.get("precipitation_mm")) is not None:
            values["precipitation_mm"] = round(rate * hours, DECIMALS)
        station, stamp = vehicles[car], round(time, 3)
        return make_message(f"weather/{station}", Weather(station, stamp, *self._places[car], **values))


def average_weather(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the means of the known weather of rows, in the fields of an observation.

    Examples
    --------
    >>> average_weather([{"wind_speed_kmh": 10.0, "wind_from_deg": each} for each in (350.0, 10.0)])
    {'wind_speed_kmh': 9.848, 'wind_from_deg': 0.0}
    """
    columns = {name: np.array([row.get(name, np.nan) for row in rows]) for name in ("ambient_c", *OF_WEATHER)}
    means = {
        name.replace("ambient_c", "temperature_c"): float(np.mean(values[np.isfinite(values)]))
        for name, values in columns.items()
        if np.isfinite(values).any()
    }
    angle, speed = np.radians(columns["wind_from_deg"]), columns["wind_speed_kmh"]
    both = np.isfinite(angle) & np.isfinite(speed)
    if both.any():
        north, east = (float(np.mean((speed * turn(angle))[both])) for turn in (np.cos, np.sin))
        means["wind_speed_kmh"] = float(np.hypot(north, east))
        means["wind_from_deg"] = float(np.degrees(np.arctan2(east, north)) % 360.0)
    elif "wind_from_deg" in means:
        del means["wind_from_deg"]  # a direction without a speed says nothing
    rounded = {name: round(value, DECIMALS) + 0.0 for name, value in means.items()}
    return rounded | {name: rounded[name] % 360.0 for name in ("wind_from_deg",) if name in rounded}


class RowMessages:
    """Make the messages of rows, with a vehicle message before the first sample of each car.

    Parameters
    ----------
    reader : RowReader
        Reader of the rows, which holds the names.
    find_power_step : callable
        Returns the time between the rows of a car with a power, before they were joined to samples. [s]

    Attributes
    ----------
    notes : list of str
        What was found of the power of cars, for a person to read.
    """

    def __init__(self, columns: ColumnMap, reader: RowReader, find_power_step: Callable[[int], float]) -> None:
        self.map, self.reader, self._find_power_step = columns, reader, find_power_step
        self.notes: list[str] = []
        self.weather = RowWeather(columns.fields)
        self.samples = 0
        self._announced: set[int] = set()
        self._last: dict[int, float] = {}

    def make(self, rows: np.ndarray) -> list[Message]:
        """Return the messages of rows."""
        rides, before = self._name_rides(rows), self._find_gaps(rows)
        observed = self.weather.observe(rows, self.reader.vehicles)
        columns = _make_wire_columns(rows, self.map.vehicle.nominal_voltage)
        stamps = np.round(rows["time"], 3).tolist()
        wire = [columns.get(name, repeat(None)) for name in _FIELDS]
        names, messages = self.reader.vehicles, []
        for at, (place, stamp, last, ride, *values) in enumerate(
            zip(rows["vehicle"].tolist(), stamps, before, rides, *wire, strict=False)
        ):
            if at in observed:
                messages.append(observed[at])
            if place not in self._announced:
                self._announced.add(place)
                of_car = rows[rows["vehicle"] == place]
                messages += self._announce(place, stamp, of_car)
            vehicle, receipt = names[place], round(stamp * 1000) * 1_000_000
            if last is not None:
                messages += _divide_rides(vehicle, last, stamp, receipt)
            sample = Telemetry(vehicle, stamp, ride, None, *values)
            messages.append(Message(f"fleet/{vehicle}/telemetry", encode(sample), receipt))
        self.samples += len(rows)
        return messages

    def _find_power_span(self, place: int, rows: np.ndarray) -> PowerSpan | None:
        """Return what the power of a car's samples covers: as the map says, by joined rows, or as the rows show."""
        if self.map.power_covers is not None:
            return self.map.power_covers
        period = self.map.sampling.period if self.map.sampling else None
        if period is not None:
            return "around" if self._find_power_step(place) <= period / 2.0 else None
        if "speed_kmh" not in (rows.dtype.names or ()) or not has_power(rows.dtype.names or ()):
            return None
        evidence = measure_span(rows["time"], rows["speed_kmh"], compute_power(rows))
        if evidence is None or evidence.span is None:
            return None
        share = evidence.share if evidence.span == "before" else 1.0 - evidence.share
        self.notes.append(
            f"the power of {self.reader.vehicles[place]} is taken as the mean over the time {evidence.span} each row, "
            f"where {share:.0%} of its kinetic power is (limit: {ONE_SIDED[0]:.0%}); if it is that of the moment, "
            "write power_covers = 'moment' in [rows]"
        )
        return evidence.span

    def _announce(self, place: int, stamp: float, rows: np.ndarray) -> list[Message]:
        """Return the vehicle message of a car, if its model is known; a car of one's own brings its figures."""
        vehicle = self.reader.vehicles[place]
        model = self.map.vehicle.models.get(vehicle, self.map.vehicle.model)
        if not model:
            return []
        period = None if has_period(rows["time"]) else 0.0
        return [introduce_vehicle(vehicle, stamp, model, period, self._find_power_span(place, rows))]

    def _name_rides(self, rows: np.ndarray) -> list[str | None]:
        """Return the ride of each row."""
        names: list[str | None] = [*self.reader.rides, None]
        return [names[place] for place in rows["ride"].tolist()]

    def _find_gaps(self, rows: np.ndarray) -> list[float | None]:
        """Return for each row the time of the last row before it, where a gap of the map lies between, else None."""
        if self.map.ride.gap_s is None:
            return [None] * len(rows)
        found = np.full(len(rows), None, object)
        for vehicle in np.unique(rows["vehicle"]).tolist():
            at = np.flatnonzero(rows["vehicle"] == vehicle)
            times = rows["time"][at]
            before = np.append(self._last.get(vehicle, times[0]), times[:-1])
            is_gap = times - before > self.map.ride.gap_s
            found[at[is_gap]] = before[is_gap]
            self._last[vehicle] = float(times[-1])
        return list(found)


def _divide_rides(vehicle: str, last: float, stamp: float, receipt: int) -> list[Message]:
    """Return the end of the ride before a gap and the start of the next one.

    A ride that the samples named would last over stops and charging, which end rides without names.
    """
    events = (Ride(vehicle, last, vehicle, "end"), Ride(vehicle, stamp, vehicle, "start"))
    return [make_message(f"fleet/{vehicle}/ride", event)._replace(receipt_ns=receipt) for event in events]


def has_period(times: Floats) -> bool:
    """Return whether times are spaced by one period, some of them left out.

    Parameters
    ----------
    times : (n,) float
        Times of the rows of a car, ascending. [s]

    Examples
    --------
    >>> has_period(np.array([0.0, 1.1, 2.0, 2.9, 6.0, 7.0])), has_period(np.array([0.0, 1.0, 1.5, 9.0, 11.0, 20.0]))
    (True, False)

    A log of which parts have another period has none, although all times are multiples of the shortest one.

    >>> has_period(np.append(np.arange(0.0, 300.0, 15.0), np.arange(300.0, 1200.0, 60.0)))
    False
    """
    steps = np.diff(times)
    steps = steps[(steps > 0.0) & (steps <= LONGEST_PARKED)]
    if not len(steps):
        return True
    periods = steps / np.median(steps[steps <= LONGEST_STEP] if steps.min() <= LONGEST_STEP else steps)
    near = periods[steps <= LONGEST_STEP]
    off_grid = np.abs(near - np.maximum(np.round(near), 1.0)) > OFF_GRID
    again = (np.abs(periods[1:] - 1.0) > OFF_GRID) & (np.abs(np.diff(periods)) <= SAME * periods[1:])
    is_changed = again.sum() > MOST_CHANGED * len(steps) or (again & (periods[1:] > LONG)).sum() >= FEWEST_LONG
    return not is_changed and not (len(off_grid) and np.mean(off_grid) > MOST_OFF_GRID)


def introduce_vehicle(
    vehicle: str, time_s: float, model: str, period_s: float | None = None, power_covers: PowerSpan | None = None
) -> Message:
    """Return the vehicle message of a car, with its figures if they come from a data sheet."""
    known = load_catalogue().get(model)
    is_own = known is not None and known.sources.get("origin") == OF_SHEET
    figures = {name: getattr(known, name) for name in OVERRIDES} if is_own else {}
    about = Vehicle(vehicle, time_s, model, period_s=period_s, power_covers=power_covers, **figures)
    return make_message(f"fleet/{vehicle}/vehicle", about)


def join_signals(rows: np.ndarray, is_long: bool = True) -> np.ndarray:
    """Return rows of which those of one car and one time are joined into one.

    Parameters
    ----------
    is_long : bool
        Whether each row holds one signal. Of several values of a field, the largest then remains. Rows of any other
        table are joined only where they hold different fields, as two values of a field are two measurements.
    """
    if len(rows) < 2:
        return rows
    new = np.append(True, (np.diff(rows["time"]) > 0) | (np.diff(rows["vehicle"]) != 0))
    if not is_long and not new.all():
        places = number_in_stamp(rows, np.flatnonzero(new))
        order = np.lexsort((places, rows["vehicle"], rows["time"]))
        rows, places = rows[order], places[order]
        new |= np.append(True, np.diff(places) != 0)
    starts = np.flatnonzero(new)
    joined = rows[starts].copy()
    for name in rows.dtype.names or ():
        if name not in {"time", "vehicle"}:
            joined[name] = np.fmax.reduceat(rows[name], starts)
    return joined


def compute_power(rows: np.ndarray) -> Floats:
    """Return the power of the battery of rows, NaN where unknown. [W]"""
    names = rows.dtype.names or ()
    power = np.full(len(rows), np.nan)
    if "battery_voltage_v" in names and "battery_current_a" in names:
        power = rows["battery_voltage_v"] * rows["battery_current_a"]
    return np.where(np.isfinite(power), power, rows[POWER] * 1000.0) if POWER in names else power


def _make_wire_columns(rows: np.ndarray, nominal_voltage: float) -> dict[str, list[Any]]:
    """Return the columns of the fields as JSON holds them; a power becomes voltage and current."""
    columns = {name: rows[name] for name in rows.dtype.names or () if name in _FIELDS}
    if POWER in (rows.dtype.names or ()):
        power, unknown = rows[POWER] * 1000.0, np.full(len(rows), np.nan)
        voltage = columns.get("battery_voltage_v", unknown)
        current = columns.get("battery_current_a", unknown)
        lacking = np.isfinite(power) & ~np.isfinite(voltage * current)
        voltage = np.where(lacking & ~(voltage > 0), nominal_voltage, voltage)
        columns["battery_voltage_v"] = voltage
        columns["battery_current_a"] = np.where(lacking, power / voltage, current)
    return {name: to_json_numbers(name, values) for name, values in columns.items()}
