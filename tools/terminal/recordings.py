"""Functions of all commands that read recordings: open recordings, show progress, and report losses."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from os.path import realpath
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console
from rich.progress import MofNCompleteColumn, TextColumn, TimeRemainingColumn

from socast.core.errors import RecordingError, SettingsError
from socast.core.totals.logger_faults import describe_faults
from socast.stream.mcap_reader import McapSource
from socast.stream.recorder import list_recordings
from socast.tools.terminal.output import print_plain
from socast.tools.terminal.progress import show_bar

QUIET_S: Final = 30.0
"""Time between two lines on progress where standard error is no terminal. [s]"""
Recordings = Annotated[
    list[Path], typer.Argument(metavar="REC...", help="MCAP recordings, or folders of them.", show_default=False)
]


def open_recordings(recordings: Sequence[Path]) -> list[McapSource]:
    """Open recordings for reading; a folder stands for those in it."""
    files: list[Path] = []
    for path in recordings:
        inside = list_recordings(path) if path.is_dir() else [path]
        if not inside:
            raise SettingsError(f"{path}: no *.mcap in this folder; give a recording, or a folder of recordings")
        files += inside
    refuse_duplicates(files)
    return [McapSource(path) for path in files]


def refuse_duplicates(files: Iterable[Path]) -> None:
    """Refuse files if one of them is given twice, even under different names."""
    known: set[str] = set()
    for file in files:
        place = realpath(file)  # `Path.resolve` fails on circular links
        if place in known:
            raise SettingsError(f"{file} is given twice, and what it holds would count twice; give it once")
        known.add(place)


def refuse_unusable(sources: Sequence[McapSource], usable: int) -> None:
    """Refuse recordings that were read to their end and hold no message of the wire contract."""
    if not usable and all(source.blocks_read == source.blocks for source in sources):
        names = ", ".join(str(source.path) for source in sources)
        raise RecordingError(
            f"{names}: no message that socast can read; record telemetry under fleet/VEHICLE/telemetry, "
            "as `socast live --record` does"
        )


@contextmanager
def show_progress(
    sources: Sequence[McapSource],
    *,
    shown: bool = True,
    words: str = "reading",
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Callable[[], None]]:
    """Show on standard error how many chunks of recordings have been read, by a bar or by a line every `QUIET_S`.

    Parameters
    ----------
    shown : bool
        Whether to show the progress. The bar never appears if standard error is not a terminal.
    """
    console = Console(stderr=True)
    if shown and not console.is_terminal:
        yield _make_line_progress(sources, words, console, clock)
        return
    columns, total = (MofNCompleteColumn(), TextColumn("chunks"), TimeRemainingColumn()), _count_blocks(sources)
    with show_bar(words, *columns, total=total, shown=shown) as update:
        yield lambda: update(sum(source.blocks_read for source in sources))


def _count_blocks(sources: Sequence[McapSource]) -> int:
    """Return the number of chunks of recordings."""
    return sum(source.blocks for source in sources)


def _make_line_progress(
    sources: Sequence[McapSource], words: str, console: Console, clock: Callable[[], float]
) -> Callable[[], None]:
    """Return the function that prints a line on the progress when `QUIET_S` have passed since the last one."""
    due = clock() + QUIET_S
    total = _count_blocks(sources)

    def step() -> None:
        nonlocal due
        if (now := clock()) >= due:
            due = now + QUIET_S
            read = sum(source.blocks_read for source in sources)
            print_plain(console, f"{words}: {read:,} of {total:,} chunks")

    return step


def warn_of_loggers(quality: Mapping[str, Any]) -> None:
    """Print one line on standard error for each fault of loggers: the cars and the remedy."""
    print_plain(Console(stderr=True), *describe_faults(quality["logger_faults"]), style="yellow")


def warn_of_losses(sources: Iterable[McapSource], console: Console | None = None) -> None:
    """Print which data of recordings were lost or could not be read."""
    console = console or Console(stderr=True)
    for source in sources:
        for line in source.losses.lines():
            print_plain(console, f"{source.path}: {line}", style="yellow")
