"""The Zenoh publisher, which is a sink.

Publishing blocks while the network is slow, so the sink drops nothing.

Notes
-----
Declaring a publisher waits for samples that are being delivered (zenoh 1.10). If the channel of a subscriber in the
same session is full, these wait for the iteration that drains it. A session that also subscribes must therefore publish
through a `socast.stream.latest_only_sink.LatestOnlySink`.
"""

from collections.abc import Sequence
from typing import Any, Final

import zenoh
from zenoh import ext

from socast.core.errors import SettingsError
from socast.core.wire.messages import Message
from socast.stream.idle_keys import IdleKeys
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
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=1.0),
            publisher_detection=True,
        )
