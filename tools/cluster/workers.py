"""Open workers for a command: scratch files, progress in the terminal, and a report of what ran where."""

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from socast.tools.cluster.dask_runner import ClusterPlace, open_runner
from socast.tools.cluster.runner import InProcessRunner, Runner, TaskRecord
from socast.tools.terminal.output import write_json
from socast.tools.terminal.progress import show_stages


class Workers(NamedTuple):
    """Hold what a command needs to divide its work.

    Parameters
    ----------
    scratch : Path
        Folder of intermediate files, that all workers see.
    report : callable
        Function that receives a stage, the number of its tasks that have ended, and the number of all.
    """

    runner: Runner
    scratch: Path
    report: Callable[[str, int, int], None]

    def run(self, stage: str, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """Yield the result of each task, in their order, and show how many have ended."""
        self.report(stage, 0, len(tasks))
        for done, result in enumerate(self.runner.run(stage, function, tasks)):
            self.report(stage, done + 1, len(tasks))
            yield result


@contextmanager
def open_workers(
    place: ClusterPlace | None, folder: Path, words: str, on_end: Callable[[TaskRecord], None] | None = None
) -> Iterator[Workers]:
    """Start or reach workers; at the end, write the report of what ran where, if one was asked for."""
    with ExitStack() as ending:
        scratch = ending.enter_context(make_scratch(folder))
        runner: Runner = (
            InProcessRunner() if place is None else ending.enter_context(open_runner(place, scratch, on_end))
        )
        yield Workers(runner, scratch, ending.enter_context(show_stages(words)))
        if place is not None:
            write_json(place.report, "cluster", describe_tasks(runner))


def describe_tasks(runner: Runner) -> dict[str, Any]:
    """Return what ran where: each task, and the sums of each worker process."""
    processes: dict[str, dict[str, Any]] = {}
    for record in runner.records:
        of_process = processes.setdefault(
            f"{record.host}/{record.process}",
            {"worker": record.worker, "tasks": 0, "seconds": 0.0, "cpu_s": 0.0, "read_bytes": 0, "written_bytes": 0},
        )
        of_process["tasks"] += 1
        for name in ("seconds", "cpu_s", "read_bytes", "written_bytes"):
            of_process[name] += getattr(record, name)
        of_process["peak_bytes"] = max(record.peak_bytes, of_process.get("peak_bytes", 0))
    return {
        "workers": runner.workers,
        "repeated_tasks": runner.count_repeats(),
        "processes": processes,
        "tasks": [asdict(record) for record in runner.records],
    }


@contextmanager
def make_scratch(folder: Path) -> Iterator[Path]:
    """Yield a new folder in another one for intermediate files, which only this user can read."""
    scratch = Path(tempfile.mkdtemp(prefix=".scratch-", dir=folder)).resolve()
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
