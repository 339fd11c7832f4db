"""Processes that run `socast live`, for tests."""

import json
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.support.commands import SOCAST
from tests.support.zenoh_sessions import eventually

Start = Callable[..., tuple[subprocess.Popen[bytes], Path]]


@contextmanager
def consumers(folder: Path) -> Iterator[Start]:
    """Give a function that starts a live consumer with options and returns its process and the file of its log.

    The function returns once the consumer listens. No consumer outlives the context.
    """
    running: list[subprocess.Popen[bytes]] = []

    def start(*arguments: object) -> tuple[subprocess.Popen[bytes], Path]:
        log = folder / f"{len(running)}.log"
        command = [*SOCAST, "live", *map(str, arguments), "--json-log"]
        with log.open("w") as file:
            running.append(subprocess.Popen(command, stderr=file, stdout=subprocess.DEVNULL))
        assert eventually(lambda: any(line["event"] == "listening" for line in logged(log)), 90.0)
        return running[-1], log

    try:
        yield start
    finally:
        for process in running:
            process.kill()
            process.wait()


def logged(log: Path) -> list[dict[str, Any]]:
    """Return the events of a log, without a last line that is not yet whole."""
    return [json.loads(line) for line in log.read_text().splitlines(keepends=True) if line.endswith("\n")]
