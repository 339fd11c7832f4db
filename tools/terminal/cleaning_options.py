"""The settings of cleaning as command-line options in everyday units, the same for every command."""

from typing import Annotated, Final

import typer

from core.columns import KMH
from core.settings import LIMITS, Settings
from tools.terminal.option_groups import insert_options

_KM: Final = 1000.0
_DEFAULTS: Final = Settings()

SPEED_LIMIT_KMH: Final = round(_DEFAULTS.speed_limit / KMH, 6)
"""Default speed limit. [km/h]"""
PERIOD_S: Final = _DEFAULTS.period
"""Default time between two samples. [s]"""
SMOOTHING: Final = _DEFAULTS.window
"""Default number of samples in the moving average of a reported speed."""
LEAST_DISTANCE_KM: Final = _DEFAULTS.least_distance / _KM
"""Default distance below which a ride is unfit for training. [km]"""


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
    float, typer.Option("--period-s", metavar="S", help="Nominal time between two samples.", **_limits("period"))
]
Smoothing = Annotated[
    int,
    typer.Option(
        "--smoothing",
        metavar="N",
        help="Samples in the moving average of reported speed.",
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


def make_settings(
    speed_limit_kmh: SpeedLimit = SPEED_LIMIT_KMH,
    period_s: Period = PERIOD_S,
    smoothing: Smoothing = SMOOTHING,
    least_distance_km: LeastDistance = LEAST_DISTANCE_KM,
) -> Settings:
    """Return the settings that the options of cleaning define.

    Parameters
    ----------
    speed_limit_kmh : float
        Speed above which a sample is rejected. [km/h]
    period_s : float
        Nominal time between two samples. [s]
    smoothing : int
        Number of samples in the moving average of a reported speed. [1]
    least_distance_km : float
        Distance below which a ride is unfit for training. [km]

    Returns
    -------
    Settings

    Examples
    --------
    >>> make_settings() == Settings()
    True
    >>> make_settings(smoothing=5).window
    5
    """
    return Settings(
        period=period_s, speed_limit=speed_limit_kmh * KMH, window=smoothing, least_distance=least_distance_km * _KM
    )


insert_cleaning_options = insert_options("settings", make_settings)
"""Decorator that gives a command the options of cleaning in place of its argument `settings`."""
