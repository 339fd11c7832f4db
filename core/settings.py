"""Define the settings of cleaning and forecasting that an operator may change, with their limits."""

from typing import NamedTuple

from core.columns import KMH, SECONDS_PER_DAY
from core.errors import SettingsError


class Settings(NamedTuple):
    """Hold the thresholds of cleaning, forecasting and fitness for training, in SI units.

    Parameters
    ----------
    period : float
        Nominal time between two samples of a logger. [s]
    speed_limit : float
        Speed above which a reported speed is rejected; 130 km/h as in section 3 of the paper. [m/s]
    window : int
        Number of samples in the moving average of a reported speed, 1 to 8; 1 takes it as reported. The average of
        speeds between fixes has at least 3.
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
    window: int = 1
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


LIMITS = {
    "period": (0.1, 60.0),
    "speed_limit": (30 * KMH, 300 * KMH),
    "window": (1, 8),
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


def checked(settings: Settings) -> Settings:
    """Return the settings if each of them is within its limits.

    Parameters
    ----------
    settings : Settings
        Settings to check.

    Returns
    -------
    Settings
        The same settings.

    Raises
    ------
    SettingsError
        If a setting is outside its limits; the message names the setting, its value and its limits.

    Examples
    --------
    >>> checked(Settings(window=5)).window
    5
    """
    for name, value in settings._asdict().items():
        low, high = LIMITS[name]
        if not low <= value <= high:
            raise SettingsError(f"{name} is {value:g}, but must be from {low:g} to {high:g} (SI units)")
    return settings
