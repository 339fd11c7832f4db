"""`socast elevation`: learn a map of elevation from recordings, and show what a map knows."""

from collections.abc import Iterator, Sequence
from math import degrees
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer

from socast.core.batch import Lanes
from socast.core.cleaning.elevation_map import ElevationPlaces
from socast.core.cleaning.kernel import Cleaner
from socast.core.errors import SettingsError
from socast.core.fit.elevation_learning import ElevationFixes, MapSummary, join_fixes, learn_elevation, select_fixes
from socast.core.settings import Settings
from socast.core.wire.decoder import Decoder
from socast.stream.elevation_files import SUFFIX, read_places, write_places
from socast.stream.mcap_reader import McapSource
from socast.stream.source import merge_sources
from socast.tools.terminal.cleaning_options import insert_cleaning_options
from socast.tools.terminal.output import JsonFile, check_outputs, make_console, print_plain, write_json
from socast.tools.terminal.recordings import Recordings, open_recordings, refuse_unusable, show_progress, warn_of_losses
from socast.tools.terminal.rich_table import make_description

app = typer.Typer(help="Maps of elevation, learned from the fleet's own fixes.", no_args_is_help=True)

SHARES: Final = (50, 90)
"""Shares of the places whose uncertainty is shown. [%]"""


@app.command("learn")
@insert_cleaning_options
def learn(
    recordings: Recordings,
    *,
    out: Annotated[Path, typer.Option("--out", "-o", metavar=f"MAP{SUFFIX}", help="Map to write.")],
    settings: Settings,
    json_file: JsonFile = None,
) -> None:
    """Learn a map of elevation from the fixes of a fleet.

    The map has the elevation of every place about 20 m apart near which cars have driven, with its uncertainty. The
    offsets of loggers to each other are estimated and removed. Commands that clean samples take the map with
    --elevation.

    Examples
    --------
    socast elevation learn kept/*.mcap -o city.parquet
    socast tables tomorrow.mcap --elevation city.parquet --out tables
    """
    if out.suffix != SUFFIX:
        raise SettingsError(f"--out {out}: a map of elevation ends in {SUFFIX}; name it {out.with_suffix(SUFFIX)}")
    sources = open_recordings(recordings)
    check_outputs(recordings, out, json_file)
    places, summary = learn_elevation(join_fixes(_collect(sources, settings)))
    write_places(places, out)
    write_json(json_file, "elevation", {"learned": summary._asdict(), "map": describe(places)})
    console = make_console(json_file)
    console.print(make_description(_describe_rows(places, summary)))
    print_plain(console, f"{len(places):,} places in {out}")
    warn_of_losses(sources)


@app.command("show")
def show(
    file: Annotated[Path, typer.Argument(metavar=f"MAP{SUFFIX}", help="Map that `socast elevation learn` wrote.")],
    json_file: JsonFile = None,
) -> None:
    """Show the extent of a learned map and the uncertainty of its places.

    Examples
    --------
    socast elevation show city.parquet
    """
    places = read_places(file)
    write_json(json_file, "elevation", {"map": describe(places)})
    make_console(json_file).print(make_description(_describe_rows(places)))


def _collect(sources: Sequence[McapSource], settings: Settings) -> Iterator[ElevationFixes]:
    """Yield the fixes of recordings from which a map can be learned; refuse recordings without a usable message."""
    lanes = Lanes()
    decoder, cleaner = Decoder(lanes), Cleaner(settings)
    with show_progress(sources) as step:
        for messages in merge_sources(sources):
            batch, _ = decoder.decode(messages)
            yield select_fixes(batch, cleaner.clean(batch, len(lanes)))
            step()
    refuse_unusable(sources, decoder.received.total())


def describe(places: ElevationPlaces) -> dict[str, Any]:
    """Return the extent of a learned map and the uncertainty of its places.

    Returns
    -------
    dict
        `places`; `fixes`; `latitude_deg`, `longitude_deg` and `elevation_m`, each the least and the largest value;
        `sd_m`, the standard uncertainty that a share of the places does not exceed, by the share in percent.
    """
    extents = {
        "latitude_deg": degrees(places.step_latitude) * places.row,
        "longitude_deg": degrees(places.step_longitude) * places.column,
        "elevation_m": places.elevation,
    }
    return {
        "places": len(places),
        "fixes": int(places.fixes.sum()),
        **{name: [round(float(values.min()), 6), round(float(values.max()), 6)] for name, values in extents.items()},
        "sd_m": {str(share): round(float(np.percentile(places.sd, share)), 3) for share in SHARES},
    }


def _describe_rows(places: ElevationPlaces, summary: MapSummary | None = None) -> list[tuple[str, str]]:
    """Return labels and texts that describe a map, and how it was learned if that is known."""
    about = describe(places)
    south, north = about["latitude_deg"]
    west, east = about["longitude_deg"]
    low, high = about["elevation_m"]
    rows = [
        ("places", f"{about['places']:,}, with {about['fixes']:,} fixes"),
        ("extent", f"{south:.3f} to {north:.3f}° N, {west:.3f} to {east:.3f}° E, {low:.0f} to {high:.0f} m"),
        ("uncertainty", ", ".join(f"{share} % of places up to {sd:.2f} m" for share, sd in about["sd_m"].items())),
    ]
    if summary:
        rows += [
            (
                "fixes",
                f"{summary.fixes:,} of {summary.cars:,} cars on {summary.rides:,} rides, error {summary.fix_sd:.1f} m",
            ),
            ("offsets", f"cars {summary.car_sd:.1f} m, rides of a car {summary.ride_sd:.1f} m (standard deviations)"),
        ]
    return rows
