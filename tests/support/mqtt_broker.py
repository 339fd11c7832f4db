"""A mosquitto broker in a process of its own, at a free port on loopback, for tests."""

import shutil
import socket
import subprocess
from pathlib import Path
from typing import Final, Self

import pytest

from socast.stream.zenoh_session import find_free_port
from tests.support.zenoh_sessions import eventually

MOSQUITTO: Final = shutil.which(
    "mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin:/opt/homebrew/sbin"
)
"""The broker, None where it is not installed."""
needs_mosquitto = pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed (apt-get install mosquitto)")
"""Mark of the tests that start a broker."""


class MqttBroker:
    """Run a broker that keeps sessions in a folder, also while it does not run; a context manager.

    Parameters
    ----------
    folder : Path
        Folder of its configuration and of what it keeps.
    settings : str
        Further lines of its configuration.

    Attributes
    ----------
    port : int
        Its port, the same after each start.
    url : str
        Its address.
    """

    def __init__(self, folder: Path, settings: str = "allow_anonymous true\nmax_inflight_messages 0") -> None:
        self.port = find_free_port()
        self.url = f"mqtt://127.0.0.1:{self.port}"
        self._file = folder / "mosquitto.conf"
        self._file.write_text(
            f"listener {self.port} 127.0.0.1\npersistence true\npersistence_location {folder}/\n"
            f"max_queued_messages 0\nuser root\n{settings}\n",
            encoding="utf-8",
        )
        self.start()

    def start(self) -> None:
        """Start the broker, and wait until it listens."""
        assert MOSQUITTO is not None
        self._process = subprocess.Popen(
            [MOSQUITTO, "-c", self._file], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        assert eventually(self._listens), "mosquitto does not listen"

    def stop(self) -> None:
        """End the broker; it keeps its sessions in the folder."""
        self._process.terminate()
        self._process.wait(60)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _listens(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self.port), 1.0).close()
        except OSError:
            return False
        return True
