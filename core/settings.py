"""Define what an operator may set: thresholds of cleaning and forecasting, and limits of what is taken in."""

from collections.abc import Mapping
from typing import NamedTuple

from socast.core.columns import KMH, SECONDS_PER_DAY
from socast.core.errors import SettingsError


class Settings(NamedTuple):
    """Hold the thresholds of cleaning, forecasting and fitness for training, in SI units.

    Parameters
    ----------
    period : float
        Nominal time between two samples of a logger. [s]
    speed_limit : float
        Speed above which a reported speed is rejected; 130 km/h as in section 3 of the paper. [m/s]
    window : int
        Number of samples in the moving average of a reported speed, 1 to 8; 1 takes it as reported. 0, the default,
        averages up to 8 samples as the noise of each car asks, and none of a clean speed. The average of speeds
        between fixes has at least 3.
    elevation_length : float
        Distance over which elevation is smoothed. [m]
    elevation_slack : float
        Least change of the smoothed elevation that counts as a climb or descent. [m]
    tunnel_limit : float
        Longest jump of the position that may be a tunnel; a longer jump adds no distance. [m]
    stop_time : float
        Time at standstill that ends a ride, where the logger names no rides. [s]
    gap_time : float
        Time without samples that ends a ride. [s]
    window_time : float
        Shortest duration of a window of the window table. [s]
    forecast_time : float
        Event time between two forecasts of a vehicle, unless something material changes. [s]
    shortest_ride : float
        Duration below which a ride is unfit for training. [s]
    longest_ride : float
        Duration above which a ride is unfit for training; an hour in the paper. [s]
    least_distance : float
        Distance below which a ride is unfit for training. [m]
    """

    period: float = 3.0
    speed_limit: float = 130 * KMH
    window: int = 0
    elevation_length: float = 80.0
    elevation_slack: float = 1.0
    tunnel_limit: float = 10_000.0
    stop_time: float = 180.0
    gap_time: float = 600.0
    window_time: float = 60.0
    forecast_time: float = 15.0
    shortest_ride: float = 30.0
    longest_ride: float = 3600.0
    least_distance: float = 200.0


class Limits(NamedTuple):
    """Hold the limits of what a consumer takes in, so that no sender can exhaust its memory or its time.

    Whatever exceeds a limit is counted by its cause under `undecodable` in the counters.

    Parameters
    ----------
    payload_bytes : float
        Largest payload (`too_large`). [bytes]
    queue_bytes : float
        Size of the received messages that may wait for the consumer; while more would wait, publishers are blocked.
        [bytes]
    list_samples : float
        Largest number of samples in a payload that is a list (`too_many_samples`).
    vehicles : float
        Largest number of vehicles (`too_many_vehicles`), and of different vehicle descriptions.
    vehicle_models : float
        Largest number of names of vehicle models (`too_many_models`).
    key_rate : float
        Messages of a key per second of receipt (`rate_limited`); 0 for no limit, as for recordings. [1/s]
    key_burst : float
        Number of messages that a key may send at once; a sample every 3 s makes 9,600 in an outage of 8 h.
    silent_days : float
        Event time after which a vehicle or a station that has sent nothing is forgotten, at the daily update. [days]
    """

    payload_bytes: float = 4_000_000
    queue_bytes: float = 128_000_000
    list_samples: float = 20_000
    vehicles: float = 100_000
    stations: float = 10_000
    vehicle_models: float = 1_000
    key_rate: float = 0.0
    key_burst: float = 10_000
    silent_days: float = 30.0


LIMITS = {
    "period": (0.1, 60.0),
    "speed_limit": (30 * KMH, 300 * KMH),
    "window": (0, 8),
    "elevation_length": (0.0, 2000.0),
    "elevation_slack": (0.0, 20.0),
    "tunnel_limit": (0.0, 50_000.0),
    "stop_time": (10.0, 3600.0),
    "gap_time": (10.0, SECONDS_PER_DAY),
    "window_time": (10.0, 3600.0),
    "forecast_time": (1.0, 3600.0),
    "shortest_ride": (0.0, 3600.0),
    "longest_ride": (60.0, SECONDS_PER_DAY),
    "least_distance": (0.0, 100_000.0),
}
"""Closed interval of each setting, in SI units."""
BOUNDS_OF_LIMITS = {
    "payload_bytes": (1_000, 1_000_000_000),
    "queue_bytes": (1_000_000, 100_000_000_000),
    "list_samples": (1, 100_000_000),
    "vehicles": (1, 10_000_000),
    "stations": (1, 1_000_000),
    "vehicle_models": (1, 1_000_000),
    "key_rate": (0.0, 1_000_000.0),
    "key_burst": (1, 100_000_000),
    "silent_days": (1.0, 36_500.0),
}
"""Closed interval of each limit."""
LIVE_KEY_RATE = 50.0
"""Messages of a key per second that the live service accepts. [1/s]"""


def checked(settings: Settings) -> Settings:
    """Return the settings if each of them is within its limits.

    Examples
    --------
    >>> checked(Settings(window=5)).window
    5
    """
    _check(settings._asdict(), LIMITS, " (SI units)")
    return settings


def check_limits(limits: Limits) -> Limits:
    """Return the limits if each of them is possible.

    Examples
    --------
    >>> check_limits(Limits(vehicles=200)).vehicles
    200
    """
    _check(limits._asdict(), BOUNDS_OF_LIMITS, "")
    return limits


def _check(values: Mapping[str, float], bounds: Mapping[str, tuple[float, float]], unit: str) -> None:
    """Raise SettingsError for a value outside its bounds."""
    for name, value in values.items():
        low, high = bounds[name]
        if not low <= value <= high:
            raise SettingsError(f"{name} is {value:g}, but must be from {low:g} to {high:g}{unit}")
