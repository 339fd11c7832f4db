"""The option `--elevation`: maps that correct the elevation of fixes, for every command that cleans samples."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

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
        Console(stderr=True).print(line, style="yellow", markup=False, highlight=False, soft_wrap=True)
