"""Make the ride and window tables of each data set from the drives, in at most about a second.

The steps are those of `socast.core.pipeline` with `two_sided`. What a hidden effect cannot change is computed once: the
decoded rows, their weather, their smoothed elevation, and the energies of nearly all effects. The rest is computed for
each data set with the functions of the product: cleaning, the measured energy, the effects that depend on the state of
charge, totals and tables.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Final, Literal, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.batch import Batch, Floats, Ints, Lanes
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.elevation_smoother import smooth_elevation
from socast.core.cleaning.kernel import Cleaner
from socast.core.columns import JOULES_PER_KWH
from socast.core.effects import Effect
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.settings import Settings
from socast.core.signals.signals import Signals, flag_ambient
from socast.core.signals.weather import Sky, Stations
from socast.core.totals.accumulator import AMOUNTS, Accumulator, Sums, Totals, join_totals
from socast.core.totals.clean_rows import CleanRows, compute_amounts
from socast.core.totals.context import RunContext
from socast.core.totals.display_yield import DisplayYields
from socast.core.totals.sample_totals import BLOCK
from socast.core.totals.tables import tabulate_rides, tabulate_windows
from socast.core.vehicles.fleet import Cars
from socast.core.wire.decoder import Decoder
from socast.core.wire.message_order import VehicleChange
from socast.core.wire.messages import Message, Ride, Vehicle, Weather, encode
from socast.core.wire.rides import RideDrivers, RideNames
from socast.tools.bench.hidden.drives import (
    CURRENT_MARK,
    SOC_MARK,
    VOLTAGE_MARK,
    Drives,
    Readings,
)
from socast.tools.simulator.logger import DIGITS

Measurement = Literal["vi", "soc"]
SOC_STEP: Final = 0.5
"""Step of the reported state of charge. [%]"""
ROOM: Final = 2
"""Largest number of simultaneous hidden effects."""
READS_SOC: Final = "charge"
"""The only signal that depends on the state of charge."""
MOST: Final = 100_000
"""Largest number of samples of a car that a state of charge encodes, below the values of faulty sensors."""
NOISE: Final = 0.3
"""Standard deviation of the logarithm of the factor of wind and rain."""
VEER: Final = 20.0
"""Standard deviation of the error of the wind direction. [deg]"""


class Tables(NamedTuple):
    """Hold a data set.

    Parameters
    ----------
    hidden : DataFrame
        For each window in the order of `windows`: its `ride_key`, its `window`, and the energy of each hidden effect.
        [kWh]
    """

    rides: pd.DataFrame
    windows: pd.DataFrame
    hidden: pd.DataFrame


def add_weather_noise(messages: Sequence[Message], seed: int) -> list[Message]:
    """Return messages with an error of 30 % in wind and rain, and of 20 degrees in the wind direction.

    Returns
    -------
    list of Message
        The errors are drawn independently for every station and hour; their factors have mean one.
    """
    rng = np.random.default_rng([seed, 6])
    return [_blurred(message, rng) if message.key.startswith("weather/") else message for message in messages]


def _blurred(message: Message, rng: np.random.Generator) -> Message:
    """Return an observation with random errors of wind and rain."""
    weather = msgspec.json.decode(message.payload, type=Weather)
    wind, rain = np.exp(NOISE * rng.normal(size=2) - 0.5 * NOISE**2)
    reported = [weather.wind_speed_kmh or 0.0, weather.wind_from_deg or 0.0, weather.precipitation_mm or 0.0]
    source = (reported[1] + VEER * rng.normal()) % 360.0
    changed = {"wind_speed_kmh": wind * reported[0], "wind_from_deg": source, "precipitation_mm": rain * reported[2]}
    blurred = {name: float(value) for name, value in changed.items()}
    return message._replace(payload=encode(msgspec.structs.replace(weather, **blurred)))


@dataclass
class Recording:
    """Hold what a consumer knows of the drives, ready to be filled with what cars measure.

    Parameters
    ----------
    batch : Batch
        Rows with numbers of samples in them.
    car, number : (n,) int
        Of the drives' cars and of the samples of each.
    kind : (n,) int
        Kind of car of each row.
    rates : list of ((AMOUNTS + effects + ROOM), rows) float
        What each row adds to the sums, a block of `BLOCK` rows each.
    timing : (n,) float
        Time that each row stands for. [s]
    elevation, climb : (n,) float
        Elevation of each row and climb of its step, smoothed over whole rides. [m]
    observed : list of (int, Weather)
        Observations of the weather, each with the row before which it was received.
    """

    batch: Batch
    car: Ints
    number: Ints
    kind: Ints
    lanes: list[str]
    names: RideNames
    drivers: RideDrivers
    cars: Cars
    sky: Sky
    rates: list[Floats]
    timing: Floats
    elevation: Floats
    climb: Floats
    effects: list[Effect]
    observed: list[tuple[int, Weather]]

    def tables(self, measured: Readings, measurement: Measurement, names: Sequence[str] = ()) -> Tables:
        """Return the tables of readings."""
        hidden = measured.hidden[:, self.car, self.number]
        filled = _filled(self.batch, measured, measurement, self.car, self.number)
        clean = _cleaned(filled, len(self.lanes), self.sky, self.cars.capacity[self.kind] * JOULES_PER_KWH)
        clean = clean._replace(elevation=self.elevation, climb=self.climb)
        if not np.array_equal(clean.dt, self.timing):  # these readings change which samples are used
            other = replace(self, rates=[])
            other.compute_rates(filled)
            return other.tables(measured, measurement, names)
        accumulator, displays = Accumulator(len(self.effects) + ROOM), DisplayYields(self.cars)
        parts, lanes = list[Sums](), len(self.lanes)
        for block, start in zip(self.rates, range(0, len(self.car), BLOCK), strict=True):
            part = CleanRows(clean, self.sky, self.kind).rows(start, start + BLOCK)
            self._renew(block, part, hidden[:, start : start + BLOCK])
            parts.append(displays.attach(accumulator.add(part.clean, part.kind, block, lanes), lanes))
        parts.append(displays.attach(accumulator.close(), lanes))
        rides = join_totals([part.rides for part in parts], accumulator.none())
        return self._named(rides, join_totals([part.windows for part in parts], accumulator.none()), names)

    def compute_rates(self, filled: Batch) -> None:
        """Compute what each row adds to the sums, its time and its elevation."""
        nowhere = Sky(*np.full((len(Sky._fields), filled.size), np.nan))
        clean = _cleaned(filled, len(self.lanes), nowhere, self.cars.capacity[self.kind] * JOULES_PER_KWH)
        self.timing = clean.dt
        clean = smooth_elevation(clean)
        self.elevation, self.climb = clean.elevation, clean.climb
        self.sky = Stations().sky_between(clean.time, clean.latitude, clean.longitude, self.observed)
        for start in range(0, filled.size, BLOCK):
            signals = self._make_signals(CleanRows(clean, self.sky, self.kind).rows(start, start + BLOCK))
            with np.errstate(all="ignore"):
                powers = [(effect.per, effect.power(signals)) for effect in self.effects]
            rates = compute_amounts(signals, powers)
            self.rates.append(np.concatenate([rates, np.zeros((ROOM, rates.shape[1]))]))

    def _make_signals(self, rows: CleanRows) -> Signals:
        """Return the signals of some rows."""
        return Signals(rows.clean, rows.sky, self.cars.parameters_of(rows.kind))

    def _renew(self, block: Floats, rows: CleanRows, hidden: Floats) -> None:
        """Write the energies that a hidden effect changes into a block of rates."""
        signals, clean = self._make_signals(rows), rows.clean
        block[: len(AMOUNTS)] = compute_amounts(signals, [])
        for index, effect in enumerate(self.effects):
            if READS_SOC in effect.arguments:
                np.multiply(effect.power(signals), _time(effect, clean), out=block[len(AMOUNTS) + index])
        block[len(AMOUNTS) + len(self.effects) :] = 0.0
        for index, power in enumerate(hidden):
            np.multiply(power, clean.dt, out=block[len(AMOUNTS) + len(self.effects) + index])

    def _named(self, rides: Totals, windows: Totals, hidden: Sequence[str]) -> Tables:
        """Return the tables of totals."""
        columns = [effect.name for effect in self.effects]
        ride_names = self.names.names(rides.at_last("code").tolist())
        context = RunContext(Lanes(self.lanes), self.cars, columns, Settings(), EXTENDED_PHYSICAL)
        cars = [self.lanes[lane] for lane in rides.lane.tolist()]
        drivers = self.drivers.find_all(cars, ride_names, [inf] * len(cars))
        table = tabulate_rides(rides, ride_names, drivers, context)
        window = tabulate_windows(windows, context)
        energies = windows.amounts[:, len(AMOUNTS) + len(columns) :]
        truth = {name: energies[:, index] / JOULES_PER_KWH for index, name in enumerate(hidden)}
        return Tables(table, window, window[["ride_key", "window"]].assign(**truth))


def record_drives(drives: Drives, messages: Sequence[Message] | None = None) -> Recording:
    """Process all messages of the drives, as a consumer does."""
    lanes = Lanes()
    decoder = Decoder(lanes)
    batch, events = decoder.decode(drives.messages if messages is None else messages)
    cars = Cars()
    vehicles = [
        VehicleChange(event.row, event.lane, event.value) for event in events if isinstance(event.value, Vehicle)
    ]
    kind = cars.kinds(batch.lane, vehicles, len(lanes))
    drivers = RideDrivers()
    for event in events:
        if isinstance(event.value, Ride):
            drivers.observe(event.value, event.lane, event.row)
    order = np.array([drives.vehicles.index(name) for name in lanes.names])
    car, number = order[batch.lane], _numbers(batch)
    measured = drives.measured()
    nowhere = Sky(*np.full((len(Sky._fields), batch.size), np.nan))
    recording = Recording(
        batch, car, number, kind, lanes.names, decoder.rides, drivers, cars, nowhere,
        [], np.empty(0), np.empty(0), np.empty(0), [effects.get(name) for name in effects.list_tabulated()],
        [(event.row, event.value) for event in events if isinstance(event.value, Weather)],
    )  # fmt: skip
    recording.compute_rates(_filled(batch, measured, "vi", car, number))
    return recording


def _cleaned(batch: Batch, lanes: int, sky: Sky, capacity: Floats) -> Clean:
    """Return the rows as the product cleans them."""
    clean = Cleaner(Settings()).clean(batch, lanes, capacity)
    return clean._replace(quality=flag_ambient(clean, sky))


def _time(effect: Effect, clean: Clean) -> Floats:
    """Return the time over which an effect acts. [s]"""
    return clean.travel if effect.per == "distance" else clean.dt


def _numbers(batch: Batch) -> Ints:
    """Return the number of the sample of each row, from any mark that no fault has removed."""
    marks = ((batch.voltage, VOLTAGE_MARK), (batch.current, CURRENT_MARK), (batch.soc, SOC_MARK))
    number = np.zeros(batch.size)
    for values, mark in marks:
        read = np.rint(np.nan_to_num(values, nan=0.0) / mark)
        good = (read >= 1.0) & (read < MOST) & (number == 0.0)
        number[good] = read[good]
    if (number == 0.0).any():
        raise ValueError(f"{(number == 0.0).sum()} samples have lost their number; use lower rates of faults")
    return number.astype(np.int64) - 1


def _filled(batch: Batch, measured: Readings, measurement: Measurement, car: Ints, number: Ints) -> Batch:
    """Return the rows with readings rounded as by loggers; faults stay as they are."""
    at = (car, number)
    percent = np.clip(100.0 * measured.soc[at], 0.0, 100.0)
    steps = np.floor(percent / SOC_STEP) * SOC_STEP
    marks = (number + 1).astype(np.float64)
    columns = {
        "voltage": _filled_in(batch.voltage, marks * VOLTAGE_MARK, _logged("battery_voltage_v", measured.voltage[at])),
        "current": _filled_in(batch.current, marks * CURRENT_MARK, _logged("battery_current_a", measured.current[at])),
        "soc": _filled_in(batch.soc, marks * SOC_MARK, 0.01 * _logged("soc_pct", steps)),
        "hvac": np.where(np.isnan(batch.hvac), np.nan, _logged("hvac_w", measured.hvac[at])),
    }
    if measurement == "soc":
        columns |= {name: np.full(batch.size, np.nan) for name in ("voltage", "current")}
    return batch._replace(**columns)


def _filled_in(values: Floats, marks: Floats, new: Floats) -> Floats:
    """Return new values in place of marks, and the old values where a fault has overwritten the mark."""
    return np.where(np.abs(values - marks) < 1e-6, new, values)


def _logged(field_name: str, values: Floats) -> Floats:
    """Return values as loggers send them."""
    return np.round(values, DIGITS[field_name])
