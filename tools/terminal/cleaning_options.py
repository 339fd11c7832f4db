"""The settings of cleaning as command-line options in everyday units, the same for every command."""

from typing import Annotated, Final

import typer

from socast.core.columns import KMH
from socast.core.settings import LIMITS, Settings
from socast.tools.terminal.option_groups import insert_options

_KM: Final = 1000.0
_MINUTE: Final = 60.0
_DEFAULTS: Final = Settings()

SPEED_LIMIT_KMH: Final = round(_DEFAULTS.speed_limit / KMH, 6)
"""Default speed limit. [km/h]"""
PERIOD_S: Final = _DEFAULTS.period
"""Default time between two samples. [s]"""
SMOOTHING: Final = _DEFAULTS.window
"""Default number of samples in the moving average of a reported speed."""
LEAST_DISTANCE_KM: Final = _DEFAULTS.least_distance / _KM
"""Default distance below which a ride is unfit for training. [km]"""
LONGEST_RIDE_MIN: Final = _DEFAULTS.longest_ride / _MINUTE
"""Default duration above which a ride is unfit for training. [min]"""


def _limits(name: str, unit: float = 1.0) -> dict[str, float]:
    """Return the limits of a setting in a unit, as keywords of an option."""
    low, high = LIMITS[name]
    return {"min": round(low / unit, 6), "max": round(high / unit, 6)}


SpeedLimit = Annotated[
    float,
    typer.Option(
        "--speed-limit-kmh", metavar="KMH", help="Reject samples above this speed.", **_limits("speed_limit", KMH)
    ),
]
Period = Annotated[
    float, typer.Option("--period", metavar="S", help="Nominal time between two samples.", **_limits("period"))
]
Smoothing = Annotated[
    int,
    typer.Option(
        "--smoothing",
        metavar="N",
        help="Samples in the moving average of reported speed; 0: as the noise of each car asks.",
        **_limits("window"),
    ),
]
LeastDistance = Annotated[
    float,
    typer.Option(
        "--least-distance-km",
        metavar="KM",
        help="Shorter rides are unfit for training.",
        **_limits("least_distance", _KM),
    ),
]
LongestRide = Annotated[
    float,
    typer.Option(
        "--longest-ride-min",
        metavar="MIN",
        help="Longer rides are unfit for training.",
        **_limits("longest_ride", _MINUTE),
    ),
]


def make_settings(
    speed_limit_kmh: SpeedLimit = SPEED_LIMIT_KMH,
    period: Period = PERIOD_S,
    smoothing: Smoothing = SMOOTHING,
    least_distance_km: LeastDistance = LEAST_DISTANCE_KM,
    longest_ride_min: LongestRide = LONGEST_RIDE_MIN,
) -> Settings:
    """Return the settings that the options of cleaning define.

    Units: period [s].

    Parameters
    ----------
    smoothing : int
        Number of samples in the moving average of a reported speed; 0 for as many as the noise of each car asks. [1]

    Examples
    --------
    >>> make_settings() == Settings()
    True
    >>> make_settings(smoothing=5).window
    5
    """
    return Settings(
        period=period,
        speed_limit=speed_limit_kmh * KMH,
        window=smoothing,
        least_distance=least_distance_km * _KM,
        longest_ride=longest_ride_min * _MINUTE,
    )


def word_settings(settings: Settings) -> list[str]:
    """Return the options of cleaning that differ from their defaults, as words of a command.

    Examples
    --------
    >>> word_settings(make_settings(speed_limit_kmh=180.0)), word_settings(make_settings())
    (['--speed-limit-kmh', '180'], [])
    """
    values = {
        "--speed-limit-kmh": (settings.speed_limit / KMH, SPEED_LIMIT_KMH),
        "--period": (settings.period, PERIOD_S),
        "--smoothing": (settings.window, SMOOTHING),
        "--least-distance-km": (settings.least_distance / _KM, LEAST_DISTANCE_KM),
        "--longest-ride-min": (settings.longest_ride / _MINUTE, LONGEST_RIDE_MIN),
    }
    changed = {name: round(value, 6) for name, (value, default) in values.items() if round(value, 6) != default}
    return [word for name, value in changed.items() for word in (name, f"{value:g}")]


insert_cleaning_options = insert_options("settings", make_settings, "Cleaning")
"""Decorator that gives a command the options of cleaning in place of its argument `settings`."""
