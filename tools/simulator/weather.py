"""Simulate a year of weather in Montreal: hourly, persistent over hours and days, with seasons.

Every element is an autoregressive process about the normal value of the day of the year (Environment Canada, climate
normals 1981 to 2010, Montreal: January -10 °C, July 21 °C), after Richardson (1981), Water Resources Research 17:182.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from math import exp, radians
from operator import attrgetter
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.compiled_cache import njit
from socast.core.wire.messages import Message, Weather, encode
from socast.tools.simulator.conditions import Spell
from socast.tools.simulator.settings import UTC_OFFSET, Simulation
from socast.tools.simulator.world import ORIGIN

HOUR: Final = 3600.0
DAYTIME: Final = (7.0, 19.0)
"""Local hours that count as day for the extreme temperatures of a preset. [h]"""
ONSET: Final = 6 * HOUR
"""Time over which a spell begins, before its first day, and ends. [s]"""
LIMITS: Final = (-42.0, 44.0)
"""Coldest and warmest temperature of a spell. [°C]"""
ISSUE_HOURS: Final = 6
"""Hours between two forecasts, from midnight UTC on. [h]"""
FORECAST_HOURS: Final = 24
"""Hours ahead of a forecast. [h]"""
FORECAST_DELAY: Final = 1800.0
"""Time after which a forecast that was issued is received. [s]"""
FORECAST_SD: Final = (0.7, 1.8)
"""Standard deviation of the error of a forecast temperature, now and a day ahead. [K]"""
FORECAST_KEEP: Final = 0.9
"""Correlation of the errors of two hours of a forecast that follow each other. [1]"""
STATIONS: Final = (("mctavish", 45.5047, -73.5790), ("yul", 45.4706, -73.7408), ("yhu", 45.5175, -73.4169))
"""Name, latitude and longitude of each station that publishes observations. [deg]"""


class Sky(NamedTuple):
    """Hold the weather over the city, hour by hour.

    Parameters
    ----------
    time : (n,) float
        Unix time. [s]
    temperature : (n,) float
        Temperature at sea level. [°C]
    wind_east, wind_north : (n,) float
        Velocity of the air at the height of the roof of a car. [m/s]
    precipitation : (n,) float
        Precipitation. [mm/h]
    wetness : (n,) float
        Water on the road, 0 dry to 1 flooded. [1]
    snow : (n,) float
        Snow on the road, 0 bare to 1 covered. [1]
    pressure : (n,) float
        Pressure at sea level. [Pa]
    humidity : (n,) float
        Relative humidity. [1]
    solar : (n,) float
        Global horizontal irradiance. [W/m^2]
    """

    time: Floats
    temperature: Floats
    wind_east: Floats
    wind_north: Floats
    precipitation: Floats
    wetness: Floats
    snow: Floats
    pressure: Floats
    humidity: Floats
    solar: Floats

    def at(self, time: Floats) -> "Sky":
        """Return the weather at other times, interpolated linearly between hours."""
        return Sky(time, *(np.interp(time, self.time, column) for column in self[1:]))


def make_sky(
    start: float,
    days: int,
    seed: int,
    extremes: tuple[float, float] | None = None,
    spells: tuple[Spell, ...] = (),
) -> Sky:
    """Return the weather from a day before `start` until two days after the last of `days`.

    Units: start [s].

    Parameters
    ----------
    extremes : (float, float), optional
        Coldest and hottest temperature by day; cold snaps and heat waves are scaled to reach them. [°C]

    Notes
    -----
    Every element has its own random stream, so that a longer simulation begins with the weather of a shorter one.
    """
    time = np.floor(start / HOUR) * HOUR + HOUR * np.arange(-24, 24 * (days + 2), dtype=float)
    n = len(time)
    elements = iter(range(100))

    def wandering(keep: float) -> Floats:
        return draw_autoregressive(np.random.default_rng([seed, 1, next(elements)]), n, keep)

    year_angle = 2 * np.pi * ((time / SECONDS_PER_DAY) % 365.2425 - 20.0) / 365.2425
    clock = ((time + UTC_OFFSET) / HOUR) % 24
    cold = 0.5 + 0.5 * np.cos(year_angle)
    cloud = 1 / (1 + np.exp(-1.6 * wandering(0.93) - 0.3))
    synoptic = wandering(exp(-1 / 60.0))
    diurnal = (4.2 - 2.4 * cloud) * np.cos(2 * np.pi * (clock - 15) / 24)
    temperature = 6.2 - 15.8 * np.cos(year_angle) + (3.6 + 2.4 * cold) * synoptic + diurnal
    temperature = np.clip(temperature, -32.0, 36.0)
    if extremes is not None:
        by_day = (clock >= DAYTIME[0]) & (clock <= DAYTIME[1])
        temperature = _drawn_out(temperature, extremes[1], by_day)
        temperature = -_drawn_out(-temperature, -extremes[0], by_day)
    for spell in spells:
        temperature = _set_spell(time, temperature, start, spell)
    precipitation = _precipitation(seed, cloud)
    wetness, snow = _road(temperature, precipitation)
    humidity = np.clip(0.45 + 0.3 * cloud + 0.12 * wandering(0.9) - 0.012 * diurnal, 0.2, 1.0)
    return Sky(
        time=time,
        temperature=temperature,
        wind_east=(1.2 + 2.4 * wandering(0.95)) * (0.8 + 0.4 * cold),
        wind_north=(0.5 + 2.1 * wandering(0.95)) * (0.8 + 0.4 * cold),
        precipitation=precipitation,
        wetness=wetness,
        snow=snow,
        pressure=101_500.0 + 900.0 * wandering(0.985) - 350.0 * synoptic,
        humidity=np.where(precipitation > 0, np.maximum(humidity, 0.88), humidity),
        solar=1050.0 * compute_sun_height(time) ** 1.15 * (1 - 0.72 * cloud**3),
    )


def _drawn_out(temperature: Floats, hottest: float, counts: np.ndarray) -> Floats:
    """Return temperatures with the warmest fifth stretched, so that the maximum of the counted ones is `hottest`."""
    usual, most = float(np.quantile(temperature, 0.8)), float(temperature[counts].max())
    share = np.clip((temperature - usual) / max(most - usual, 1e-9), 0.0, 1.0)
    return np.asarray(temperature + (hottest - most) * share**2)


def _set_spell(time: Floats, temperature: Floats, start: float, spell: Spell) -> Floats:
    """Return temperatures whose extreme in a spell is that far beyond all hours before it, blended in. [°C]"""
    first = start + SECONDS_PER_DAY * spell.day - UTC_OFFSET
    last = first + SECONDS_PER_DAY * spell.days
    earlier, inside = temperature[(time >= start) & (time < first)], (time >= first) & (time < last)
    find_extreme = np.max if spell.kelvin > 0 else np.min
    shift = float(find_extreme(earlier)) + spell.kelvin - float(find_extreme(temperature[inside]))
    share = np.clip(np.minimum(time - first, last - time) / ONSET + 1.0, 0.0, 1.0)
    return np.asarray(np.clip(temperature + shift * share, *LIMITS))


def compute_sun_height(time: Floats) -> Floats:
    """Return the sine of the elevation of the sun over Montreal, 0 at night, accurate to half a degree. [1]

    Units: time [s].

    References
    ----------
    Cooper (1969), Solar Energy 12:333, for the declination.
    """
    day = (time / SECONDS_PER_DAY) % 365.2425 + 1
    declination = np.radians(23.45) * np.sin(2 * np.pi * (284 + day) / 365)
    hour_angle = 2 * np.pi * (time % SECONDS_PER_DAY) / SECONDS_PER_DAY - np.pi + np.radians(ORIGIN[1])
    latitude = radians(ORIGIN[0])
    height = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour_angle)
    return np.asarray(np.maximum(height, 0.0))


def make_observations(sky: Sky, begin: float, end: float, seed: int) -> list[Message]:
    """Return the observations that the stations publish in a period, in order of receipt.

    Units: begin [s], end [s].

    Returns
    -------
    list of Message
        The first observations are those of the full hour before `begin`. Each one is received 5 to 60 s after its hour.
    """
    rng = np.random.default_rng([seed, 2])
    messages = []
    for index, hour in enumerate(sky.time):
        errors, delays = rng.normal(size=(len(STATIONS), 4)), rng.uniform(5.0, 60.0, len(STATIONS))
        if not begin - HOUR < hour <= end:
            continue
        for station, error, delay in zip(STATIONS, errors, delays, strict=True):
            messages.append(_observation(sky, index, station, error, float(delay)))
    return sorted(messages, key=lambda message: message.receipt_ns)


def make_forecasts(sky: Sky, begin: float, end: float, seed: int) -> list[Message]:
    """Return the forecasts of the temperature that the stations publish in a period, in order of receipt.

    Units: begin [s], end [s].

    Returns
    -------
    list of Message
        Every `ISSUE_HOURS` one forecast of each hour of the next day. All stations have the same error, which grows
        with the time ahead.
    """
    rng, messages = np.random.default_rng([seed, 3]), []
    lead = np.arange(FORECAST_HOURS + 1)
    sd = np.interp(lead, [0.0, FORECAST_HOURS], FORECAST_SD)
    for first in np.flatnonzero(sky.time % (ISSUE_HOURS * HOUR) == 0.0).tolist():
        issued, errors = float(sky.time[first]), sd * draw_autoregressive(rng, len(lead), FORECAST_KEEP)
        if not begin - 2 * ISSUE_HOURS * HOUR < issued <= end:
            continue
        receipt_ns = int(max(issued + FORECAST_DELAY, begin) * 1e9)
        for time, truth, error in zip(sky.time[first:], sky.temperature[first:], errors, strict=False):
            celsius = round(float(truth + error), 1)
            for name, latitude, longitude in STATIONS:
                ahead = Weather(name, float(time), latitude, longitude, temperature_c=celsius, issued_s=issued)
                messages.append(Message(f"weather/{name}", encode(ahead), receipt_ns))
    return messages


def merge_weather(blocks: Iterable[Sequence[Message]], simulation: Simulation, sky: Sky) -> Iterator[Sequence[Message]]:
    """Merge the observations and forecasts of the stations into the messages of a fleet.

    Yields
    ------
    sequence of Message
        In order of receipt, from the hour before the first message of the fleet to its last message.
    """
    waiting: deque[Message] | None = None
    for block in blocks:
        if waiting is None:
            waiting = _publish_weather(simulation, sky, block[0].receipt_ns / 1e9)
        if not waiting or waiting[0].receipt_ns > max(message.receipt_ns for message in block):
            yield block
            continue
        merged: list[Message] = []
        for message in block:
            while waiting and waiting[0].receipt_ns <= message.receipt_ns:
                merged.append(waiting.popleft())
            merged.append(message)
        yield merged


def _publish_weather(simulation: Simulation, sky: Sky, begin: float) -> deque[Message]:
    """Return what the stations publish from a time [s] on, in order of receipt."""
    end = float(sky.time[-1])
    published = make_observations(sky, begin, end, simulation.seed)
    if simulation.conditions.weather_forecasts:
        published += make_forecasts(sky, begin, end, simulation.seed)
    return deque(sorted(published, key=attrgetter("receipt_ns")))


def _observation(sky: Sky, i: int, station: tuple[str, float, float], error: Floats, delay: float) -> Message:
    """Return the message of one station about one hour."""
    name, latitude, longitude = station
    east, north = sky.wind_east[i] + 0.3 * error[1], sky.wind_north[i] + 0.3 * error[2]
    observed = Weather(
        station_id=name,
        time_s=float(sky.time[i]),
        latitude_deg=latitude,
        longitude_deg=longitude,
        temperature_c=round(float(sky.temperature[i] + 0.3 * error[0]), 1),
        wind_speed_kmh=round(float(3.6 * np.hypot(east, north)), 1),
        wind_from_deg=round(float(np.degrees(np.arctan2(-east, -north)) % 360), 0) % 360,
        precipitation_mm=round(float(sky.precipitation[i]), 1),
        pressure_hpa=round(float(sky.pressure[i] / 100 + 0.2 * error[3]), 1),
        humidity_pct=round(float(100 * sky.humidity[i]), 0),
        solar_w_m2=round(float(sky.solar[i]), 0),
    )
    return Message(f"weather/{name}", encode(observed), int((sky.time[i] + delay) * 1e9))


def draw_autoregressive(rng: np.random.Generator, n: int, keep: float) -> Floats:
    """Return a stationary process of variance 1 with correlation `keep` between neighbours. (n,) [1]"""
    values = rng.normal(size=n)
    _carry_on(values, keep, (1 - keep * keep) ** 0.5)
    return values


@njit(cache=True)
def _carry_on(values: Floats, keep: float, fresh: float) -> None:
    """Replace each value by a share of the one before and a fresh share."""
    for i in range(1, len(values)):
        values[i] = keep * values[i - 1] + fresh * values[i]


def _precipitation(seed: int, cloud: Floats) -> Floats:
    """Return wet and dry spells from a two-state Markov chain that depends on cloud cover. [mm/h]"""
    draws = np.random.default_rng([seed, 1, 100]).uniform(size=len(cloud))
    amounts = np.random.default_rng([seed, 1, 101]).exponential(0.8, len(cloud))
    fallen, wet = np.zeros(len(cloud)), False
    for i, (draw, cover) in enumerate(zip(draws, cloud, strict=True)):
        wet = draw < (0.86 if wet else 0.13) * cover
        fallen[i] = amounts[i] if wet else 0.0
    return fallen


def _road(temperature: Floats, precipitation: Floats) -> tuple[Floats, Floats]:
    """Return wetness and snow of the road: precipitation minus drainage, drying, melting and ploughing."""
    wetness, snow = np.zeros(len(temperature)), np.zeros(len(temperature))
    water = cover = 0.0
    for i, (warm, fall) in enumerate(zip(temperature, precipitation, strict=True)):
        is_snow = warm < 0.5
        melted = min(cover, 0.15 * max(warm, 0.0))
        cover = 0.90 * (cover - melted) + fall * is_snow
        water = 0.55 * water + melted + fall * (not is_snow)
        wetness[i], snow[i] = 1 - exp(-water / 0.8), 1 - exp(-cover / 3.0)
    return wetness, snow
