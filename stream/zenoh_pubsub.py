"""The Zenoh subscriber, which is a source, and the Zenoh publisher, which is a sink.

One advanced subscriber receives the fleet and one the weather. Zenoh fills their channels, a thread moves the samples
into a queue that is limited by size, and the iteration over the source takes them from there. The subscribers request
missed samples from advanced publishers and count those that they could not get. At the start, and when publishers
appear, the source asks their caches (`stream.zenoh_history`) and merges the answers with live samples, in the order of
publication. Publishing blocks while the network is slow, so the sink drops nothing.

Notes
-----
The module allows for this observed behaviour of zenoh 1.10:

- An advanced subscriber orders samples that have a timestamp and no source number by timestamp, separately for each
  router that stamped them. If a router stamps the samples of plain publishers, as `zenohd` does by default, one of two
  samples that overtake each other in the router is lost. A burst of 180,000 samples from three publishers lost 600.
  The embedded router does not stamp samples. The source logs one warning if another router does.
- Declaring a publisher waits for samples that are being delivered. If the channel is full, these wait for the iteration
  that drains it. A session that also subscribes must therefore publish through a
  `stream.latest_only_sink.LatestOnlySink`.
- A router and a client in one process share two receiving threads and can wait for each other. Subscribe in the session
  of the router itself, and publish at high rates from another process.
"""

import logging
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import compress, islice, repeat
from math import inf
from threading import Event, Thread
from typing import Any, Final

import zenoh
from zenoh import ext, handlers

from core.errors import SettingsError
from core.settings import Limits
from core.wire.messages import Message
from stream.message_queue import MessageQueue
from stream.receipt_clock import ReceiptClock
from stream.source import LOOK_UP_S, RecoveredMessage
from stream.zenoh_history import CacheHistory, merge_samples
from stream.zenoh_session import Node, format_zenoh_error

CHANNEL: Final = 1 << 8
"""Capacity of Zenoh's channels, in samples of any size; a full channel blocks publishers."""
BLOCK: Final = 256
"""Largest number of samples that the receiving thread takes at once."""
BLOCK_BYTES: Final = 1 << 22
"""Size of samples that the receiving thread takes at once, as far as the last samples predict it. [B]"""
DRAIN: Final = 4000
"""Number of messages from which no more are yielded at once; the processor's cache can hold them."""
DRAIN_BYTES: Final = 1 << 22
"""Size of messages from which no more are yielded at once. [B]"""
HOLD_BYTES: Final = 1 << 26
"""Size of live samples and answers that may wait for further answers of caches; more end the wait. [B]"""
STOP_S: Final = 2.0
"""Time after a stop for which waiting samples are still moved into the queue; later they are dropped. [s]"""
YIELD_S: Final = 3.0
"""Time after a stop for which queued messages are still yielded; later they are dropped. [s]"""
GATHER_S: Final = 0.01
"""Time for which a short queue waits for more samples; a few large lists cost less than many small ones. [s]"""
FULL_LOG_S: Final = 60.0
"""Least time between two warnings of a full queue. [s]"""
CACHE: Final = 64
"""Number of samples of each key that a publisher can send again."""
WATCH_S: Final = 1.0
"""Time between two checks of the number of connected routers. [s]"""
_SPACES: Final = "weather", "fleet"
"""Key spaces in the order in which the source subscribes to them and drains them.

A weather observation then does not come after the samples that it applies to. A node that detects the subscription to
the fleet can rely on the subscription to the weather.
"""
_MOST_KEYS, _LONGEST_KEY = 100_000, 512  # that are remembered as text
_NAP_S: Final = 0.0002, 0.01  # shortest and longest wait for more samples; a busy channel is full after 0.001 s
_log = logging.getLogger("socast.zenoh")


class _Keys(dict[Any, str]):
    """Map a key expression to its text, which is made only once; to an empty text for forecasts, which are no input."""

    def __missing__(self, key: Any) -> str:
        text = str(key)
        text = "" if text.endswith("/forecast") else text
        if len(self) >= _MOST_KEYS:
            self.clear()
        if len(text) <= _LONGEST_KEY:
            self[key] = text
        return text


