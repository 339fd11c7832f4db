"""The Zenoh publisher, which is a sink, and the sink with its own thread that goes before it.

Publishing blocks while the network is slow, so the publisher drops nothing.

Notes
-----
Declaring a publisher waits for samples that are being delivered (zenoh 1.10). If the channel of a subscriber in the
same session is full, these wait for the iteration that drains it. A session that also subscribes must therefore publish
through a `LatestOnlySink`.
"""

from collections.abc import Sequence
from threading import Condition, Thread
from typing import Any, Final

import zenoh
from zenoh import ext

from socast.core.errors import SettingsError
from socast.core.wire.messages import Message
from socast.stream.idle_keys import IdleKeys
from socast.stream.source import Sink
from socast.stream.zenoh_session import Node, format_zenoh_error

CACHE: Final = 64
"""Number of samples of each key that a publisher can send again."""


class ZenohSink:
    """Publish messages as a sink, with one advanced publisher per key.

    A publisher that was not used for long is undeclared, so that their number does not grow over months.

    Parameters
    ----------
    keys : IdleKeys, optional
        Decides which publishers were not used for long.
    """

    def __init__(self, node: Node, prefix: str = "", keys: IdleKeys | None = None) -> None:
        self._node = node
        self._session = node.session
        self._prefix = prefix
        self._keys = keys or IdleKeys()
        self._publishers: dict[str, Any] = {}

    def has_subscriber(self) -> bool:
        """Return whether any node subscribes to the fleet."""
        with self._session.declare_publisher(f"{self._prefix}fleet/**") as publisher:
            status: Any = publisher.matching_status
            return bool(status.matching)

    def put(self, messages: Sequence[Message]) -> None:
        """Publish messages; the call blocks while the network is slow."""
        publishers = self._publishers
        try:
            for key, payload, _ in messages:
                publisher = publishers.get(key)
                if publisher is None:
                    publisher = publishers[key] = self._declare(self._prefix + key)
                publisher.put(payload)
            for key in self._keys.use([message.key for message in messages]):
                publishers.pop(key).undeclare()
        except zenoh.ZError as error:
            raise SettingsError(f"cannot publish: {format_zenoh_error(error)}") from error

    def close(self) -> None:
        """Undeclare the publishers after all messages have been sent; the session stays open."""
        if self._publishers:
            self._node.flush()
        for publisher in self._publishers.values():
            publisher.undeclare()
        self._publishers.clear()

    def _declare(self, key: str) -> Any:
        """Return a publisher that numbers its samples, caches the last ones, and is visible to late subscribers."""
        return ext.declare_advanced_publisher(
            self._session,
            key,
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.BLOCK,
            cache=ext.CacheConfig(CACHE),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            publisher_detection=True,
        )


class LatestOnlySink:
    """Pass the newest message of each key to a sink, from a separate thread.

    The loop must not wait for its subscribers, because one stalled subscriber would delay every car. A Zenoh session
    that declares a publisher also waits for the samples that it is delivering, and these samples wait for the loop. The
    next message of a key replaces a message that the thread could not yet pass on. The number of keys therefore bounds
    the memory.

    Parameters
    ----------
    sink : Sink
        Sink that receives the messages. Only the thread puts messages into it.
    """

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._newest: dict[str, Message] = {}
        self._changed = Condition()
        self._closing = False
        self._failure: Exception | None = None
        self._raised = False
        self._thread = Thread(target=self._work, name="latest-only-sink", daemon=True)
        self._thread.start()

    def put(self, messages: Sequence[Message]) -> None:
        """Hand messages to the thread without waiting for the sink."""
        self._raise_failure()
        if messages:
            with self._changed:
                self._newest.update((message.key, message) for message in messages)
                self._changed.notify()

    def close(self) -> None:
        """Wait until the thread has passed on all messages, then close the sink."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        self._sink.close()
        if not self._raised:
            self._raise_failure()

    def _raise_failure(self) -> None:
        """Raise the error that stopped the sink, if any."""
        if self._failure is not None:
            self._raised = True
            raise self._failure

    def _work(self) -> None:
        """Pass waiting messages to the sink until the sink is closed."""
        while True:
            with self._changed:
                while not (self._newest or self._closing):
                    self._changed.wait()
                taken, self._newest = self._newest, {}
            if not taken:
                return
            try:
                self._sink.put(list(taken.values()))
            except Exception as failure:  # noqa: BLE001 - the next put raises it
                self._failure = failure
                return
