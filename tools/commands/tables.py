"""`socast tables`: clean recordings and write a ride table, a window table and a quality report."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import pandas as pd
import typer
from rich.console import Console

from socast.core import effects, models
from socast.core.errors import SettingsError
from socast.core.formatting import format_count
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.stream.elevation_files import open_elevation
from socast.stream.mcap_reader import McapSource
from socast.stream.source import merge_sources
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.cluster.run import REPORT, tabulate_by_workers
from socast.tools.terminal.cleaning_options import insert_cleaning_options
from socast.tools.terminal.cluster_option import insert_cluster_options
from socast.tools.terminal.elevation_option import ElevationFiles, warn_outside
from socast.tools.terminal.model_comparison import DEFAULT_MODEL
from socast.tools.terminal.output import (
    EffectFiles,
    JsonFile,
    ModelName,
    VehicleFiles,
    check_outputs,
    make_console,
    select_model_files,
    write_json,
)
from socast.tools.terminal.parquet_table import ParquetTable
from socast.tools.terminal.recordings import (
    Recordings,
    open_recordings,
    refuse_unusable,
    show_progress,
    warn_of_loggers,
    warn_of_losses,
)
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.terminal.table_files import read as read_tables
from socast.tools.terminal.table_source import QUALITY, describe_source

RECORDING = ".mcap"
RIDES, WINDOWS = "rides.parquet", "windows.parquet"

COUNTED_BY_NAME = ("received", "undecodable", "unfit", "unpredicted", "unpredictable")
"""Counters that are written in the order of their names; that of their first count depends on the workers."""
ROW_GROUP = 2000
"""Number of rides per row group; it keeps memory independent of the length of the recording."""


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
    read = [*recordings, *select_model_files([model]), *(effects_file or ()), *(vehicles or ()), *(elevation or ())]
    source = {"source": describe_source(folder, recordings, settings, elevation or ())}
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
    rows = _write_tables(sources, pipeline, folder, kept.append if json_file else lambda _: None)
    ended = pd.concat(kept) if json_file else pd.DataFrame()
    _finish(sources, pipeline.quality() | source, *rows, folder, json_file, ended)


def _write_tables(
    sources: Sequence[McapSource],
    pipeline: Pipeline,
    folder: Path,
    also: Callable[[pd.DataFrame], None] = lambda _: None,
) -> tuple[int, int]:
    """Write the tables of recordings into a folder, pass ended rides on, and return the numbers of rows."""
    rides, windows = ParquetTable(folder / RIDES), ParquetTable(folder / WINDOWS)

    def write(ended: pd.DataFrame, parts: pd.DataFrame) -> None:
        rides.append(ended)
        windows.append(parts)
        also(ended)

    with rides, windows:
        tabulate(sources, pipeline, write)
    return rides.rows, windows.rows


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


def tabulate(
    sources: Sequence[McapSource],
    pipeline: Pipeline,
    take: Callable[[pd.DataFrame, pd.DataFrame], None],
    report: Callable[[float], None] | None = None,
) -> None:
    """Make ride and window tables of recordings, with a progress bar.

    Parameters
    ----------
    take : callable
        Function that receives the ended rides and their windows. It is called for every `ROW_GROUP` rides and at the
        end.
    report : callable, optional
        Function that receives the share of the recordings that was read, in place of the progress bar. [1]
    """
    taken = 0
    blocks = max(sum(source.blocks for source in sources), 1)
    with show_progress(sources, shown=report is None) as step:
        for messages in merge_sources(sources):
            pipeline.take(messages)
            step()
            if report:
                report(sum(source.blocks_read for source in sources) / blocks)
            if (ended := pipeline.quality()["rides"]) - taken >= ROW_GROUP:
                taken = ended
                take(pipeline.take_rides(), pipeline.take_windows())
        pipeline.finish()
        refuse_unusable(sources, sum(pipeline.quality()["received"].values()))
        take(pipeline.take_rides(), pipeline.take_windows())


def in_memory(
    recordings: Sequence[Path],
    wanted: Sequence[str],
    report: Callable[[float], None] | None = None,
    settings: Settings | None = None,
    elevation: Sequence[Path] = (),
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the ride table and the window table of recordings, and print warnings about data that could not be read.

    Parameters
    ----------
    wanted : sequence of str
        Names of the effects that the tables contain in addition to the default ones.
    """
    pipeline = Pipeline(
        settings=settings or Settings(),
        also=wanted,
        keep_forecasts=False,
        two_sided=True,
        elevation_map=open_elevation(elevation),
    )
    sources = open_recordings(recordings)
    parts: list[tuple[pd.DataFrame, pd.DataFrame]] = []
    tabulate(sources, pipeline, lambda rides, windows: parts.append((rides, windows)), report)
    warn_of_losses(sources)
    rides, windows = (pd.concat(tables, ignore_index=True) for tables in zip(*parts, strict=True))
    return rides, windows


