"""The option `--warm-up`: a consumer or a replay first learns from recordings of earlier days."""

from collections.abc import Sequence
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from typing import Annotated

import typer

from socast.core.cleaning.elevation_map import ElevationMap
from socast.core.errors import SettingsError
from socast.core.models import Model
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.stream.loop import collect_garbage_rarely, feed
from socast.stream.mcap_reader import McapSource
from socast.stream.source import merge_sources
from socast.tools.terminal.recordings import open_recordings, show_progress, warn_of_losses

WarmUp = Annotated[
    list[Path] | None,
    typer.Option(
        "--warm-up",
        metavar="REC",
        help="Learn from this recording of earlier days first, so that forecasts have intervals from the beginning; "
        "may be repeated.",
    ),
]


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
