"""The Zenoh subscriber and the Zenoh publisher: a source and a sink.

The subscribers, one to the fleet and one to the weather, are advanced ones, whose channels are filled without Python,
and drained by whoever iterates. They ask advanced publishers for what they missed and count what could not be had.
Publishing blocks where the network is slow; nothing is dropped on our side.

Notes
-----
Observed of zenoh 1.10, and minded here:

- An advanced subscriber takes samples that carry a timestamp and no source number in order of their timestamps, of each
  router that stamped them. Where a router stamps for plain publishers, as `zenohd` does unless told otherwise, two
  samples that cross on their way through it are one sample too few (600 of 180,000 in a burst from three publishers).
  The embedded router does not stamp; against one that does, the source says so once, in the log.
- Declaring a publisher waits for samples that are being delivered, and these, where the channel is full, for whoever
  drains it: publish on a session that subscribes through a `stream.latest_only_sink.LatestOnlySink`.
- Router and client in one process share two receiving threads, and can wait for each other. Subscribe in the
  router's own session, and publish at speed from another process.
"""

import logging
import time
from collections.abc import Iterator, Sequence
from threading import Event
from typing import Any, Final

import zenoh
from zenoh import ext, handlers

from core.errors import SettingsError
from core.wire.messages import Message
from stream.source import LOOK_UP_S
from stream.zenoh_session import Node, format_zenoh_error

QUEUE: Final = 1 << 14
"""Samples that wait in the channel before publishers are held up; more would leave the cache before their turn."""
DRAIN: Final = 4000
"""Most messages that are yielded at once: as many as the processor's cache holds while they are worked on."""
GATHER_S: Final = 0.01
"""How long more is waited for where little is queued: a few large lists cost less than many small ones. [s]"""
CACHE: Final = 64
"""Samples of each key that a publisher can send again."""
WATCH_NS: Final = 1_000_000_000
"""Time between two looks at which routers are joined. [ns]"""
_SPACES: Final = "weather", "fleet"
"""Key spaces that are subscribed to and drained, in this order: an observation should not come after the samples that
met it, and whoever finds the fleet subscribed to can rely on the weather being so."""
_NAP_S: Final = 0.0005, 0.01  # first and longest wait for an empty channel
_log = logging.getLogger("socast.zenoh")


class _Keys(dict[Any, str]):
    """Key expression -> the same key as text, made once."""

    def __missing__(self, key: Any) -> str:
        text = self[key] = str(key)
        return text


