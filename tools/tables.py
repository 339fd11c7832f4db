"""`socast tables`: recordings in; ride table, window table and quality report out."""

import json
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from core import effects, models
from core.columns import KMH
from core.errors import SettingsError
from core.pipeline import Pipeline
from core.settings import Settings
from stream.mcap_io import McapSource
from stream.source import merged

ROW_GROUP = 2000
"""Rides between two row groups, so that memory does not grow with the recording."""


class ParquetTable:
    """A Parquet file that grows by row groups, its columns fixed by the first."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = 0
        self._writer: pq.ParquetWriter | None = None

    def append(self, table: pd.DataFrame) -> None:
        """Write a row group; text columns stay text even where a whole group is unknown."""
        if self._writer is None:
            text = {
                name
                for name, kind in table.dtypes.items()
                if not pd.api.types.is_numeric_dtype(kind) and not pd.api.types.is_bool_dtype(kind)
            }
            inferred = pa.Schema.from_pandas(table, preserve_index=False)
            self._schema = pa.schema([pa.field(f.name, pa.string() if f.name in text else f.type) for f in inferred])
            self._writer = pq.ParquetWriter(self.path, self._schema, compression="zstd")
        self._writer.write_table(pa.Table.from_pandas(table, schema=self._schema, preserve_index=False))
        self.rows += len(table)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()


def tables(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC…", help="MCAP recordings, merged in time order.")],
    out: Annotated[Path, typer.Option(help="Folder for rides.parquet, windows.parquet and quality.json.")],
    model: Annotated[
        str, typer.Option(help="Model whose effects must be summed: a name or a file.")
    ] = "extended_physical",
    effects_file: Annotated[list[Path] | None, typer.Option("--effects", help="A file of your own effects.")] = None,
    speed_limit_kmh: Annotated[float, typer.Option(help="Faster samples are rejected.")] = 130.0,
    period_s: Annotated[float, typer.Option(help="Nominal time between two samples.")] = 3.0,
    smoothing: Annotated[int, typer.Option(help="Samples in the moving average of speed, 1 to 8.")] = 3,
    least_distance_km: Annotated[float, typer.Option(help="Shorter rides are unfit for training.")] = 0.2,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the rides as JSON, too.")] = None,
) -> None:
    """Clean recordings and sum them up: one row a ride, one row a window, and what was rejected, by cause."""
    for path in effects_file or []:
        effects.load_file(path)
    settings = Settings(
        period=period_s, speed_limit=speed_limit_kmh * KMH, window=smoothing, least_distance=least_distance_km * 1e3
    )
    pipeline = Pipeline(models.load(model), settings, also=list(effects.library()))
    sources = [McapSource(path) for path in recordings]
    folder = _folder(out)
    rides, windows = ParquetTable(folder / "rides.parquet"), ParquetTable(folder / "windows.parquet")
    kept: list[pd.DataFrame] = []
    console = Console(stderr=True)
    columns = TextColumn("cleaning"), BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("cleaning", total=sum(source.blocks for source in sources))
        watched = [progress.track(source, task_id=bar, total=None) for source in sources]
        for messages in merged(watched):
            pipeline.push(messages)
            if pipeline.quality()["rides"] - rides.rows >= ROW_GROUP:
                _take(pipeline, rides, windows, kept if json_file else None)
        pipeline.finish()
        _take(pipeline, rides, windows, kept if json_file else None)
    rides.close()
    windows.close()
    quality = pipeline.quality() | {"lost": {s.path.name: s.losses.lines() for s in sources if s.losses}}
    (folder / "quality.json").write_text(json.dumps(quality, indent=2) + "\n", encoding="utf-8")
    if json_file:
        pd.concat(kept).to_json(json_file, orient="records", indent=1)
    show(quality, rides.rows, windows.rows, folder, Console())


def _folder(path: Path) -> Path:
    """Return a folder that exists."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"--out {path}: {error.strerror}; name a folder that can be made") from error
    return path


def _take(pipeline: Pipeline, rides: ParquetTable, windows: ParquetTable, kept: list[pd.DataFrame] | None) -> None:
    """Write what has ended since the last time."""
    table = pipeline.take_rides()
    rides.append(table)
    windows.append(pipeline.take_windows())
    if kept is not None:
        kept.append(table)


def show(quality: dict[str, Any], rides: int, windows: int, folder: Path, console: Console) -> None:
    """Print what was read, repaired, rejected and written."""
    table = Table(title="What was repaired, rejected or missing", title_justify="left")
    table.add_column("cause")
    table.add_column("count", justify="right")
    table.add_column("of", justify="right")
    samples = quality["received"].get("telemetry", 0)
    for cause, count in quality["samples"].items():
        if count:
            table.add_row(cause.replace("_", " "), f"{count:,}", f"{samples:,} samples")
    for cause, count in quality["undecodable"].items():
        table.add_row(cause.replace("_", " "), f"{count:,}", "payloads")
    for reason, count in quality["unfit"].items():
        table.add_row(f"ride {reason.replace('_', ' ')}", f"{count:,}", f"{rides:,} rides")
    for reason, count in quality["unpredictable"].items():
        table.add_row(reason.replace("_", " "), f"{count:,}", "kinds of vehicle")
    console.print(table)
    for name, lines in quality["lost"].items():
        for line in lines:
            console.print(f"[yellow]{name}: {line}")
    unfit = sum(quality["unfit"].values())
    console.print(f"{rides:,} rides ({unfit:,} unfit for training) and {windows:,} windows in {folder}")
