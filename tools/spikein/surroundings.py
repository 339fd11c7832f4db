"""Compute surroundings and state of a real car along its way, as the hidden effects of the simulator need them."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.signal import lfilter

from socast.core.batch import Floats
from socast.core.columns import EARTH_RADIUS
from socast.core.signals.sun import sine_of_elevation
from socast.core.wire.messages import Weather
from socast.tools.simulator.cars import Car
from socast.tools.simulator.hidden import EffectInputs
from socast.tools.simulator.physics import integrate_states
from socast.tools.simulator.settings import PLAIN_PHENOMENA, STEP
from socast.tools.simulator.trace import Trace, compute_air_density
from socast.tools.spikein.car_readings import CarReadings

LONGEST_GAP: Final = 60.0
"""Longest time between two samples of one drive. [s]"""
FASTEST: Final = 70.0
"""Speed above which a sample is wrong. [m/s]"""
STEEPEST: Final = 0.15
"""Largest sine of the angle of a road. [1]"""
SMOOTH_S, CLIMB_S = 2.0, 30.0
"""Times over which speed and elevation are averaged. [s]"""
STANDING: Final = 0.3
"""Speed below which a car stands. [m/s]"""
DOOR_S: Final = 15.0
"""Time for which a door is open at the beginning of each stop. [s]"""
DRYING_S, THAW_S, SOAKED_MM = 3600.0, 6 * 3600.0, 1.0
"""Times in which a road dries and snow goes [s], and water that makes it wet [mm]."""
WEATHER: Final = {
    "temperature_c": np.nan,
    "wind_speed_kmh": 0.0,
    "wind_from_deg": 0.0,
    "precipitation_mm": 0.0,
    "pressure_hpa": 1013.25,
    "humidity_pct": 60.0,
    "solar_w_m2": 0.0,
}
"""Field of an observation -> its value where no station tells it."""


class Drive(NamedTuple):
    """Hold a time without gaps in which a car sent samples.

    Parameters
    ----------
    first, last : int
        Place of its first sample, and of the one after its last.
    inputs : EffectInputs
        Surroundings and state in steps of `STEP`, the first at the first sample.
    """

    first: int
    last: int
    inputs: EffectInputs


def find_drives(readings: CarReadings, weather: Sequence[Weather], car: Car) -> list[Drive]:
    """Return the drives of a car with what its effects depend on."""
    time = readings.values["time_s"]
    edges = np.flatnonzero(np.diff(time, prepend=-np.inf, append=np.inf) > LONGEST_GAP)
    observed = _Weather(weather)
    drives: list[Drive] = []
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if last - first > 1 and time[last - 1] > time[first]:
            parked = time[first] - time[first - 1] if first else 8 * 3600.0
            drives.append(Drive(first, last, _make_inputs(readings, slice(first, last), parked, observed, car)))
    return drives


class _Weather:
    """Interpolate the observations of the stations, without regard to their places."""

    def __init__(self, weather: Sequence[Weather]) -> None:
        self._columns: dict[str, tuple[Floats, Floats]] = {}
        for name in WEATHER:
            known = [(each.time_s, value) for each in weather if (value := getattr(each, name)) is not None]
            if known:
                time, values = np.array(known, float).T
                self._columns[name] = time, values

    def get(self, name: str, time: Floats) -> Floats:
        """Return an observed quantity at some times, or what `WEATHER` holds for it."""
        if name not in self._columns:
            return np.full(len(time), WEATHER[name])
        return np.interp(time, *self._columns[name])

    def get_precipitation(self, time: Floats) -> Floats:
        """Return precipitation [mm/h]; a station reports what fell since its last observation."""
        if "precipitation_mm" not in self._columns:
            return np.zeros(len(time))
        reported, amount = self._columns["precipitation_mm"]
        hours = np.diff(reported, prepend=reported[0] - 3600.0) / 3600.0
        rate = amount / np.maximum(hours, 0.1)
        return np.asarray(rate[np.minimum(np.searchsorted(reported, time), len(rate) - 1)])

    def get_road(self, time: Floats) -> tuple[Floats, Floats]:
        """Return water and snow on the road, 0 to 1. [1]"""
        past = np.arange(time[0] - 12 * 3600.0, time[-1] + 60.0, 60.0)
        fallen = self.get_precipitation(past) / 60.0
        is_frozen = np.nan_to_num(self.get("temperature_c", past), nan=10.0) < 0.0
        out = []
        for amount, seconds in (
            (np.where(is_frozen, 0.0, fallen), DRYING_S),
            (np.where(is_frozen, fallen, 0.0), THAW_S),
        ):
            left = _lag(amount, np.exp(-60.0 / seconds))
            out.append(np.interp(time, past, np.minimum(left / SOAKED_MM, 1.0)))
        return out[0], out[1]


def _lag(amount: Floats, keep: float) -> Floats:
    """Return what is left of amounts of which a share stays at each step."""
    return np.asarray(lfilter([1.0], [1.0, -keep], amount))


def _smooth(values: Floats, seconds: float) -> Floats:
    """Return a moving average in steps of `STEP`."""
    width = max(int(seconds / STEP) | 1, 1)
    if width == 1 or len(values) < width:
        return values
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")


def _fill(time: Floats, values: Floats, at: Floats, missing: float) -> Floats:
    """Return known values at other times, between them linear; a value that stands for all where none is known."""
    is_known = np.isfinite(values)
    if not is_known.any():
        return np.full(len(at), missing)
    return np.asarray(np.interp(at, time[is_known], values[is_known]))


def _open_doors(speed: Floats) -> Floats:
    """Return 1 in the first `DOOR_S` of each stop, else 0."""
    stands = speed < STANDING
    before = np.concatenate([np.zeros(int(DOOR_S / STEP), bool), stands])[: len(stands)]
    return np.asarray((stands & ~before).astype(float))


def _make_inputs(readings: CarReadings, rows: slice, parked: float, weather: _Weather, car: Car) -> EffectInputs:
    """Return surroundings and state of one drive."""
    given = {name: column[rows] for name, column in readings.values.items()}
    time = np.arange(given["time_s"][0], given["time_s"][-1] + STEP, STEP)

    def read(name: str, missing: float = np.nan) -> Floats:
        return _fill(given["time_s"], given[name], time, missing)

    latitude, longitude = np.radians(read("latitude_deg")), np.radians(read("longitude_deg"))
    x, y = EARTH_RADIUS * np.cos(latitude) * longitude, EARTH_RADIUS * latitude
    speed = read("speed_kmh") / 3.6
    if np.isnan(speed).all():
        speed = np.nan_to_num(_smooth(np.hypot(np.gradient(x, STEP), np.gradient(y, STEP)), 9.0))
    speed = _smooth(np.clip(speed, 0.0, FASTEST), SMOOTH_S)
    elevation = _smooth(read("elevation_m", 0.0), CLIMB_S)
    run = np.maximum(_smooth(speed, CLIMB_S), 1.0)
    grade = np.clip(np.gradient(elevation, STEP) / run, -STEEPEST, STEEPEST) * (speed > STANDING)
    east, north = np.nan_to_num(_smooth(np.gradient(x, STEP), 9.0)), np.nan_to_num(_smooth(np.gradient(y, STEP), 9.0))
    heading = np.unwrap(np.arctan2(east, north))
    turn_rate = np.clip(np.gradient(heading, STEP), -0.6, 0.6) * (speed > 3.0)
    wind = weather.get("wind_speed_kmh", time) / 3.6
    towards = np.radians(weather.get("wind_from_deg", time)) - heading
    air = weather.get("temperature_c", time)
    ambient = read("ambient_c")
    ambient = np.where(np.isnan(ambient), np.where(np.isnan(air), 15.0, air), ambient)
    humidity = weather.get("humidity_pct", time) / 100.0
    wetness, snow = weather.get_road(time)
    charging = read("charging", 0.0) > 0.5
    height = np.nan_to_num(sine_of_elevation(time, latitude, longitude), nan=1.0)
    trace = Trace(
        time=time, x=np.nan_to_num(x), y=np.nan_to_num(y), elevation=elevation,
        speed=speed, acceleration=np.gradient(speed, STEP), grade=grade, turn_rate=turn_rate,
        headwind=wind * np.cos(towards), crosswind=wind * np.sin(towards),
        density=compute_air_density(weather.get("pressure_hpa", time) * 100.0, ambient, humidity, elevation),
        ambient=ambient, precipitation=weather.get_precipitation(time), wetness=wetness, snow=snow, humidity=humidity,
        solar=weather.get("solar_w_m2", time), dark=(height < 0.05).astype(float), on=(~charging).astype(float),
        door=_open_doors(speed), plugged=charging.astype(float),
        occupants=read("occupants", 2.0), elapsed=time - time[0], parked=np.full(len(time), parked),
        tunnel=np.zeros(len(time)),
    )  # fmt: skip
    soc = read("soc_pct", 60.0) / 100.0
    state = integrate_states(trace, car, float(soc[0]), PLAIN_PHENOMENA)
    voltage, current = read("battery_voltage_v"), read("battery_current_a")
    pack = read("battery_temperature_c")
    measured = state._replace(
        soc=soc,
        voltage=np.where(np.isnan(voltage), state.voltage, voltage),
        current=np.where(np.isnan(current), state.current, current),
        pack=np.where(np.isnan(pack), state.pack, pack),
    )
    return EffectInputs(trace, measured, car)
