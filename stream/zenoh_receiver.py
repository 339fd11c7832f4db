"""The Zenoh subscribers: samples of a fleet and its weather, with what the caches of publishers hold in its place.

One advanced subscriber receives the fleet and one the weather. They request missed samples from advanced publishers and
count those that they could not get. At the start, and when sessions appear, the receiver asks their caches
(`socast.stream.zenoh_history`) and merges the answers with live samples, in the order of publication.

Notes
-----
The module allows for this observed behaviour of zenoh 1.10:

- An advanced subscriber orders samples that have a timestamp and no source number by timestamp, separately for each
  router that stamped them. If a router stamps the samples of plain publishers, as `zenohd` does by default, one of two
  samples that overtake each other in the router is lost. A burst of 180,000 samples from three publishers lost 600.
  The embedded router does not stamp samples. The receiver logs one warning if another router does.
- A router and a client in one process share two receiving threads and can wait for each other. Subscribe in the session
  of the router itself, and publish at high rates from another process.
"""

import logging
import time
from contextlib import suppress
from datetime import timedelta
from itertools import chain, filterfalse, islice, repeat
from math import inf
from typing import Any, Final, NamedTuple

import zenoh
from zenoh import ext, handlers

from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import BATCH, Message
from socast.stream.receipt_clock import ReceiptClock
from socast.stream.source import RecoveredMessage
from socast.stream.structured_log import event_fields
from socast.stream.zenoh_history import HOLD_BYTES, CacheHistory, merge_samples
from socast.stream.zenoh_session import Node

CHANNEL: Final = 1 << 8
"""Capacity of Zenoh's channels, in samples of any size; a full channel blocks publishers."""
BLOCK: Final = 256
"""Largest number of samples that are taken at once."""
BLOCK_BYTES: Final = 1 << 22
"""Size of samples that are taken at once, as far as the last samples predict it. [B]"""
WATCH_S: Final = 1.0
"""Time between two checks of the number of connected routers. [s]"""
_MOST_KEYS, _MOST_CHARACTERS, _LONGEST_KEY = 100_000, 1 << 23, 512  # that are remembered as text
_NAP_S: Final = 0.0002, 0.01  # shortest and longest wait for more samples; a busy channel is full after 0.001 s
_NONE: Final = MessageBlock.of([])
# A heartbeat tells the number of a sample that its publisher may still be waiting to send. What the subscriber then
# requests is lost when it comes. Zenoh takes heartbeats or a period; zenoh-python 1.10 takes only a timedelta for it.
_ON_GAPS: Final = ext.RecoveryConfig(periodic_queries=timedelta(days=1), heartbeat=None)  # type: ignore[arg-type]
_log = logging.getLogger("socast.zenoh")


def list_spaces(node: Node) -> list[str]:
    """Return the key expressions to subscribe to, in the order in which the receiver subscribes and drains them.

    A weather observation then does not come after the samples that it applies to. A node that detects the subscription
    to the fleet can rely on the subscription to the weather. Every shard receives all weather and, where names divide
    the fleet, the batches of all gateways, as they hold any cars.
    """
    shard = node.connection.shard
    cars = [f"{node.prefix}fleet/**"] if shard is None else [f"{each}/**" for each in node.list_cars()]
    return [f"{node.prefix}weather/**", *cars, *([f"{node.prefix}fleet/*/{BATCH}"] if shares_batches(node) else [])]


def shares_batches(node: Node) -> bool:
    """Return whether a node receives the batches of gateways whatever their names."""
    shard = node.connection.shard
    return shard is not None and shard.by == "name" and shard.count > 1


class Received(NamedTuple):
    """Hold what was received at once.

    Parameters
    ----------
    recovered : bool
        Whether some of them came from the caches of publishers; these are of the type `RecoveredMessage`.
    samples : int
        Number of samples that were taken from the channels; 0 once nothing is left after the end.
    """

    messages: MessageBlock
    recovered: bool
    samples: int


