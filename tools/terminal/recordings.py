"""What every command does with recordings: open them, show progress, and report what they have lost."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from os.path import realpath
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from core.errors import RecordingError, SettingsError
from stream.mcap_reader import McapSource

Recordings = Annotated[list[Path], typer.Argument(metavar="REC...", help="MCAP recordings.", show_default=False)]


def open_recordings(recordings: Sequence[Path]) -> list[McapSource]:
    """Return recordings that are ready to be read.

    Parameters
    ----------
    recordings : sequence of Path

    Returns
    -------
    list of McapSource
        In the order in which they are given.

    Raises
    ------
    RecordingError
        Where one cannot be read.
    SettingsError
        Where one is given twice.
    """
    refuse_duplicates(recordings)
    return [McapSource(path) for path in recordings]


def refuse_duplicates(files: Iterable[Path]) -> None:
    """Refuse files of which one is given twice, by whatever name.

    Raises
    ------
    SettingsError
        Naming the file, whose rides would count twice.
    """
    known: set[str] = set()
    for file in files:
        place = realpath(file)  # `Path.resolve` fails where links go in a circle
        if place in known:
            raise SettingsError(f"{file} is given twice, and what it holds would count twice; give it once")
        known.add(place)


def refuse_unusable(sources: Sequence[McapSource], usable: int) -> None:
    """Refuse recordings that were read to their end and hold no message of the wire contract.

    Parameters
    ----------
    sources : sequence of McapSource
    usable : int
        Messages of the wire contract in all of them.

    Raises
    ------
    RecordingError
        Where there is none.
    """
    if not usable and all(source.blocks_read == source.blocks for source in sources):
        names = ", ".join(str(source.path) for source in sources)
        raise RecordingError(
            f"{names}: no message that socast can read; record telemetry under fleet/VEHICLE/telemetry, "
            "as `socast live --record` does"
        )


@contextmanager
def show_progress(
    sources: Sequence[McapSource], *, shown: bool = True, words: str = "reading"
) -> Iterator[Callable[[], None]]:
    """Show on standard error how far recordings have been read; give a function to call after each step.

    Parameters
    ----------
    sources : sequence of McapSource
    shown : bool
        Whether to show anything; nothing is shown where standard error is no terminal.
    words : str
        What is going on.
    """
    console = Console(stderr=True)
    columns = (TextColumn(words), BarColumn(), MofNCompleteColumn(), TextColumn("chunks"), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not (shown and console.is_terminal)) as progress:
        task = progress.add_task(words, total=sum(source.blocks for source in sources))
        yield lambda: progress.update(task, completed=sum(source.blocks_read for source in sources))


def warn_of_losses(sources: Iterable[McapSource], console: Console | None = None) -> None:
    """Print what recordings hold or held that could not be read, by default on standard error."""
    console = console or Console(stderr=True)
    for source in sources:
        for line in source.losses.lines():
            console.print(f"{source.path}: {line}", style="yellow", markup=False, highlight=False, soft_wrap=True)
