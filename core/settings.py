"""What an operator may set about cleaning and forecasting, with limits."""

from typing import NamedTuple

from core.columns import KMH, SECONDS_PER_DAY
from core.errors import SettingsError


class Settings(NamedTuple):
    """Thresholds of the cleaning kernel, in SI.

    Parameters
    ----------
    period : float. Nominal time between two samples of a logger. [s]
    speed_limit : float. Speed above which a sample is not believed; 130 km/h as in the paper's section 3. [m/s]
    window : int. Samples in the moving average of speed, 1 to 8.
    elevation_length : float. Distance over which elevation is smoothed. [m]
    elevation_slack : float. Smoothed elevation must leave the last level by this much to be a hill. [m]
    tunnel_limit : float. Longest jump of the position that may be a tunnel; beyond it no distance is made good. [m]
    stop_time : float. Standing time that ends a ride, where the logger names no rides. [s]
    gap_time : float. Silence that ends a ride, where the logger names no rides. [s]
    window_time : float. Shortest window of the window table. [s]
    forecast_time : float. Event time between two forecasts of a vehicle, unless something material changes. [s]
    shortest_ride : float. Duration below which a ride is unfit for training. [s]
    longest_ride : float. Duration above which it is; an hour in the paper. [s]
    least_distance : float. Distance below which it is. [m]
    """

    period: float = 3.0
    speed_limit: float = 130 * KMH
    window: int = 3
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


def checked(settings: Settings) -> Settings:
    """Return `settings` if each is within its limits.

    Raises
    ------
    SettingsError
        Naming the setting, its value and its limits.

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
