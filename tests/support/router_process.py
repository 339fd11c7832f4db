"""A Zenoh router in a process of its own, which can be killed, for tests."""

import subprocess
import sys
import time
from typing import Self

from socast.core.errors import SettingsError
from socast.stream.zenoh_session import Connection, Node, find_free_port
from tests.support.zenoh_sessions import eventually

ROUTER = """
import sys, time
from socast.stream.zenoh_session import Connection, Node
with Node(Connection(listen=(sys.argv[1],), mode="router")):
    time.sleep(1e6)
"""


class RouterProcess:
    """Run a router at a free port on loopback; a context manager.

    Attributes
    ----------
    endpoint : str
        Where it listens, after each start.
    """

    def __init__(self) -> None:
        self.endpoint = f"tcp/127.0.0.1:{find_free_port()}"
        self.start()

    def start(self) -> None:
        """Start the process; it listens some time later."""
        self._process = subprocess.Popen([sys.executable, "-c", ROUTER, self.endpoint])

    def kill(self) -> None:
        """Kill the process; a second call has no effect."""
        self._process.kill()
        self._process.wait()

    def join(self) -> Node:
        """Return a client of the router, once it listens."""
        nodes: list[Node] = []

        def connect() -> bool:
            try:
                nodes.append(Node(Connection(connect=(self.endpoint,))))
            except SettingsError:  # not yet
                time.sleep(0.1)
            return bool(nodes)

        assert eventually(connect)
        return nodes[0]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