@contextmanager
def make_table_folder(recordings: Sequence[Path], wanted: Sequence[str], settings: Settings) -> Iterator[Path]:
    """Yield a temporary folder with the tables of recordings, whose memory does not grow with their length.

    Parameters
    ----------
    wanted : sequence of str
        Names of the effects that the tables contain in addition to the default ones.
    """
    pipeline = Pipeline(settings=settings, also=wanted, keep_forecasts=False, two_sided=True)
    sources = open_recordings(recordings)
    with TemporaryDirectory(prefix="tables-") as folder:
        _write_tables(sources, pipeline, Path(folder))
        warn_of_losses(sources)
        yield Path(folder)


@contextmanager
def tables_by_workers(
    given: Sequence[Path],
    place: ClusterPlace | None,
    wanted: Sequence[str],
    effect_files: Sequence[Path],
    vehicle_files: Sequence[Path],
    settings: Settings | None = None,
) -> Iterator[Sequence[Path]]:
    """Yield a folder of tables that workers have made of recordings; without workers yield the recordings."""
    if place is None or not given:
        yield given
        return
    files = [file for path in given for file in (sorted(path.glob(f"*{RECORDING}")) or [path])]
    if other := [path for path in files if path.suffix != RECORDING]:
        raise SettingsError(f"--cluster makes tables of recordings, and {other[0]} is none; leave out --cluster")
    sources = open_recordings(files)
    with TemporaryDirectory(prefix="tables-", dir=Path.cwd() if place.address else None) as folder:
        tabulate_by_workers(
            sources,
            Path(folder),
            place,
            model=EXTENDED_PHYSICAL.name,
            wanted=wanted,
            settings=settings or Settings(),
            effect_files=effect_files,
            vehicle_files=vehicle_files,
        )
        warn_of_losses(sources)
        yield [Path(folder)]


def show(quality: dict[str, Any], rides: int, windows: int, folder: Path, console: Console) -> None:
    """Print the counts of repaired, rejected and missing data, and of written rows."""
    columns = [Column("cause"), Column("count", number=True), Column("of", number=True)]
    table = make_table(columns, "What was repaired, rejected or missing")
    samples = quality["received"].get("telemetry", 0)
    for cause, count in quality["samples"].items():
        if count:
            table.add_row(cause.replace("_", " "), f"{count:,}", format_count(samples, "sample"))
    for cause, count in quality["undecodable"].items():
        table.add_row(cause.replace("_", " "), f"{count:,}", "payloads")
    for reason, count in quality["unfit"].items():
        table.add_row(f"ride {reason.replace('_', ' ')}", f"{count:,}", format_count(rides, "ride"))
    messages = format_count(quality["received"].get("vehicle", 0), "vehicle message")
    for reason, count in quality["unpredicted"].items():
        table.add_row(f"not predicted: {reason.replace('_', ' ')}", f"{count:,}", format_count(rides, "ride"))
    for reason, count in quality["unpredictable"].items():
        table.add_row(reason.replace("_", " "), f"{count:,}", messages)
    if table.rows:
        console.print(table)
    unfit = sum(quality["unfit"].values())
    rows = f"{format_count(rides, 'ride')} ({unfit:,} unfit for training) and {format_count(windows, 'window')}"
    console.print(f"{rows} in {folder}", markup=False, highlight=False, soft_wrap=True)
