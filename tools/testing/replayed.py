"""Replay recordings to tables of forecasts, rides and counters."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from socast.core.errors import SettingsError, suggest_names
from socast.core.forecast.forecast_table import is_forecast, tabulate_forecasts
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.stream.loop import feed
from socast.stream.mcap_writer import replace_recording
from socast.stream.source import merge_sources
from socast.stream.structured_log import flatten_counts
from socast.tools.terminal.forecast_options import ForecastOptions, make_pipeline
from socast.tools.terminal.live_table import add_predictions
from socast.tools.terminal.model_comparison import load_models
from socast.tools.terminal.output import load_effects, load_vehicles
from socast.tools.terminal.recordings import open_recordings


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
    losses : tuple of str
        What of the recordings was damaged and could not be read, one line each.
    """

    forecasts: pd.DataFrame
    rides: pd.DataFrame
    quality: pd.DataFrame
    file: Path
    losses: tuple[str, ...] = ()


def replay_recordings(recordings: Sequence[str | Path], options: ForecastOptions, out: Path) -> Replayed:
    """Replay recordings, or folders that hold some, merged in the order of time."""
    if not recordings:
        raise SettingsError("no recording to replay; give an MCAP file, or a folder of them")
    models = load_models(options.models)
    sources = open_recordings([Path(each) for each in recordings])
    pipeline = make_pipeline(options, models, replayed=sources)
    forecasts = []
    for _ in feed(merge_sources(sources), pipeline):
        forecasts += [each for each in pipeline.forecasts() if is_forecast(each)]
    with replace_recording(out) as sink:
        sink.put(forecasts)
    losses = tuple(f"{source.path}: {line}" for source in sources for line in source.losses.lines())
    return Replayed(tabulate_forecasts(forecasts), *take_tables(pipeline), out, losses)


def make_options(
    model: str | Path,
    *,
    warm_up: Sequence[str | Path] = (),
    effects: Sequence[str | Path] = (),
    vehicles: Sequence[str | Path] = (),
    elevation: Sequence[str | Path] = (),
    settings: Mapping[str, Any] | None = None,
) -> ForecastOptions:
    """Return the options of a replay, with the files of effects and vehicles loaded."""
    files = [[Path(each) for each in group] for group in (effects, vehicles, warm_up, elevation)]
    load_effects(files[0])
    load_vehicles(files[1])
    if unknown := sorted(set(settings or {}) - set(Settings._fields)):
        raise SettingsError(f"there is no setting {unknown[0]!r}; {suggest_names(unknown[0], Settings._fields)}")
    return ForecastOptions([str(model)], files[0], files[1], Settings(**dict(settings or {})), "", files[2], files[3])


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
