"""An observer of everything that cars send and a consumer publishes; it publishes nothing itself.

The observer asks consumers for the newest forecast of each car and the newest findings, which they cache. It misses
what cars sent before it joined. Where its reader is slow, the oldest messages are dropped and counted, so that it never
blocks a publisher.
"""

import time
from collections import deque
from collections.abc import Sequence
from threading import Lock
from typing import Any, Final

from zenoh import ext

from socast.core.wire.messages import Message
from socast.stream.zenoh_session import Node

MOST_WAITING: Final = 100_000
"""Largest number of messages that wait for the reader; the oldest of more are dropped."""
MOST_WAITING_BYTES: Final = 256_000_000
"""Largest size of their payloads together, as a batch is as large as thousands of samples. [B]"""
OF_CARS: Final = "telemetry", "batch", "vehicle"
"""Last chunks of what cars and gateways send; each is subscribed to alone: an access control may allow some only."""
PUBLISHED: Final = "fleet/*/forecast", "findings/**"
"""Keys of what consumers publish, under the prefix."""


class ZenohObserver:
    """Subscribe to the telemetry, batches, forecasts and findings of a fleet.

    Parameters
    ----------
    node : Node
        Session and prefix to subscribe with; with a shard by chunk, the cars are those of the chunks before `fleet`.
    sent : sequence of str
        Last chunks of what to observe of that which cars and gateways send.

    Attributes
    ----------
    dropped : int
        Number of messages that were dropped because the reader was slow.
    """

    def __init__(self, node: Node, sent: Sequence[str] = OF_CARS) -> None:
        self.dropped = 0
        self._session = node.session
        self._waiting: deque[Message] = deque()
        self._waiting_bytes = 0
        self._lock = Lock()
        keys = [f"{cars}/{end}" for cars in node.list_cars() for end in sent]
        self._subscribers: list[Any] = [node.session.declare_subscriber(each, self._receive) for each in keys]
        for each in PUBLISHED:
            self._subscribers.append(
                ext.declare_advanced_subscriber(
                    node.session, f"{node.prefix}{each}", self._receive, history=ext.HistoryConfig(max_samples=1)
                )
            )

    @property
    def has_router(self) -> bool:
        """Return whether a router is connected."""
        return bool(self._session.info.routers_zid())

    def take(self) -> list[Message]:
        """Return the messages that have arrived since the last call, in the order of their arrival."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
            self._waiting_bytes = 0
        return taken

    def close(self) -> None:
        """Receive nothing more; the session stays open."""
        while self._subscribers:
            self._subscribers.pop().undeclare()

    def _receive(self, sample: Any) -> None:
        """Append a sample."""
        message = Message(str(sample.key_expr), sample.payload.to_bytes(), time.time_ns())
        with self._lock:
            self._waiting.append(message)
            self._waiting_bytes += len(message.payload)
            while len(self._waiting) > MOST_WAITING or self._waiting_bytes > MOST_WAITING_BYTES:
                self._waiting_bytes -= len(self._waiting.popleft().payload)
                self.dropped += 1