class ZenohSource:
    """Subscribe to a fleet and its weather under one prefix, as a source that is iterated once.

    `{prefix}fleet/**` and `{prefix}weather/**` each come in order of arrival; of what is queued, the weather is first.
    Without a prefix, fleets that have one are not heard.

    Parameters
    ----------
    node : Node
    stop : Event
        When set, the subscription ends, what is queued is yielded, and the iteration ends.

    Attributes
    ----------
    missed : int
        Samples that publishers sent and that could not be had, as far as publishers number them.
    """

    def __init__(self, node: Node, stop: Event) -> None:
        self.missed = 0
        self._stop = stop
        self._newest_ns = 0
        self._warned = False
        self._keys = _Keys()
        self._looked_ns = 0
        self._session = node.session
        self._routers = len(node.session.info.routers_zid())
        self._subscribers = [_subscribed(node, f"{node.prefix}{space}/**") for space in _SPACES]
        self._receivers = [subscriber.handler.try_recv for subscriber in self._subscribers]
        self._misses: list[Any] = []
        if node.connection.recovery:
            self._misses = [each.sample_miss_listener(handlers.FifoChannel(QUEUE)) for each in self._subscribers]

    def __iter__(self) -> Iterator[list[Message]]:
        """Yield whatever is queued, a few thousand at a time; an empty list every `LOOK_UP_S` of silence."""
        nap, longest = _NAP_S
        quiet_s = 0.0
        while True:
            stopping = self._stop.is_set()
            while stopping and self._subscribers:
                self._subscribers.pop().undeclare()
            messages = self._drained()
            if messages and len(messages) < DRAIN and not stopping:
                time.sleep(GATHER_S)
                messages += self._drained()
            self._watch_routers()
            if messages or quiet_s >= LOOK_UP_S:
                yield messages
                quiet_s, nap = 0.0, _NAP_S[0]
            elif stopping:
                return
            else:
                time.sleep(nap)
                quiet_s += nap
                nap = min(2 * nap, longest)

    def _drained(self) -> list[Message]:
        """Return what is queued, stamped with one time that never runs backwards."""
        now = self._newest_ns = max(self._newest_ns, time.time_ns())
        out: list[Message] = []
        append, new, sample = out.append, tuple.__new__, None
        keys = self._keys
        for receive in self._receivers:
            try:
                for _ in range(DRAIN):
                    following = receive()
                    if following is None:
                        break
                    sample = following
                    append(new(Message, (keys[sample.key_expr], sample.payload.to_bytes(), now)))
            except zenoh.ZError:
                continue  # the subscription has ended and the channel is empty
        if sample is not None:
            self._look_after(sample)
        return out

    def _watch_routers(self) -> None:
        """Log that a router was lost or joined; Zenoh itself joins one again that comes back."""
        if self._newest_ns - self._looked_ns < WATCH_NS:
            return
        self._looked_ns = self._newest_ns
        routers = len(self._session.info.routers_zid())
        if routers != self._routers:
            _log.log(
                *((logging.WARNING, "router lost") if routers < self._routers else (logging.INFO, "router joined"))
            )
            self._routers = routers

    def _look_after(self, sample: Any) -> None:
        """Count what was missed, and warn of a router that stamps for plain publishers."""
        if not self._misses:
            return
        for listener in self._misses:
            try:
                while (miss := listener.try_recv()) is not None:
                    self.missed += miss.nb
            except zenoh.ZError:
                continue  # its subscription has ended, and it is empty
        if not self._warned and sample.timestamp is not None and sample.source_info is None:
            self._warned = True
            _log.warning(
                "a router stamps samples for plain publishers, and samples that cross may be lost: "
                "switch `timestamping` off in the router, or subscribe without recovery"
            )


class ZenohSink:
    """Publish messages, each key by an advanced publisher of its own, as a sink.

    Parameters
    ----------
    node : Node
    prefix : str
        Put before every key.
    """

    def __init__(self, node: Node, prefix: str = "") -> None:
        self._node = node
        self._session = node.session
        self._prefix = prefix
        self._publishers: dict[str, Any] = {}

    def has_subscriber(self) -> bool:
        """Return whether anybody subscribes to the fleet."""
        with self._session.declare_publisher(f"{self._prefix}fleet/**") as publisher:
            status: Any = publisher.matching_status
            return bool(status.matching)

    def put(self, messages: Sequence[Message]) -> None:
        """Publish messages, waiting where the network is slow.

        Raises
        ------
        SettingsError
            Where a key is not a Zenoh key expression, or the session is closed.
        """
        publishers = self._publishers
        try:
            for key, payload, _ in messages:
                publisher = publishers.get(key)
                if publisher is None:
                    publisher = publishers[key] = self._declared(self._prefix + key)
                publisher.put(payload)
        except zenoh.ZError as error:
            raise SettingsError(f"cannot publish: {format_zenoh_error(error)}") from error

    def close(self) -> None:
        """Undeclare the publishers once all is sent; the session stays open."""
        if self._publishers:
            self._node.flush()
        for publisher in self._publishers.values():
            publisher.undeclare()
        self._publishers.clear()

    def _declared(self, key: str) -> Any:
        """Return a publisher that numbers its samples, keeps the last ones, and can be found by late subscribers."""
        return ext.declare_advanced_publisher(
            self._session,
            key,
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.BLOCK,
            cache=ext.CacheConfig(CACHE),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=1.0),
            publisher_detection=True,
        )


def _subscribed(node: Node, keys: str) -> Any:
    """Return a subscriber with a channel of its own, an advanced one where what was missed is to be asked for."""
    channel: Any = handlers.FifoChannel(QUEUE)
    if not node.connection.recovery:
        return node.session.declare_subscriber(keys, channel, allowed_origin=zenoh.Locality.REMOTE)
    return ext.declare_advanced_subscriber(
        node.session,
        keys,
        channel,
        allowed_origin=zenoh.Locality.REMOTE,
        history=ext.HistoryConfig(detect_late_publishers=True),
        recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )
