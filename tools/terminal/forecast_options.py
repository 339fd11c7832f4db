"""The options of commands that forecast, and what they do: learn from earlier days, make a pipeline, and run it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from math import inf
from pathlib import Path
from typing import Annotated, Any

import typer

from socast.core.cleaning.elevation_map import ElevationMap
from socast.core.errors import SettingsError
from socast.core.models import LinearModel, Model
from socast.core.pipeline import Pipeline
from socast.core.settings import Limits, Settings
from socast.core.wire.shard import Shard
from socast.stream.elevation_files import open_elevation
from socast.stream.loop import Tally, collect_garbage_rarely, feed, run
from socast.stream.mcap_reader import McapSource
from socast.stream.recording_metadata import list_changed_settings, make_metadata
from socast.stream.source import Sink, Source, merge_sources
from socast.stream.zenoh_session import parse_prefix
from socast.tools.terminal.cleaning_options import ElevationFiles, insert_cleaning_options
from socast.tools.terminal.live_table import LiveTable
from socast.tools.terminal.model_comparison import ModelNames, find_models
from socast.tools.terminal.option_groups import insert_options
from socast.tools.terminal.output import EffectFiles, VehicleFiles, select_model_files
from socast.tools.terminal.recordings import open_recordings, show_progress, warn_of_losses

Prefix = Annotated[
    str, typer.Option(metavar="P", help="Key chunks before `fleet`, `weather` and `models`, such as montreal.")
]


WarmUp = Annotated[
    list[Path] | None,
    typer.Option(
        "--warm-up",
        metavar="REC",
        help="Learn from this recording of earlier days first, so that forecasts have intervals from the beginning; "
        "may be repeated.",
    ),
]


@dataclass(frozen=True)
class ForecastOptions:
    """Hold the values of the options that `live` and `replay` share.

    Parameters
    ----------
    models : sequence of str
        Names or files of models. The first model makes the forecasts, and the others run as its shadows.
    effect_files, vehicle_files : sequence of Path
        Files of user-defined effects, which are already loaded.
    prefix : str
        Key chunks before those of the wire contract, without a slash at the end.
    warm_up : sequence of Path
        Recordings of earlier days to learn from first.
    elevation : sequence of Path
        Maps that correct the elevation of fixes.
    """

    models: Sequence[str]
    effect_files: Sequence[Path]
    vehicle_files: Sequence[Path]
    settings: Settings
    prefix: str
    warm_up: Sequence[Path]
    elevation: Sequence[Path]

    def find_models(self, folder: Path | None) -> "ForecastOptions":
        """Return these options with the fitted model in the folder of the recordings, where they name no model."""
        return replace(self, models=find_models(self.models, folder))

    @property
    def files(self) -> list[Path]:
        """Return the files that the command reads and must not overwrite."""
        return [
            *self.warm_up,
            *select_model_files(self.models),
            *self.effect_files,
            *self.vehicle_files,
            *self.elevation,
        ]


@insert_cleaning_options
def _make_options(
    *,
    model: ModelNames = None,
    effects_file: EffectFiles = None,
    vehicles: VehicleFiles = None,
    settings: Settings,
    prefix: Prefix = "",
    warm_up: WarmUp = None,
    elevation: ElevationFiles = None,
) -> ForecastOptions:
    """Return the values of the options."""
    return ForecastOptions(
        model or (), effects_file or (), vehicles or (), settings, prefix, warm_up or (), elevation or ()
    )


insert_forecast_options = insert_options("options", _make_options, "Models and forecasts")
"""Decorator that gives a command the shared options in place of its argument `options`, a `ForecastOptions`."""


def make_pipeline(
    options: ForecastOptions,
    models: Sequence[LinearModel],
    limits: Limits = Limits(),  # noqa: B008 - immutable
    *,
    replayed: Sequence[McapSource] = (),
    warm: bool = True,
    keep_outlooks: bool = False,
    shard: Shard | None = None,
) -> Pipeline:
    """Return a pipeline that cleans and forecasts with the values of the options."""
    first, *shadows = models
    prefix = parse_prefix(options.prefix)
    elevation_map = open_elevation(options.elevation)
    earlier = options.warm_up if warm else None
    learned = learn_from_recordings(first, shadows, options.settings, earlier, replayed, elevation_map)
    pipeline = Pipeline(
        first,
        options.settings,
        prefix,
        shadows=shadows,
        keep_outlooks=keep_outlooks,
        elevation_map=elevation_map,
        limits=limits,
    )
    if shard:  # each shard publishes the errors of its models under a key of its own
        pipeline.shadows.prefix = f"{prefix}socast/shards/{shard.chunk}/"
    if learned:
        pipeline.learn_from(learned, shard.has if shard and shard.by == "name" else lambda _: True)
    return pipeline


def describe_forecasts(
    command: str, options: ForecastOptions, models: Sequence[LinearModel], also: Mapping[str, Any] | None = None
) -> dict[str, str]:
    """Return the metadata of a recording that a command with the shared options writes."""
    return make_metadata(
        command,
        prefix=options.prefix,
        models=[f"{model.name}/{model.version}" for model in models],
        settings=list_changed_settings(options.settings, Settings()) | dict(also or {}),
    )


@collect_garbage_rarely()
def learn_from_recordings(
    model: Model,
    shadows: Sequence[Model],
    settings: Settings,
    recordings: Sequence[Path] | None,
    replayed: Sequence[McapSource] = (),
    elevation_map: ElevationMap | None = None,
) -> Pipeline | None:
    """Return a pipeline that has processed recordings, for `Pipeline.learn_from`."""
    if not recordings:
        return None
    sources = open_recordings(recordings)
    _refuse_later(sources, replayed)
    pipeline = Pipeline(model, settings, shadows=shadows, keep_tables=False, elevation_map=elevation_map)
    with show_progress(sources, words="learning") as step:
        for _ in feed(merge_sources(sources), pipeline, close=False):
            pipeline.forecasts(newest_only=True)  # discards all forecasts
            pipeline.model_errors(newest_only=True)
            step()
    warn_of_losses(sources)
    return pipeline


def _refuse_later(earlier: Sequence[McapSource], replayed: Sequence[McapSource]) -> None:
    """Refuse recordings that end after the replayed ones have begun."""
    begin = min((source.span_ns[0] for source in replayed if source.span_ns), default=inf)
    for source in earlier:
        if source.span_ns and source.span_ns[1] > begin:
            raise SettingsError(
                f"--warm-up {source.path} ends at {_format_time(source.span_ns[1])}, after the replay begins at "
                f"{_format_time(begin)}: forecasts would know their outcomes; give recordings that end before"
            )


def _format_time(time_ns: float) -> str:
    """Return the text of a time in UTC."""
    return f"{datetime.fromtimestamp(time_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def run_forecasts(
    pipeline: Pipeline,
    sources: Sequence[McapSource],
    source: Source | None = None,
    rate: float = inf,
    sinks: Sequence[Sink] = (),
    also: Callable[[], None] = lambda: None,
    zone: tzinfo | None = UTC,
) -> Tally:
    """Pass recordings through the loop, with a progress bar at full speed and a table of cars at any other speed.

    Parameters
    ----------
    source : Source, optional
        Messages of the recordings, for example paced. By default they are merged in time order.
    """
    shown = LiveTable(pipeline, "Replay", silent=rate == inf, zone=zone)
    with show_progress(sources, shown=rate == inf) as step, shown as table:

        def watch(tally: Tally) -> None:
            step()
            also()
            table(tally)

        return run(merge_sources(sources) if source is None else source, pipeline, sinks, watch=watch)
