"""Run the tasks of a stage, and record which task ran where, for how long, and how much it read and wrote."""

import os
import resource
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol


@dataclass(frozen=True)
class TaskRecord:
    """Record a task that has ended.

    Parameters
    ----------
    number : int
        Number of the task in its stage.
    seconds, cpu_s : float
        Time and CPU time of the task. [s]
    read_bytes, written_bytes : int
        What it read and wrote, from cache or disk. [B]
    peak_bytes : int
        Largest memory of the process so far. [B]
    """

    stage: str
    number: int
    host: str
    worker: str
    process: int
    seconds: float
    cpu_s: float
    read_bytes: int
    written_bytes: int
    peak_bytes: int


class Runner(Protocol):
    """Run tasks."""

    workers: int
    records: list[TaskRecord]

    def run(self, stage: str, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """Yield the results of a function for the arguments of each task, in the order of the tasks."""

    def count_repeats(self) -> dict[str, int]:
        """Return how often a task was begun once more, because its worker was lost, by stage."""


class InProcessRunner:
    """Run tasks one after the other in this process."""

    workers = 1

    def __init__(self) -> None:
        self.records: list[TaskRecord] = []

    def run(self, stage: str, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """Yield the result of each task."""
        for number, arguments in enumerate(tasks):
            record, result = run_task(stage, number, "", function, arguments)
            self.records.append(record)
            yield result

    def count_repeats(self) -> dict[str, int]:
        """Return nothing, as no task is lost here."""
        return {}


def run_task(
    stage: str, number: int, worker: str, function: Callable[..., Any], arguments: tuple[Any, ...]
) -> tuple[TaskRecord, Any]:
    """Run a task in this process, and return its record and its result."""
    began, cpu, (read, written) = time.monotonic(), time.process_time(), _count_bytes()
    result = function(*arguments)
    read_now, written_now = _count_bytes()
    record = TaskRecord(
        stage,
        number,
        socket.gethostname(),
        worker,
        os.getpid(),
        time.monotonic() - began,
        time.process_time() - cpu,
        read_now - read,
        written_now - written,
        1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    )
    return record, result


def _count_bytes() -> tuple[int, int]:
    """Return how much this process has read and written so far; zero where the system does not count it. [B]"""
    try:
        lines = dict(line.split(": ") for line in Path("/proc/self/io").read_text("ascii").splitlines())
        return int(lines["rchar"]), int(lines["wchar"])
    except (OSError, KeyError, ValueError):
        return 0, 0
