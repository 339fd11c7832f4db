"""The options that `live` and `replay` share: which models forecast, how telemetry is cleaned, what is learned first."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from core.models import LinearModel
from core.pipeline import Pipeline
from core.settings import Settings
from stream.mcap_reader import McapSource
from stream.zenoh_session import parse_prefix
from tools.terminal.cleaning_options import insert_cleaning_options
from tools.terminal.model_comparison import ModelNames
from tools.terminal.option_groups import insert_options
from tools.terminal.output import EffectFiles, select_model_files
from tools.terminal.warm_up import WarmUp, learn_from_recordings

Prefix = Annotated[
    str, typer.Option(metavar="P", help="Key chunks before `fleet`, `weather` and `models`, such as montreal.")
]


@dataclass(frozen=True)
class ForecastOptions:
    """The values of the options that `live` and `replay` share.

    Parameters
    ----------
    models : sequence of str
        Names or files; the first makes the forecasts, the others run in its shadow.
    effect_files : sequence of Path
        Files of the user's own effects, loaded already.
    settings : Settings
        Of cleaning.
    prefix : str
        Key chunks before those of the wire contract, without a slash at the end.
    warm_up : sequence of Path
        Recordings of earlier days to learn from first.
    """

    models: Sequence[str]
    effect_files: Sequence[Path]
    settings: Settings
    prefix: str
    warm_up: Sequence[Path]

    @property
    def files(self) -> list[Path]:
        """The files that are read and must not be overwritten."""
        return [*self.warm_up, *select_model_files(self.models), *self.effect_files]


@insert_cleaning_options
def _make_options(
    *,
    model: ModelNames = None,
    effects_file: EffectFiles = None,
    settings: Settings,
    prefix: Prefix = "",
    warm_up: WarmUp = None,
) -> ForecastOptions:
    """Return what the options say."""
    return ForecastOptions(model or (), effects_file or (), settings, prefix, warm_up or ())


insert_forecast_options = insert_options("options", _make_options)
"""Decorator that gives a command the shared options in place of its argument `options`, a `ForecastOptions`."""


def make_pipeline(
    options: ForecastOptions,
    models: Sequence[LinearModel],
    *,
    replayed: Sequence[McapSource] = (),
    warm: bool = True,
    keep_outlooks: bool = False,
) -> Pipeline:
    """Return a pipeline that cleans and forecasts as the options say.

    Parameters
    ----------
    options : ForecastOptions
    models : sequence of LinearModel
        Those of the options, loaded.
    replayed : sequence of McapSource
        Recordings to be forecast; those to learn from must end before they begin.
    warm : bool
        Learn from the recordings of `--warm-up`.
    keep_outlooks : bool
        Keep every outlook for `Pipeline.take_outlooks`.

    Returns
    -------
    Pipeline

    Raises
    ------
    SettingsError
        Where the prefix is not plain, or a recording to learn from ends too late.
    RecordingError
        Where a recording to learn from cannot be read.
    """
    first, *shadows = models
    prefix = parse_prefix(options.prefix)
    learned = learn_from_recordings(first, shadows, options.settings, options.warm_up, replayed) if warm else None
    pipeline = Pipeline(first, options.settings, prefix, shadows=shadows, keep_outlooks=keep_outlooks)
    if learned:
        pipeline.learn_from(learned)
    return pipeline
