"""Replay recordings to tables of forecasts, rides and counters."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from socast.core import models
from socast.core.errors import SettingsError
from socast.core.forecast.forecast_table import is_forecast, tabulate_forecasts
from socast.core.pipeline import Pipeline
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.source import merge_sources
from socast.stream.structured_log import flatten_counts
from socast.tools.terminal.live_table import add_predictions


class Replayed(NamedTuple):
    """Hold what a replay, or a live consumer, gave.

    Parameters
    ----------
    forecasts : DataFrame
        One row per forecast with the fields of the message; those of an object have its name before them, such as
        `range_km.mean`.
    rides : DataFrame
        The ride table, with `predicted_kwh` and `error_pct` of the model, in order of the rides' starts.
    quality : DataFrame
        Counters of messages, and of the samples that were repaired or rejected: the column `count` by `counter`, such
        as `samples.speed_rejected`.
    file : Path
        Recording of the forecasts.
    """

    forecasts: pd.DataFrame
    rides: pd.DataFrame
    quality: pd.DataFrame
    file: Path


def list_recordings(recordings: Sequence[str | Path]) -> list[Path]:
    """Return recordings, where a folder stands for those in it."""
    files: list[Path] = []
    for path in map(Path, recordings):
        inside = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        if not inside:
            raise SettingsError(f"{path}: no *.mcap in this folder; give a recording, or a folder of recordings")
        files += inside
    if not files:
        raise SettingsError("no recording to replay; give an MCAP file, or a folder of them")
    return files


def replay_recordings(recordings: Sequence[str | Path], model: str | Path, out: Path) -> Replayed:
    """Replay recordings, or folders that hold some, merged in the order of time, through a model."""
    files = list_recordings(recordings)
    pipeline = Pipeline(models.load(str(model)))
    forecasts = []
    for messages in merge_sources([McapSource(file) for file in files]):
        forecasts += [each for each in pipeline.push(messages) if is_forecast(each)]
    forecasts += [each for each in pipeline.finish() if is_forecast(each)]
    with McapSink(out) as sink:
        sink.put(forecasts)
    return Replayed(tabulate_forecasts(forecasts), *take_tables(pipeline), out)


def take_tables(pipeline: Pipeline) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the rides that have ended since the last call, with the predictions of the model, and all counters."""
    return sort_rides(add_predictions(pipeline.take_rides(), pipeline.shadows)), tabulate_counters(pipeline.quality())


def sort_rides(rides: pd.DataFrame) -> pd.DataFrame:
    """Return rides in the order of their starts."""
    return rides.sort_values(["start_s", "vehicle_id"], ignore_index=True)


def tabulate_counters(quality: Mapping[str, Any]) -> pd.DataFrame:
    """Return counters as a table with the column `count`, by the name of the counter."""
    counts = flatten_counts(quality, keep_zeros=True)
    names = pd.Index(list(counts), name="counter", dtype=object)
    return pd.DataFrame(
        {"count": pd.to_numeric(pd.Series(list(counts.values()), dtype=object)).to_numpy()}, index=names
    )
