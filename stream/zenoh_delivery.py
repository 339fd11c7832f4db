"""Publish messages so that it is known when a router has read them.

A publication that finds no router is lost without an error (zenoh 1.10), and so is one that the transport still holds
when the router goes away. A delivery therefore waits for a router, publishes, waits until the router has read
everything, and begins again where a router went away in between. A message may so be published twice, with the same
bytes; a consumer drops the second one.
"""

import logging
from collections.abc import Sequence
from threading import Event
from typing import Any, Final

from socast.core.wire.messages import Message
from socast.stream.closeable import Closeable
from socast.stream.structured_log import event_fields
from socast.stream.zenoh_session import Node
from socast.stream.zenoh_sink import ZenohSink

RETRY_S: Final = 0.2
"""Time between two looks for a router. [s]"""
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
        self._listener: Any = node.session.info.declare_transport_events_listener(self._watch)

    def deliver(self, messages: Sequence[Message], stop: Event) -> bool:
        """Publish messages, and return whether a router has read them all."""
        while self._wait_for_router(stop):
            lost = self._lost
            self._sink.put(messages)
            self._node.flush()
            if lost == self._lost and self._has_router():
                return True
            self.repeated += len(messages)
        return False

    def close(self) -> None:
        """Undeclare the publishers; the session stays open."""
        self._listener.undeclare()
        self._sink.close()

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
