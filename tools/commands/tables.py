"""`socast tables`: clean recordings and write a ride table, a window table and a quality report."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer
from rich.console import Console

from socast.core import effects, models
from socast.core.errors import SettingsError
from socast.core.formatting import format_count
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.stream.elevation_files import open_elevation
from socast.stream.mcap_reader import McapSource
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.cluster.run import REPORT, tabulate_by_workers
from socast.tools.terminal.cleaning_options import ElevationFiles, insert_cleaning_options, warn_outside
from socast.tools.terminal.cluster_option import insert_cluster_options
from socast.tools.terminal.model_comparison import DEFAULT_MODEL
from socast.tools.terminal.output import (
    EffectFiles,
    JsonFile,
    ModelName,
    VehicleFiles,
    check_outputs,
    make_console,
    print_plain,
    select_model_files,
    write_json,
)
from socast.tools.terminal.recordings import (
    Recordings,
    open_recordings,
    warn_of_loggers,
    warn_of_losses,
)
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.terminal.ride_source import RIDES, WINDOWS, write_tables
from socast.tools.terminal.table_files import QUALITY, describe_source
from socast.tools.terminal.table_files import read as read_tables

COUNTED_BY_NAME = ("received", "undecodable", "unfit", "unpredicted", "unpredictable")
"""Counters that are written in the order of their names; that of their first count depends on the workers."""


@insert_cluster_options
@insert_cleaning_options
def tables(
    recordings: Recordings,
    *,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for rides.parquet, windows.parquet, quality.json.")],
    model: ModelName = DEFAULT_MODEL,
    effects_file: EffectFiles = None,
    vehicles: VehicleFiles = None,
    settings: Settings,
    elevation: ElevationFiles = None,
    place: ClusterPlace | None,
    json_file: JsonFile = None,
) -> None:
    """Clean recordings and make tables: one row per ride, one row per window, and counts of rejected samples by cause.

    Examples
    --------
    socast tables recordings/shift.mcap --out tables
    socast tables kept/*.mcap --out tables --effects my_effects.py --period 1
    socast tables kept/*.mcap --out tables --cluster local:2
    """
    wanted, elevation_map = effects.list_tabulated(), open_elevation(elevation or ())
    loaded, sources, folder = models.load(model), open_recordings(recordings), _folder(out)
    read = [
        *(source.path for source in sources),
        *select_model_files([model]),
        *(effects_file or ()),
        *(vehicles or ()),
        *(elevation or ()),
    ]
    source = {"source": describe_source(folder, [each.path for each in sources], settings, elevation or ())}
    if place is not None:
        check_outputs(read, folder / QUALITY, folder / REPORT, json_file)
        made = tabulate_by_workers(
            sources,
            folder,
            place,
            model=model,
            wanted=wanted,
            settings=settings,
            effect_files=effects_file or (),
            vehicle_files=vehicles or (),
            elevation_files=elevation or (),
        )
        ended = read_tables([folder / RIDES]) if json_file else pd.DataFrame()
        _finish(sources, made.quality | source, made.rides, made.windows, folder, json_file, ended)
        return
    pipeline = Pipeline(
        loaded, settings, also=wanted, keep_forecasts=False, two_sided=True, elevation_map=elevation_map
    )
    check_outputs(read, folder / RIDES, folder / WINDOWS, folder / QUALITY, json_file)
    kept: list[pd.DataFrame] = []
    rows = write_tables(sources, pipeline, folder, kept.append if json_file else lambda _: None)
    ended = pd.concat(kept) if json_file else pd.DataFrame()
    _finish(sources, pipeline.quality() | source, *rows, folder, json_file, ended)


def _finish(
    sources: Sequence[McapSource],
    counts: dict[str, Any],
    rides: int,
    windows: int,
    folder: Path,
    json_file: Path | None,
    ended: pd.DataFrame,
) -> None:
    """Write the reports beside the tables, and print the counts."""
    by_name = {name: dict(sorted(counts[name].items())) for name in COUNTED_BY_NAME}
    quality = counts | by_name | {"lost": {str(s.path): s.losses.lines() for s in sources if s.losses}}
    write_json(folder / QUALITY, "quality", quality)
    if json_file:
        table = ended.astype(object)
        write_json(json_file, "tables", {"rides": table.where(table.notna(), None).to_dict("records")})
    console = make_console(json_file)
    show(quality, rides, windows, folder, console)
    warn_outside(quality)
    warn_of_loggers(quality)
    warn_of_losses(sources)


def _folder(path: Path) -> Path:
    """Create a folder if necessary, and return it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"--out {path}: {error.strerror}; name a folder that can be made") from error
    return path


def show(quality: dict[str, Any], rides: int, windows: int, folder: Path, console: Console) -> None:
    """Print the counts of repaired, rejected and missing data, and of written rows."""
    samples = format_count(quality["received"].get("telemetry", 0), "sample")
    messages = format_count(quality["received"].get("vehicle", 0), "vehicle message")
    of_rides = format_count(rides, "ride")
    counted = (
        ({cause: count for cause, count in quality["samples"].items() if count}, "", samples),
        (quality["undecodable"], "", "payloads"),
        (quality["unfit"], "ride ", of_rides),
        (quality["unpredicted"], "not predicted: ", of_rides),
        (quality["unpredictable"], "", messages),
    )
    rows = [
        (f"{what}{cause.replace('_', ' ')}", f"{count:,}", of)
        for counts, what, of in counted
        for cause, count in counts.items()
    ]
    if rows:
        columns = [Column("cause"), Column("count", number=True), Column("of", number=True)]
        console.print(make_table(columns, "What was repaired, rejected or missing", rows=rows))
    unfit = sum(quality["unfit"].values())
    made = f"{of_rides} ({unfit:,} unfit for training) and {format_count(windows, 'window')}"
    print_plain(console, f"{made} in {folder}")
