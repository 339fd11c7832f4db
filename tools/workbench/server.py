"""The server of the workbench: it listens, prints the address with its token, and stops cleanly on Ctrl-C."""

import logging
import socket
import sys
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import environ
from typing import Any, Final

import uvicorn

from socast.core.errors import SettingsError
from socast.tools.terminal.stop_signals import restore_handlers, set_handler
from socast.tools.workbench.access import ENTRY, AccessControl, Sessions, is_any, is_loopback
from socast.tools.workbench.connections import MOST_CONNECTIONS, BoundedConnection
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.routes import make_application

STOP_S: Final = 1
"""Longest time that open connections are given at the end. [s]"""
LARGEST_FRAME: Final = 4096
"""Largest frame that a browser may send over a WebSocket; the pages send none. [B]"""
_log = logging.getLogger("socast.workbench")


class WorkbenchServer:
    """Serve a workbench; the constructor listens, and `run` serves until it is stopped.

    Parameters
    ----------
    announce : callable
        Function that receives each address to open, which works for one browser.
    """

    def __init__(
        self, workbench: Workbench, host: str, port: int, announce: Callable[[str], None] = lambda _: None
    ) -> None:
        try:
            family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            self._socket = socket.create_server(place[:2], family=family, backlog=128)
        except OSError as error:
            raise SettingsError(
                f"cannot listen at {host}:{port}: {error.strerror}; choose another address with --host and --port"
            ) from error
        self.host, self.port = host, int(self._socket.getsockname()[1])
        self._sessions = Sessions(self.port)
        self._announce = announce
        control: Any = AccessControl(
            make_application(workbench), self._sessions, host, self.port, lambda: announce(self.address)
        )
        settings = uvicorn.Config(
            control,
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            date_header=False,
            proxy_headers=False,
            lifespan="off",
            http=BoundedConnection,
            ws="websockets-sansio",
            ws_max_size=LARGEST_FRAME,
            ws_per_message_deflate=False,
            limit_concurrency=MOST_CONNECTIONS,
            timeout_graceful_shutdown=STOP_S,
            h11_max_incomplete_event_size=32 << 10,
        )
        self._server = _Server(settings)

    @property
    def origin(self) -> str:
        """Scheme, host and port of the pages."""
        name = _find_own_address() if is_any(self.host) else self.host
        return f"http://[{name}]:{self.port}" if ":" in name else f"http://{name}:{self.port}"

    @property
    def address(self) -> str:
        """Address for the next browser, with the token that works once."""
        return f"{self.origin}{ENTRY}?token={self._sessions.token}"

    @property
    def is_serving(self) -> bool:
        """Whether the server answers."""
        return self._server.started

    def run(self) -> None:
        """Serve until a signal, or until `stop` is called."""
        if not is_loopback(self.host):
            _log.warning(
                "the pages are not encrypted: whoever can read the network between a browser and %s can read them", self
            )
        with self._server.obey_signals():
            self._announce(self.address)
            self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """Stop serving; another thread may call this."""
        self._server.should_exit = True

    def __str__(self) -> str:
        return self.origin


class _Server(uvicorn.Server):
    """Stop at the first signal, and leave the process in the order that the caller chose."""

    @contextmanager
    def obey_signals(self) -> Iterator[None]:
        """Stop on SIGINT, SIGTERM and SIGHUP, where this is the main thread."""
        before = set_handler(self._stop)
        try:
            yield
        finally:
            if not self.should_exit:  # else the process ends: a signal that comes late must not change its exit code
                restore_handlers(before)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave the signals alone: they are obeyed already."""
        yield

    def _stop(self, *_: object) -> None:
        """Stop; at the second signal, do not wait for open connections."""
        self.force_exit = self.should_exit
        self.should_exit = True


def make_announcer(*, opens_browser: bool) -> Callable[[str], None]:
    """Return the function that prints each address, and opens the first one in a browser."""
    count = 0

    def announce(address: str) -> None:
        nonlocal count
        count += 1
        if count == 1:
            print(f"The workbench is open. Address for one browser:\n  {address}\nCtrl-C stops it.", flush=True)
            if opens_browser and _has_screen():
                webbrowser.open(address)
        else:
            print(f"Address for another browser:\n  {address}", flush=True)

    return announce


def _find_own_address() -> str:
    """Return an address of this machine for others, or else loopback."""
    try:
        return socket.gethostbyname(socket.gethostname())
    except OSError:
        return "127.0.0.1"


def _has_screen() -> bool:
    """Return whether a browser would open a window, and not take over the terminal."""
    return sys.platform in {"darwin", "win32"} or bool(environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY"))