def adapt_nap(nap_s: float, fullness: float) -> float:
    """Return how long to wait for more samples, so that a look finds about half as many as it takes at most.

    A look that finds few samples costs as much as one that finds many, and a full channel blocks publishers.

    Parameters
    ----------
    nap_s : float
        Wait before the last look. [s]
    fullness : float
        Number of samples that the last look found, relative to the most that it takes. [1]

    Examples
    --------
    >>> adapt_nap(0.004, 1.0), adapt_nap(0.004, 0.5), adapt_nap(0.004, 0.1)
    (0.0, 0.004, 0.008)
    """
    shortest, longest = _NAP_S
    if fullness >= 1.0:
        return 0.0
    factor = 2.0 if fullness < 0.4 else 0.5 if fullness > 0.8 else 1.0
    return min(max(factor * nap_s, shortest), longest)


class ZenohSource:
    """Subscribe to a fleet and its weather under one prefix, as a source that can be iterated once.

    The messages of `{prefix}fleet/**` and those of `{prefix}weather/**` each come in order of arrival. Queued weather
    comes before queued telemetry. A source without a prefix does not receive fleets that have one.

    Zenoh's channels are limited by a number of samples alone. A thread therefore moves the samples into a queue that is
    limited by size. While the queue is full, the channels fill and publishers are blocked.

    Parameters
    ----------
    node : Node
        Session and prefix to subscribe with.
    stop : Event
        Event that ends the subscription. The iteration then yields the queued messages and ends.
    queue_bytes : float
        Size of the messages that may be queued. [B]

    Attributes
    ----------
    missed : int
        Number of samples that publishers sent but the source could not get, as far as publishers number their samples.
    dropped : Counter of str
        Number of received messages that were dropped, by cause.
    is_catching_up : bool
        Whether live samples wait for the answers of caches.
    has_recovered : bool
        Whether the last list holds messages of the type `RecoveredMessage`, which came from caches.
    """

    def __init__(self, node: Node, stop: Event, queue_bytes: float = Limits().queue_bytes) -> None:
        self.missed = 0
        self.dropped: Counter[str] = Counter()
        self.is_catching_up = node.connection.recovery
        self.has_recovered = False
        self._stop = stop
        self._stop_by_s = inf
        self._queue = MessageQueue(queue_bytes)
        self._warned_full_s = -inf
        self._clock = ReceiptClock()
        self._warned = False
        self._keys = _Keys()
        self._looked_s = time.monotonic()
        self._session = node.session
        self._own = str(node.session.zid())
        self._routers = len(node.session.info.routers_zid())
        self._subscribers = [_subscribe(node, f"{node.prefix}{space}/**") for space in _SPACES]
        self._receivers = [subscriber.handler.try_recv for subscriber in self._subscribers]
        self._block = BLOCK
        self._nap_s = 0.0
        self._misses: list[Any] = []
        self._history: CacheHistory | None = None
        self._held: list[Any] = []
        self._answers: list[Any] = []
        self._held_bytes = 0
        if node.connection.recovery:
            self._history = CacheHistory(node, [f"{node.prefix}{space}/**" for space in _SPACES])
            self._misses = [each.sample_miss_listener(handlers.FifoChannel(CHANNEL)) for each in self._subscribers]

    @property
    def queue_messages(self) -> int:
        """Return the number of queued messages."""
        return self._queue.messages

    @property
    def queue_bytes(self) -> int:
        """Return the size of the queued messages. [B]"""
        return self._queue.size

    def __iter__(self) -> Iterator[list[Message]]:
        """Yield the queued messages, a few thousand at a time, or an empty list every `LOOK_UP_S` of silence.

        Raises
        ------
        Exception
            What the receiving thread raised.
        """
        errors: list[Exception] = []
        thread = Thread(target=self._receive_all, args=(errors,), name="zenoh-source", daemon=True)
        thread.start()
        try:
            while self._queue.wait(LOOK_UP_S) or not self._queue.has_ended:
                if time.monotonic() > self._stop_by_s + YIELD_S - STOP_S:
                    self.dropped["stop"] += self._queue.messages
                    break
                if 0 < self._queue.messages < DRAIN and not self._queue.has_ended:
                    time.sleep(GATHER_S)
                messages, self.has_recovered = self._queue.take(DRAIN, DRAIN_BYTES)
                yield messages
        finally:
            self._queue.end()
            thread.join()
        if number := self.dropped["stop"]:
            _log.warning("%d messages dropped: they still waited %g s after the stop", number, YIELD_S)
        if errors:
            raise errors[0]

    def _receive_all(self, errors: list[Exception]) -> None:
        """Move samples from Zenoh's channels into the queue, until nothing is left after a stop."""
        try:
            self._fill_queue()
        except Exception as error:  # noqa: BLE001 -- the loop raises it
            errors.append(error)
        finally:
            self._queue.end()

    def _fill_queue(self) -> None:
        """Move samples into the queue until the source ends."""
        while not self._queue.has_ended:
            stopping = self._stop.is_set()
            if stopping and self._subscribers:
                self._end_subscriptions()
            if time.monotonic() > self._stop_by_s:
                self._drop_rest()
                return
            messages, recovered = self._drain(stopping=stopping)
            self._count_misses()
            self._watch_routers()
            if messages:
                self._enqueue(messages, recovered=recovered)
            elif stopping:
                return
            if self._nap_s:
                time.sleep(self._nap_s)

    def _enqueue(self, messages: list[Message], *, recovered: bool) -> None:
        """Append messages to the queue; while it is full, wait until it is not, or until the stop has lasted."""
        size = sum([len(message[1]) for message in messages])
        if size > DRAIN_BYTES and (half := len(messages) // 2):  # many were held
            self._enqueue(messages[:half], recovered=recovered)
            self._enqueue(messages[half:], recovered=recovered)
            return
        self._block = max(1, min(BLOCK, BLOCK_BYTES * len(messages) // max(1, size)))
        while not self._queue.put(messages, size, recovered=recovered, patience_s=LOOK_UP_S):
            if self._queue.has_ended or time.monotonic() > self._stop_by_s:
                self.dropped["stop"] += len(messages)
                return
            if self._stop.is_set() and self._subscribers:
                self._end_subscriptions()
            if (now := time.monotonic()) - self._warned_full_s > FULL_LOG_S:
                self._warned_full_s = now
                _log.warning(
                    "the consumer is behind: %s messages of %s bytes are queued, and publishers must wait; "
                    "make lists smaller, or give the consumer a faster processor",
                    f"{self.queue_messages:,}",
                    f"{self.queue_bytes:,}",
                )

    def _end_subscriptions(self) -> None:
        """Receive nothing more; what has arrived can still be taken for `STOP_S`."""
        self._stop_by_s = time.monotonic() + STOP_S
        while self._subscribers:
            self._subscribers.pop().undeclare()
        if self._history is not None:
            self._history.close()

    def _drop_rest(self) -> None:
        """Drop and count what was not moved into the queue in time."""
        count = len(self._held) + len(self._answers)
        while part := len(self._receive(CHANNEL, CHANNEL)):
            count += part
        self.dropped["stop"] += count

    def _drain(self, *, stopping: bool) -> tuple[list[Message], bool]:
        """Return received messages, and whether some came from caches.

        While caches are asked, live samples are held, and then all are returned together in their order. A publisher's
        token comes before its samples, so the tokens are looked at after the samples.
        """
        samples = self._receive(CHANNEL, self._block)
        self._nap_s = adapt_nap(self._nap_s, len(samples) / self._block)
        if self._history is not None and self._must_hold(samples, stopping=stopping):
            return [], False
        if self._answers:
            return self._merge(), True
        samples, self._held = self._held or samples, []
        if not samples:
            return [], False
        self._warn_of_stamps(samples[-1])
        keys = [self._keys[each.key_expr] for each in samples]
        payloads = [each.payload.to_bytes() for each in samples]
        fields = zip(keys, payloads, repeat(self._clock.read_ns()))
        return list(compress(map(tuple.__new__, repeat(Message), fields), keys)), False

    def _must_hold(self, samples: list[Any], *, stopping: bool) -> bool:
        """Return whether the received samples must wait for the answers of caches.

        If they must wait, or if answers have come, all samples that have arrived are held and later merged with the
        answers. These may be newer than the end of the channel.
        """
        assert self._history is not None
        now = time.monotonic()
        answers = self._history.collect(now)
        self._answers += answers
        self._held_bytes += sum([len(answer.payload) for answer in answers])
        self.is_catching_up = self._history.is_waiting(now) and not stopping and self._held_bytes < HOLD_BYTES
        if self.is_catching_up or self._answers or self._held:
            while samples and self._held_bytes < HOLD_BYTES:
                self._held += samples
                self._held_bytes += sum([len(sample.payload) for sample in samples])
                samples = self._receive(CHANNEL, self._block)
            self._held += samples
        if not self.is_catching_up:
            self._held_bytes = 0
        return self.is_catching_up

    def _merge(self) -> list[Message]:
        """Return the live samples that waited and the answers of caches, in the order of publication."""
        live, answers, self._held, self._answers = self._held, self._answers, [], []
        recovered, stamp = {id(answer) for answer in answers}, self._clock.read_ns()
        return [
            (RecoveredMessage if id(each) in recovered else Message)(key, each.payload.to_bytes(), stamp)
            for each in merge_samples([*live, *answers])
            if (key := self._keys[each.key_expr])
        ]

    def _receive(self, *limits: int) -> list[Any]:
        """Return queued samples, at most a number of each space."""
        out: list[Any] = []
        for receive, most in zip(self._receivers, limits, strict=True):
            with suppress(zenoh.ZError):  # the subscription has ended; what came before stays in the list
                out.extend(islice(iter(receive, None), most))
        return out

    def _watch_routers(self) -> None:
        """Log that a router was lost or joined; Zenoh itself reconnects to a router that returns."""
        if (now := time.monotonic()) - self._looked_s < WATCH_S:
            return
        self._looked_s = now
        routers = len(self._session.info.routers_zid())
        if routers != self._routers:
            _log.log(
                *((logging.WARNING, "router lost") if routers < self._routers else (logging.INFO, "router joined"))
            )
            self._routers = routers

    def _count_misses(self) -> None:
        """Count samples that publishers could not send again."""
        for listener in self._misses:
            try:
                while (miss := listener.try_recv()) is not None:
                    self.missed += miss.nb
            except zenoh.ZError:
                continue  # the subscription has ended and the listener is empty

    def _warn_of_stamps(self, sample: Any) -> None:
        """Warn once of a router that stamps the samples of plain publishers."""
        if self._warned or not self._misses or sample.timestamp is None or sample.source_info is not None:
            return
        if str(sample.timestamp.get_id()) in {self._own, *map(str, self._session.info.routers_zid())}:
            self._warned = True
            _log.warning(
                "a router stamps samples for plain publishers, and samples that cross may be lost: "
                "switch `timestamping` off in the router, or subscribe without recovery"
            )


class ZenohSink:
    """Publish messages as a sink, with one advanced publisher per key.

    Parameters
    ----------
    node : Node
        Session to publish in.
    prefix : str
        Text before every key.
    """

    def __init__(self, node: Node, prefix: str = "") -> None:
        self._node = node
        self._session = node.session
        self._prefix = prefix
        self._publishers: dict[str, Any] = {}

    def has_subscriber(self) -> bool:
        """Return whether any node subscribes to the fleet."""
        with self._session.declare_publisher(f"{self._prefix}fleet/**") as publisher:
            status: Any = publisher.matching_status
            return bool(status.matching)

    def put(self, messages: Sequence[Message]) -> None:
        """Publish messages; the call blocks while the network is slow.

        Parameters
        ----------
        messages : sequence of Message
            Messages to publish; their times of receipt are not sent.

        Raises
        ------
        SettingsError
            If a key is not a Zenoh key expression, or if the session is closed.
        """
        publishers = self._publishers
        try:
            for key, payload, _ in messages:
                publisher = publishers.get(key)
                if publisher is None:
                    publisher = publishers[key] = self._declare(self._prefix + key)
                publisher.put(payload)
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


def _subscribe(node: Node, keys: str) -> Any:
    """Return a subscriber with its own channel; an advanced one if missed samples are to be requested."""
    channel: Any = handlers.FifoChannel(CHANNEL)
    if not node.connection.recovery:
        return node.session.declare_subscriber(keys, channel, allowed_origin=zenoh.Locality.REMOTE)
    return ext.declare_advanced_subscriber(
        node.session,
        keys,
        channel,
        allowed_origin=zenoh.Locality.REMOTE,
        recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )
