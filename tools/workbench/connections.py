"""Connections of the workbench's server: whoever sends no whole request, or keeps many open, keeps nobody else out."""

import asyncio
from typing import Any, Final

from h11 import Request
from uvicorn.protocols.http.h11_impl import H11Protocol

MOST_CONNECTIONS: Final = 256
"""Largest number of connections at a time."""
MOST_PER_ADDRESS: Final = 128
"""Largest number of connections at a time from one address."""
REQUEST_S: Final = 10.0
"""Longest time for which a connection may wait for the head of a request, and longest time for its body. [s]"""


class BoundedConnection(H11Protocol):
    """Close connections that wait too long for a request, and the oldest of those that wait where there are too many.

    A connection waits from its beginning, and from the end of each answer, until the head of a request is whole. A
    browser sends its head at once, so that half requests of others never take its place.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request, in the place of another connection where there are too many."""
        super().connection_made(transport)
        self._timer: asyncio.TimerHandle | None = None
        self._wait()
        others: list[Any] = [each for each in self.connections if each is not self]
        of_address = [each for each in others if each.client and self.client and each.client[0] == self.client[0]]
        for group, most in ((of_address, MOST_PER_ADDRESS), (others, MOST_CONNECTIONS - 2)):
            waiting = [each for each in group if isinstance(each, BoundedConnection) and each.is_waiting]
            if len(group) >= most and waiting:
                min(waiting, key=lambda each: each.since_s).give_up()
                return

    @property
    def is_waiting(self) -> bool:
        """Return whether no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def data_received(self, data: bytes) -> None:
        """Take bytes; a request whose head is whole no longer waits."""
        super().data_received(data)
        if not self.is_waiting:
            self._stop_waiting()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        if self.is_waiting:
            self._wait()

    def handle_websocket_upgrade(self, event: Request) -> None:
        """Hand the connection over."""
        self._stop_waiting()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._stop_waiting()
        super().connection_lost(exc)

    def give_up(self) -> None:
        """Close the connection now."""
        self.connections.discard(self)
        self.transport.abort()

    def _wait(self) -> None:
        """Begin to wait for a request."""
        self._stop_waiting()
        self.since_s = self.loop.time()
        self._timer = self.loop.call_later(REQUEST_S, self.give_up)

    def _stop_waiting(self) -> None:
        """Wait no longer."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
