"""What a consumer learns, before it begins, of recordings of earlier days: `--history`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from core.models import Model
from core.pipeline import Pipeline
from core.settings import Settings
from stream.mcap_io import McapSource
from stream.run import seldom_collecting
from stream.source import merged
from tools.output import reading, warn_of_losses

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
    model: Model, shadows: Sequence[Model], settings: Settings, recordings: Sequence[Path] | None
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
    """
    if not recordings:
        return None
    sources = [McapSource(path) for path in recordings]
    pipeline = Pipeline(model, settings, shadows=shadows, keep_tables=False)
    with reading(sources, words="learning") as step, seldom_collecting():
        for messages in merged(sources):
            pipeline.take(messages)
            pipeline.forecasts(newest_only=True)  # lets go of the others
            pipeline.model_errors(newest_only=True)
            step()
    warn_of_losses(sources, Console(stderr=True))
    return pipeline
