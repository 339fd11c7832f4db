"""Settings of cleaning on the command line, in the units in which people think of them; the same for every command."""

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from typing import Annotated, Any, Final

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


def cleaning(
    speed_limit_kmh: SpeedLimit = SPEED_LIMIT_KMH,
    period_s: Period = PERIOD_S,
    smoothing: Smoothing = SMOOTHING,
    least_distance_km: LeastDistance = LEAST_DISTANCE_KM,
) -> Settings:
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
    >>> cleaning() == Settings()
    True
    """
    return Settings(
        period=period_s, speed_limit=speed_limit_kmh * KMH, window=smoothing, least_distance=least_distance_km * _KM
    )


def cleaned(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of cleaning, in the place of its argument `settings`, which is made of them.

    Examples
    --------
    >>> @cleaned
    ... def look(*, settings: Settings) -> None:
    ...     print(settings.window)
    >>> look(smoothing=5)
    5
    >>> list(signature(look).parameters)
    ['speed_limit_kmh', 'period_s', 'smoothing', 'least_distance_km']
    """
    options = signature(cleaning).parameters
    own = signature(command)

    @wraps(command)
    def called(**given: Any) -> None:
        settings = cleaning(**{name: given.pop(name) for name in options if name in given})
        command(**given, settings=settings)

    shown: list[Parameter] = []
    for name, parameter in own.parameters.items():
        added = options.values() if name == "settings" else [parameter]
        shown += [each.replace(kind=Parameter.KEYWORD_ONLY) for each in added]
    called.__signature__ = own.replace(parameters=shown)  # type: ignore[attr-defined]
    return called
