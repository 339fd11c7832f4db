"""Recordings, the same for every command: opened, gone through with a progress bar, and their losses told."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from math import inf
from os.path import realpath
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from core.errors import SettingsError
from core.pipeline import Pipeline
from stream.loop import Tally, run
from stream.mcap_writer import McapSink, McapSource
from stream.source import Source, merged
from tools.terminal.live_table import Screen

Recordings = Annotated[list[Path], typer.Argument(metavar="REC...", help="MCAP recordings.", show_default=False)]


def opened(recordings: Sequence[Path]) -> list[McapSource]:
    """Return recordings, ready to be read.

    Raises
    ------
    RecordingError
        Where one cannot be.
    SettingsError
        Where one is given twice.
    """
    refuse_twice(recordings)
    return [McapSource(path) for path in recordings]


def refuse_twice(files: Iterable[Path]) -> None:
    """Refuse files of which one is given twice, by whatever name.

    Raises
    ------
    SettingsError
    """
    known: set[str] = set()
    for file in files:
        if (own := realpath(file)) in known:  # `Path.resolve` fails where links go in a circle
            raise SettingsError(f"{file} is given twice, and what it holds would count twice; give it once")
        known.add(own)


@contextmanager
def reading(
    sources: Sequence[McapSource], *, shown: bool = True, words: str = "reading"
) -> Iterator[Callable[[], None]]:
    """Show how far recordings have been read; give a function to call now and then."""
    console = Console(stderr=True)
    columns = (TextColumn(words), BarColumn(), MofNCompleteColumn(), TextColumn("chunks"), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not (shown and console.is_terminal)) as progress:
        task = progress.add_task(words, total=sum(source.blocks for source in sources))
        yield lambda: progress.update(task, completed=sum(source.blocks_read for source in sources))


def forecast(
    pipeline: Pipeline,
    sources: Sequence[McapSource],
    source: Source | None = None,
    rate: float = inf,
    sinks: Sequence[McapSink] = (),
    also: Callable[[], None] = lambda: None,
) -> None:
    """Run recordings through the loop, with a progress bar at full speed and a table of cars at any other.

    Parameters
    ----------
    pipeline : Pipeline
        Holds the rides afterwards.
    sources : sequence of McapSource
        The recordings.
    source : Source, optional
        Of their messages, where they are more than merged in time order: paced, say.
    rate : float
        Speed of the replay; `inf` as fast as possible.
    sinks : sequence of McapSink
        Take the forecasts.
    also : callable
        Called after each list of messages.
    """
    with reading(sources, shown=rate == inf) as step, Screen(pipeline, "Replay", silent=rate == inf) as screen:

        def watch(tally: Tally) -> None:
            step()
            also()
            screen(tally)

        run(merged(sources) if source is None else source, pipeline, sinks, watch=watch)


def warn_of_losses(sources: Iterable[McapSource], console: Console | None = None) -> None:
    """Say what recordings hold that could not be read, on standard error if nowhere else."""
    console = console or Console(stderr=True)
    for source in sources:
        for line in source.losses.lines():
            console.print(f"{source.path}: {line}", style="yellow", markup=False, highlight=False, soft_wrap=True)
