"""Show on standard error, on a terminal only, how far a work is."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)


def _open(*columns: ProgressColumn, console: Console | None = None, shown: bool = True, **options: Any) -> Progress:
    """Return a progress that is shown on a terminal only."""
    console = console or Console(stderr=True)
    return Progress(*columns, console=console, disable=not (shown and console.is_terminal), **options)


@contextmanager
def show_elapsed(words: str, console: Console | None = None) -> Iterator[None]:
    """Show what is done and for how long."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with _open(*columns, console=console, transient=True) as progress:
        progress.add_task(words, total=None)
        yield


@contextmanager
def show_bar(
    words: str, *columns: ProgressColumn, total: float | None = 1.0, shown: bool = True
) -> Iterator[Callable[..., None]]:
    """Show a bar and further columns; yield the function that takes what is done, and the total if that changes."""
    with _open(TextColumn(words), BarColumn(), *columns, shown=shown, transient=True) as progress:
        task = progress.add_task(words, total=total)
        yield lambda done, of=None: progress.update(task, completed=done, total=of)


@contextmanager
def show_stages(words: str = "tables") -> Iterator[Callable[[str, int, int], None]]:
    """Show how many tasks of each stage have ended.

    Yields
    ------
    callable
        Function that takes a stage, the number of its tasks that have ended, and the number of all.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("tasks"))
    with _open(*columns, TimeElapsedColumn()) as progress:
        shown = {}

        def report(stage: str, done: int, number: int) -> None:
            if stage not in shown:
                shown[stage] = progress.add_task(f"{words}: {stage}", total=number)
            progress.update(shown[stage], completed=done)

        yield report
