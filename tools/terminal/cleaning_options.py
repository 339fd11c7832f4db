"""The settings of cleaning, and the maps of elevation, as command-line options that are the same for every command."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console

from socast.core.columns import KMH
from socast.core.settings import LIMITS, Settings
from socast.tools.terminal.option_groups import insert_options
from socast.tools.terminal.output import print_plain

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

ElevationFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--elevation",
        metavar="FILE",
        help="Correct the elevation of fixes by this map: an SRTM tile (.hgt, .hgt.gz, .zip), a GeoTIFF (.tif), or a "
        "map of `socast elevation learn` (.parquet); may be repeated.",
    ),
]
MOST_TILES = 5
"""Largest number of tiles that a warning names."""


def describe_outside(quality: Mapping[str, Any]) -> str:
    """Return one line about the fixes that lie outside the maps; nothing where all lie inside, or without maps.

    The offset of a car that has been on a map is subtracted from its fixes outside as well, so that they keep the datum
    of the map. A car that has never been on a map is followed by its fixes as reported.

    Examples
    --------
    >>> describe_outside({"elevation_map": {"fixes": 9, "outside": 2, "outside_by_tile": {"N45W074": 2}}})
    '2 of 9 fixes lie outside the maps of --elevation, in N45W074; there they count without a map'
    """
    counts = quality.get("elevation_map", {})
    if not counts.get("outside"):
        return ""
    tiles = sorted(counts["outside_by_tile"], key=counts["outside_by_tile"].__getitem__, reverse=True)
    more = f" and {len(tiles) - MOST_TILES} more tiles" if len(tiles) > MOST_TILES else ""
    return (
        f"{counts['outside']:,} of {counts['fixes']:,} fixes lie outside the maps of --elevation, in "
        f"{', '.join(tiles[:MOST_TILES])}{more}; there they count without a map"
    )


def warn_outside(quality: Mapping[str, Any]) -> None:
    """Print one line on standard error about the fixes that lie outside the maps, if there are any."""
    if line := describe_outside(quality):
        print_plain(Console(stderr=True), line, style="yellow")
