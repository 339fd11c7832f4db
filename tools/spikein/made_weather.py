"""Make observations of a station for recordings that have none: wind, rain, humidity and sun, hour by hour."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.signal import lfilter

from socast.core.batch import Floats
from socast.core.signals.sun import sine_of_elevation
from socast.core.wire.messages import Weather
from socast.tools.spikein.car_readings import CarReadings

HOUR_S: Final = 3600.0
WIND_KMH, RAIN_SHARE, RAIN_MM = 14.0, 0.15, 1.2
"""Mean wind [km/h], share of the hours with rain [1], and mean rain of such an hour [mm]."""
KEPT: Final = 0.9
"""Correlation of the weather of two hours. [1]"""
CLEAR_SKY: Final = 1050.0
"""Irradiance of a sun at the zenith. [W/m^2]"""


def make_weather(cars: Sequence[CarReadings], seed: int) -> list[Weather]:
    """Return hourly observations of a made-up station amid the cars, from a day before the first sample.

    Notes
    -----
    The temperature is that which the cars report. Wind (north and east), rain, humidity and cloud follow independent
    autoregressive processes of first order.
    """
    time = np.concatenate([each.values["time_s"] for each in cars])
    latitude, longitude = (
        float(np.nanmedian(np.concatenate([[np.nan], *[each.values[name] for each in cars]])))
        if any(np.isfinite(each.values[name]).any() for each in cars)
        else 0.0
        for name in ("latitude_deg", "longitude_deg")
    )
    hours = np.arange(time.min() // HOUR_S * HOUR_S - 24 * HOUR_S, time.max() + 2 * HOUR_S, HOUR_S)
    rng = np.random.default_rng([seed, 7])
    north, east, wet, damp, cloud = (_wander(rng, len(hours)) for _ in range(5))
    north, east = north * WIND_KMH / 1.25, east * WIND_KMH / 1.25  # the mean of two normal components' length
    rain = np.where(wet > np.quantile(wet, 1.0 - RAIN_SHARE), rng.exponential(RAIN_MM, len(hours)), 0.0)
    place = np.radians(np.full(len(hours), latitude)), np.radians(np.full(len(hours), longitude))
    sun = CLEAR_SKY * np.maximum(sine_of_elevation(hours, *place), 0.0) * np.clip(0.6 - 0.3 * cloud, 0.1, 1.0)
    humidity = np.clip(65.0 + 15.0 * damp + 15.0 * (rain > 0.0), 20.0, 100.0)
    ambient = _average_ambient(cars, hours)
    return [
        Weather(
            station_id="made-up",
            time_s=float(hours[i]),
            latitude_deg=latitude,
            longitude_deg=longitude,
            temperature_c=None if ambient is None else round(float(ambient[i]), 1),
            wind_speed_kmh=round(float(np.hypot(north[i], east[i])), 1),
            wind_from_deg=round(float(np.degrees(np.arctan2(east[i], north[i])) % 360.0), 0) % 360.0,
            precipitation_mm=round(float(rain[i]), 2),
            humidity_pct=round(float(humidity[i]), 0),
            solar_w_m2=round(float(sun[i]), 0),
        )
        for i in range(len(hours))
    ]


def _average_ambient(cars: Sequence[CarReadings], hours: Floats) -> Floats | None:
    """Return the temperature that cars report around each hour, None where no car does. [°C]"""
    time, ambient = (np.concatenate([each.values[name] for each in cars]) for name in ("time_s", "ambient_c"))
    is_known = np.isfinite(ambient)
    if not is_known.any():
        return None
    order = np.argsort(time[is_known], kind="stable")
    return np.asarray(np.interp(hours, time[is_known][order], ambient[is_known][order]))


def _wander(rng: np.random.Generator, count: int) -> Floats:
    """Return an autoregressive process of variance 1."""
    steps = rng.normal(size=count) * np.sqrt(1.0 - KEPT**2)
    steps[0] /= np.sqrt(1.0 - KEPT**2)
    return np.asarray(lfilter([1.0], [1.0, -KEPT], steps))
