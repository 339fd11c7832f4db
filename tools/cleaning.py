"""Settings of cleaning on the command line, in the units in which people think of them; the same for every command."""

from typing import Annotated, Final

import typer

from core.columns import KMH
from core.settings import LIMITS, Settings

_KM: Final = 1000.0
_usual = Settings()

SPEED_LIMIT_KMH: Final = round(_usual.speed_limit / KMH, 6)
"""Usual limit of speed. [km/h]"""
PERIOD_S: Final = _usual.period
"""Usual time between two samples. [s]"""
SMOOTHING: Final = _usual.window
"""Usual number of samples in the moving average of speed."""
LEAST_DISTANCE_KM: Final = _usual.least_distance / _KM
"""Usual distance below which a ride is unfit for training. [km]"""


def _limits(name: str, unit: float = 1.0) -> dict[str, float]:
    """Return the limits of a setting in a unit, as an option takes them."""
    low, high = LIMITS[name]
    return {"min": round(low / unit, 6), "max": round(high / unit, 6)}


SpeedLimit = Annotated[
    float,
    typer.Option(
        "--speed-limit-kmh", metavar="KMH", help="Faster samples are rejected.", **_limits("speed_limit", KMH)
    ),
]
Period = Annotated[
    float, typer.Option("--period-s", metavar="S", help="Nominal time between two samples.", **_limits("period"))
]
Smoothing = Annotated[
    int, typer.Option("--smoothing", metavar="N", help="Samples in the moving average of speed.", **_limits("window"))
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


def cleaning(speed_limit_kmh: float, period_s: float, smoothing: int, least_distance_km: float) -> Settings:
    """Return what the options say.

    Parameters
    ----------
    speed_limit_kmh : float
        Speed above which a sample is not believed. [km/h]
    period_s : float
        Nominal time between two samples. [s]
    smoothing : int
        Samples in the moving average of speed.
    least_distance_km : float
        Distance below which a ride is unfit for training. [km]

    Returns
    -------
    Settings

    Examples
    --------
    >>> cleaning(SPEED_LIMIT_KMH, PERIOD_S, SMOOTHING, LEAST_DISTANCE_KM) == Settings()
    True
    """
    return Settings(
        period=period_s, speed_limit=speed_limit_kmh * KMH, window=smoothing, least_distance=least_distance_km * _KM
    )
