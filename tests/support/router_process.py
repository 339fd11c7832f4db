"""A Zenoh router in a process of its own, which can be killed, for tests."""

import subprocess
import sys
from typing import Self

from socast.stream.zenoh_session import Connection, Node, find_free_port

ROUTER = """
import sys, time
from socast.stream.zenoh_session import Connection, Node
with Node(Connection(listen=(sys.argv[1],), mode="router")):
    print("listening", flush=True)
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
        """Start the process, and wait until it listens."""
        command = [sys.executable, "-c", ROUTER, self.endpoint]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout.readline() == "listening\n", f"the router at {self.endpoint} has ended"

    def kill(self) -> None:
        """Kill the process; a second call has no effect."""
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()

    def join(self) -> Node:
        """Return a client of the router."""
        return Node(Connection(connect=(self.endpoint,)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
