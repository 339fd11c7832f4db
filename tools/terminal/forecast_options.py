"""The options that `live` and `replay` share: models, settings of cleaning, key prefix and warm-up recordings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from socast.core.models import LinearModel
from socast.core.pipeline import Pipeline
from socast.core.settings import Limits, Settings
from socast.core.wire.shard import Shard
from socast.stream.elevation_files import open_elevation
from socast.stream.mcap_reader import McapSource
from socast.stream.recording_metadata import list_changed_settings, make_metadata
from socast.stream.zenoh_session import parse_prefix
from socast.tools.terminal.cleaning_options import insert_cleaning_options
from socast.tools.terminal.elevation_option import ElevationFiles
from socast.tools.terminal.model_comparison import ModelNames, find_models
from socast.tools.terminal.option_groups import insert_options
from socast.tools.terminal.output import EffectFiles, VehicleFiles, select_model_files
from socast.tools.terminal.warm_up import WarmUp, learn_from_recordings

Prefix = Annotated[
    str, typer.Option(metavar="P", help="Key chunks before `fleet`, `weather` and `models`, such as montreal.")
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
