"""Workbenches that serve in a thread of the test's process."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Thread
from typing import Any

from socast.tools.workbench.server import WorkbenchServer
from tests.support.zenoh_sessions import eventually


@contextmanager
def serve(workbench: Any, announce: Callable[[str], None] = lambda _: None) -> Iterator[WorkbenchServer]:
    """Serve a workbench at a free port of loopback until the block ends."""
    server = WorkbenchServer(workbench, "127.0.0.1", 0, announce)
    thread = Thread(target=server.run, daemon=True)
    thread.start()
    eventually(lambda: server.is_serving)
    yield server
    server.stop()
    thread.join(10.0)
    assert not thread.is_alive(), "the server does not stop"
