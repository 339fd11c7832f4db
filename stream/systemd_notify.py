"""Messages to systemd: the service is ready, its loop moves, it stops, and one line on its status.

References
----------
sd_notify(3) and sd_watchdog_enabled(3), https://www.freedesktop.org/software/systemd/man/sd_notify.html: datagrams of
lines `NAME=VALUE` to the Unix socket that the environment names.
"""

import logging
import os
import socket
from collections.abc import Mapping
from typing import Final, Self

SEND_S: Final = 0.1
"""Longest time that a message waits for a full socket. [s]"""
_ABSTRACT: Final = "@"
"""First character of the name of an abstract socket, in place of a zero byte."""

_log = logging.getLogger("socast.systemd")


class SystemdNotifier:
    """Send messages to systemd; without systemd every method does nothing.

    A message waits at most `SEND_S` and never fails: a full or vanished socket costs that message only.

    Parameters
    ----------
    address : str
        Path of the socket, or the name of an abstract one after `@`; an empty address switches messages off.
    watchdog_s : float, optional
        Time without a message after which systemd ends the service. [s] None without a watchdog.
    """

    def __init__(self, address: str = "", watchdog_s: float | None = None) -> None:
        self.watchdog_s = watchdog_s
        self._address = f"\0{address[1:]}" if address.startswith(_ABSTRACT) else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        self._due_s = 0.0
        self._failed = False
        if self._socket is not None:
            self._socket.settimeout(SEND_S)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Self:
        """Return the notifier that the environment asks for.

        Parameters
        ----------
        environment : mapping of str to str
            `NOTIFY_SOCKET` names the socket. `WATCHDOG_USEC` is the time of the watchdog [us], for the process
            `WATCHDOG_PID` or, without it, for any.
        """
        usec, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        ours = not pid or pid == str(os.getpid())
        watchdog_s = int(usec) * 1e-6 if usec.isdecimal() and int(usec) > 0 and ours else None
        return cls(environment.get("NOTIFY_SOCKET", ""), watchdog_s)

    @property
    def is_connected(self) -> bool:
        """Return whether messages are sent."""
        return self._socket is not None

    def announce_ready(self) -> None:
        """Tell that the service has started."""
        self._send("READY=1")

    def announce_stop(self) -> None:
        """Tell that the service stops."""
        self._send("STOPPING=1")

    def set_status(self, words: str) -> None:
        """Set the line that `systemctl status` shows."""
        self._send(f"STATUS={' '.join(words.split())}")

    def feed_watchdog(self, now: float) -> None:
        """Tell that the loop moves, at most four times per time of the watchdog.

        Units: now [s].
        """
        if self.watchdog_s is not None and now >= self._due_s:
            self._due_s = now + self.watchdog_s / 4.0
            self._send("WATCHDOG=1")

    def close(self) -> None:
        """Close the socket; later messages are not sent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, line: str) -> None:
        """Send a line."""
        if self._socket is None:
            return
        try:
            self._socket.sendto(line.encode(), self._address)
        except OSError as error:
            if not self._failed:
                self._failed = True
                _log.warning("systemd is not told: %s", error.strerror or error)
