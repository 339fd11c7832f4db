"""Publish messages so that it is known when a router has read them.

A publication that finds no router is lost without an error (zenoh 1.10), and so is one that the transport still holds
when the router goes away. A delivery therefore waits for a router, publishes, waits until the router has read
everything, and begins again where a router went away in between. A message may so be published twice, with the same
bytes; a consumer drops the second one.

Publishing waits for the slowest reader, in a thread of its own, so that a stop ends the wait.
"""

import logging
import time
from collections.abc import Sequence
from math import inf
from threading import Event, Thread
from typing import Any, Final

from socast.core.wire.messages import Message
from socast.stream.closeable import Closeable
from socast.stream.structured_log import event_fields
from socast.stream.zenoh_session import Node
from socast.stream.zenoh_sink import ZenohSink

RETRY_S: Final = 0.2
"""Time between two looks for a router. [s]"""
STOP_S: Final = 2.0
"""Time after a stop for which messages may still leave. [s]"""
_log = logging.getLogger("socast.zenoh")


class ZenohDelivery(Closeable):
    """Deliver messages to the router of a client session.

    Parameters
    ----------
    node : Node
        Session of a client, which the delivery does not close.

    Attributes
    ----------
    repeated : int
        Number of messages that were published again because a router went away.
    """

    def __init__(self, node: Node, prefix: str = "") -> None:
        self.repeated = 0
        self._node = node
        self._sink = ZenohSink(node, prefix)
        self._lost = 0
        self._is_stuck = False
        self._listener: Any = node.session.info.declare_transport_events_listener(self._watch)

    def deliver(self, messages: Sequence[Message], stop: Event) -> bool:
        """Publish messages, and return whether a router has read them all."""
        while self._wait_for_router(stop):
            lost = self._lost
            if not self._publish(messages, stop):
                return False
            if lost == self._lost and self._has_router():
                return True
            self.repeated += len(messages)
        return False

    def close(self) -> None:
        """Undeclare the publishers; the session stays open."""
        self._listener.undeclare()  # its thread would keep the process alive
        if self._is_stuck:
            self._node.abandon()
        else:
            self._sink.close()

    def has_subscriber(self) -> bool:
        """Return whether any node subscribes to the fleet."""
        return not self._is_stuck and self._sink.has_subscriber()

    def _publish(self, messages: Sequence[Message], stop: Event) -> bool:
        """Publish messages; return whether all have left, which is false if they have not `STOP_S` after a stop."""
        errors: list[Exception] = []
        thread = Thread(target=self._put, args=(messages, errors), name="zenoh-delivery", daemon=True)
        thread.start()
        end_s = inf
        while thread.is_alive():
            thread.join(RETRY_S)
            if stop.is_set():
                end_s = min(end_s, time.monotonic() + STOP_S)
            if time.monotonic() > end_s and thread.is_alive():
                self._is_stuck = True
                _log.warning("stopped while nobody reads: up to %d messages are not delivered", len(messages))
                return False
        if errors:
            raise errors[0]
        return True

    def _put(self, messages: Sequence[Message], errors: list[Exception]) -> None:
        """Publish messages, and wait until a router has read them."""
        try:
            self._sink.put(messages)
            self._node.flush()
        except Exception as error:  # noqa: BLE001 -- the caller raises it
            errors.append(error)

    def _wait_for_router(self, stop: Event) -> bool:
        """Return whether a router is connected, after a wait for one that ends with `stop`."""
        if self._has_router():
            return True
        _log.warning("no router; waiting for it")
        while not stop.wait(RETRY_S):
            if self._has_router():
                _log.info("router joined", extra=event_fields(repeated=self.repeated))
                return True
        return False

    def _has_router(self) -> bool:
        """Return whether a router is connected."""
        return bool(self._node.session.info.routers_zid())

    def _watch(self, event: Any) -> None:
        """Count transports that end."""
        self._lost += "delete" in str(event.kind).lower()
