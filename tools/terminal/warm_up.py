"""What a consumer learns, before it begins, of recordings of earlier days: `--history`."""

from collections.abc import Sequence
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from typing import Annotated

import typer

from core.errors import SettingsError
from core.models import Model
from core.pipeline import Pipeline
from core.settings import Settings
from stream.loop import seldom_collecting
from stream.mcap_writer import McapSource
from stream.source import merged
from tools.terminal.recordings import opened, reading, warn_of_losses

History = Annotated[
    list[Path] | None,
    typer.Option(
        "--history",
        metavar="REC",
        help="Learn from this recording of earlier days first, so that forecasts have intervals at once; may be "
        "repeated.",
    ),
]


def learned(
    model: Model,
    shadows: Sequence[Model],
    settings: Settings,
    recordings: Sequence[Path] | None,
    replayed: Sequence[McapSource] = (),
) -> Pipeline | None:
    """Return a pipeline that has gone through recordings, None where there are none; `Pipeline.learn_from` takes it.

    Parameters
    ----------
    model : Model
        Makes the forecasts.
    shadows : sequence of Model
        Will run beside it.
    settings : Settings
    recordings : sequence of Path, optional
        Merged in time order.
    replayed : sequence of McapSource
        What is to be forecast of then.

    Raises
    ------
    SettingsError
        Where one goes on when what is replayed has begun: forecasts would know what comes of them.
    """
    if not recordings:
        return None
    sources = opened(recordings)
    _refuse_later(sources, replayed)
    pipeline = Pipeline(model, settings, shadows=shadows, keep_tables=False)
    with reading(sources, words="learning") as step, seldom_collecting():
        for messages in merged(sources):
            pipeline.take(messages)
            pipeline.forecasts(newest_only=True)  # lets go of the others
            pipeline.model_errors(newest_only=True)
            step()
    warn_of_losses(sources)
    return pipeline


def _refuse_later(history: Sequence[McapSource], replayed: Sequence[McapSource]) -> None:
    """Refuse recordings that go on when others have begun."""
    begin = min((source.span_ns[0] for source in replayed if source.span_ns), default=inf)
    for source in history:
        if source.span_ns and source.span_ns[1] > begin:
            raise SettingsError(
                f"--history {source.path} ends at {_moment(source.span_ns[1])}, after what is replayed begins, at "
                f"{_moment(begin)}: forecasts would know what comes of them; give recordings that end before"
            )


def _moment(time_ns: float) -> str:
    """Return a time as people read it."""
    return f"{datetime.fromtimestamp(time_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC"