class _Keys(dict[Any, int]):
    """Number the key expressions of messages, and make the text of each only once; forecasts, no input, have -1.

    Attributes
    ----------
    texts : list of str
        Text of each number. Once there are many, another list begins, and blocks of messages hold the one before.
    """

    def __init__(self) -> None:
        self.texts: list[str] = []
        self._characters = 0

    def __missing__(self, key: Any) -> int:
        text = str(key)
        number = -1 if text.endswith("/forecast") else len(self.texts)
        if number >= 0:
            self.texts.append(text)
            self._characters += len(text)
        if len(text) <= _LONGEST_KEY:
            self[key] = number
        return number

    def find_text(self, key: Any) -> str:
        """Return the text of a key expression; an empty one for forecasts."""
        return self.texts[number] if (number := self[key]) >= 0 else ""

    def begin_list_if_full(self) -> None:
        """Begin another list of texts where there are many, as strangers may make up keys."""
        if len(self) >= _MOST_KEYS or self._characters >= _MOST_CHARACTERS:
            self.clear()
            self.texts, self._characters = [], 0


def adapt_nap(nap_s: float, fullness: float) -> float:
    """Return how long to wait for more samples, so that a look finds about half as many as it takes at most.

    A look that finds few samples costs as much as one that finds many, and a full channel blocks publishers.

    Parameters
    ----------
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


class ZenohReceiver:
    """Subscribe to a fleet and its weather under one prefix, and take samples from Zenoh's channels.

    Attributes
    ----------
    missed : int or None
        Number of samples that publishers sent but the receiver could not get, as far as publishers number their
        samples; None if missed samples are not requested.
    is_catching_up : bool
        Whether live samples wait for the answers of caches.
    """

    def __init__(self, node: Node) -> None:
        self.missed: int | None = 0 if node.connection.recovery else None
        self.is_catching_up = node.connection.recovery
        self._clock = ReceiptClock()
        self._warned = False
        self._keys = _Keys()
        self._looked_s = time.monotonic()
        self._session = node.session
        self._own = str(node.session.zid())
        self._routers = len(node.session.info.routers_zid())
        spaces = list_spaces(node)
        self._subscribers = [_subscribe(node, keys) for keys in spaces]
        self._receivers = [subscriber.handler.try_recv for subscriber in self._subscribers]
        self._batches = self._receivers[-1] if shares_batches(node) else None
        self._block = BLOCK
        self._nap_s = 0.0
        self._misses: list[Any] = []
        self._history: CacheHistory | None = None
        self._held: list[Any] = []
        self._answers: list[Any] = []
        self._held_bytes = 0
        if node.connection.recovery:
            self._history = CacheHistory(node, spaces)
            self._misses = [each.sample_miss_listener(handlers.FifoChannel(CHANNEL)) for each in self._subscribers]

    def receive(self, *, stopping: bool) -> Received:
        """Return what has come, after a short wait for more where little came the last time.

        While caches are asked, live samples are held, and then all are returned together in their order. A publisher's
        token comes before its samples, so the tokens are looked at after the samples.
        """
        if self._nap_s:
            time.sleep(self._nap_s)
        samples = self._receive(self._block)
        self._nap_s = 0.0 if stopping else adapt_nap(self._nap_s, len(samples) / self._block)
        messages, recovered = self._order(samples, stopping=stopping)
        self._count_misses()
        self._watch_routers()
        return Received(messages, recovered, len(samples))

    def predict_block(self, messages: int, size: int) -> None:
        """Take only so many samples at once that they are not much larger than `BLOCK_BYTES`.

        Units: size [B].
        """
        self._block = max(1, min(BLOCK, BLOCK_BYTES * messages // max(1, size)))

    def end(self) -> None:
        """Receive nothing more; what has arrived can still be taken. A second call has no effect."""
        while self._subscribers:
            self._subscribers.pop().undeclare()
        if self._history is not None:
            self._history.close()

    def drop_rest(self) -> int:
        """End, drop what has arrived and was not taken, and return the number of its messages."""
        self.end()
        waiting = self._history.release(inf, everything=True) if self._history is not None else ([], [])
        rest = merge_samples([*self._held, *self._answers, *chain(*waiting)])
        self._held, self._answers = [], []
        while part := self._receive(CHANNEL):
            rest += part
        return sum([self._keys[each.key_expr] >= 0 for each in rest])

    def _order(self, samples: list[Any], *, stopping: bool) -> tuple[MessageBlock, bool]:
        """Return the messages of live samples, or of all that waited where caches have answered, and which of both."""
        if self._history is not None:
            samples = self._recover(self._history, samples, stopping=stopping)
            if self.is_catching_up:
                return _NONE, False
        if self._answers:
            return MessageBlock.of(self._merge()), True
        samples, self._held = self._held or samples, []
        if not samples:
            return _NONE, False
        self._warn_of_stamps(samples[-1])
        self._keys.begin_list_if_full()
        numbers = [self._keys[each.key_expr] for each in samples]
        if min(numbers) < 0:
            samples = [each for each, number in zip(samples, numbers, strict=True) if number >= 0]
            numbers = [number for number in numbers if number >= 0]
        payloads = [each.payload.to_bytes() for each in samples]
        return MessageBlock.pack(self._keys.texts, numbers, payloads, self._clock.read_ns()), False

    def _recover(self, history: CacheHistory, samples: list[Any], *, stopping: bool) -> list[Any]:
        """Take the answers of caches, hold the live samples that must wait for them, and return the others.

        If all must wait, or if answers of all have come, all samples that have arrived are held and later merged with
        the answers. These may be newer than the end of the channel.
        """
        now = time.monotonic()
        answers = history.collect(now)
        live, of_sessions = history.release(now, everything=stopping)
        self._held_bytes += sum([len(answer.payload) for answer in answers])
        self.is_catching_up = history.is_waiting(now) and not stopping and self._held_bytes < HOLD_BYTES
        of_all = self.is_catching_up or bool(answers or self._answers or self._held)
        self._answers += answers + of_sessions
        if not of_all:
            samples = history.withhold(samples, self._keys.find_text)
            self._held += [*live, *samples] if live or of_sessions else []
            return samples
        self._held += live
        while samples and self._held_bytes < HOLD_BYTES:
            self._held += samples
            self._held_bytes += sum([len(sample.payload) for sample in samples])
            samples = self._receive(self._block)
        self._held += samples
        if not self.is_catching_up:
            self._held_bytes = 0
        return []

    def _merge(self) -> list[Message]:
        """Return the live samples that waited and the answers of caches, in the order of publication."""
        live, answers, self._held, self._answers = self._held, self._answers, [], []
        recovered, stamp = {id(answer) for answer in answers}, self._clock.read_ns()
        return [
            (RecoveredMessage if id(each) in recovered else Message)(key, each.payload.to_bytes(), stamp)
            for each in merge_samples([*live, *answers])
            if (key := self._keys.find_text(each.key_expr))
        ]

    def _receive(self, most: int) -> list[Any]:
        """Return queued samples: all weather, and at most a number of each space of the fleet."""
        out: list[Any] = []
        for receive, limit in zip(self._receivers, chain([CHANNEL], repeat(most)), strict=False):
            with suppress(zenoh.ZError):  # the subscription has ended; what came before stays in the list
                taken = islice(iter(receive, None), limit)
                out.extend(taken if self._batches in {None, receive} else filterfalse(self._is_batch, taken))
        return out

    def _is_batch(self, sample: Any) -> bool:
        """Return whether a sample is a batch of a gateway, which comes by a subscription of its own too."""
        return self._keys.find_text(sample.key_expr).endswith(f"/{BATCH}")

    def _watch_routers(self) -> None:
        """Log that a router was lost or joined; Zenoh itself reconnects to a router that returns."""
        if (now := time.monotonic()) - self._looked_s < WATCH_S:
            return
        self._looked_s = now
        routers = len(self._session.info.routers_zid())
        if routers != self._routers:
            level, event = (
                (logging.WARNING, "router lost") if routers < self._routers else (logging.INFO, "router joined")
            )
            _log.log(level, event, extra=event_fields(routers=routers))
            self._routers = routers

    def _count_misses(self) -> None:
        """Count samples that publishers could not send again."""
        for listener in self._misses:
            try:
                while (miss := listener.try_recv()) is not None:
                    self.missed = (self.missed or 0) + miss.nb
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
        recovery=_ON_GAPS,
    )
