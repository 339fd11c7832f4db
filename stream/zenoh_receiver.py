"""The Zenoh subscribers: samples of a fleet and its weather, with what the caches of publishers hold in its place.

At the start, when sessions appear, and where the numbers of a publisher show a gap (`socast.stream.zenoh_gaps`), the
receiver asks caches (`socast.stream.zenoh_history`), and merges answers with live samples in the order of publication.
Zenoh's advanced subscriber costs more, and drops without a count what live samples overtake (zenoh 1.10).

A router and a client in one process share two receiving threads of Zenoh and can wait for each other. Subscribe in the
session of the router itself, and publish at high rates from another process.
"""

import logging
import time
from contextlib import suppress
from itertools import chain, filterfalse, islice, repeat
from math import inf
from typing import Any, Final, NamedTuple

import zenoh
from zenoh import handlers

from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import BATCH
from socast.stream.receipt_clock import ReceiptClock
from socast.stream.source import RecoveredMessage
from socast.stream.structured_log import event_fields
from socast.stream.zenoh_gaps import SampleGaps
from socast.stream.zenoh_history import CacheHistory, merge_samples
from socast.stream.zenoh_keys import KeyDeclarer, SampleKeys
from socast.stream.zenoh_session import Node

CHANNEL: Final = 1 << 12
"""Capacity of Zenoh's channels, in samples of any size; a full channel blocks publishers."""
BLOCK: Final = 1 << 12
"""Largest number of samples that are taken at once."""
BLOCK_BYTES: Final = 1 << 22
"""Size of samples that are taken at once, as far as the last samples predict it. [B]"""
WATCH_S: Final = 1.0
"""Time between two checks of the number of connected routers. [s]"""
_NAP_S: Final = 0.0002, 0.01  # shortest and longest wait for more samples; a busy channel is full after 0.02 s
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


def subscribe(session: zenoh.Session, keys: str, capacity: int) -> Any:
    """Return a subscriber to samples of other sessions, with a channel of its own."""
    channel: Any = handlers.FifoChannel(capacity)
    return session.declare_subscriber(keys, channel, allowed_origin=zenoh.Locality.REMOTE)


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
    """Subscribe to a fleet and its weather under one prefix, and take samples from Zenoh's channels."""

    def __init__(self, node: Node) -> None:
        self._clock = ReceiptClock()
        self._declarer = KeyDeclarer(node.session)
        self._keys = SampleKeys(self._declarer.add)
        self._gaps = SampleGaps()
        self._looked_s = time.monotonic()
        self._session = node.session
        self._routers = len(node.session.info.routers_zid())
        self._spaces = list_spaces(node)
        self._subscribers = [subscribe(self._session, keys, CHANNEL) for keys in self._spaces]
        self._receivers = [subscriber.handler.try_recv for subscriber in self._subscribers]
        self._batches = self._receivers[-1] if shares_batches(node) else None
        self._brakes: list[Any] = []
        self._block = BLOCK
        self._nap_s = 0.0
        self._history = CacheHistory(node, self._spaces) if node.connection.recovery else None

    @property
    def missed(self) -> int | None:
        """Return the number of samples that publishers sent but the receiver could not get; None without recovery."""
        return None if self._history is None else self._gaps.missed

    @property
    def is_catching_up(self) -> bool:
        """Return whether all live samples wait for the answers of caches."""
        return self._history is not None and self._history.is_waiting

    def receive(self, *, stopping: bool) -> Received:
        """Return what has come, after a short wait for more where little came the last time.

        While caches are asked, live samples are held, and then all are returned together in their order. A publisher's
        token comes before its samples, so the tokens are looked at after the samples.
        """
        time.sleep(self._nap_s)
        samples = self._receive(self._block)
        if len(samples) < self._block:
            self._release_brake()
        self._nap_s = 0.0 if stopping else adapt_nap(self._nap_s, len(samples) / self._block)
        if self._keys.begin_list_if_full():
            self._gaps.forget()
            self._declarer.forget()
        messages, recovered = self._order(samples, stopping=stopping)
        if size := messages.size:
            self._block = max(1, min(BLOCK, BLOCK_BYTES * len(messages) // size))
        self._watch_routers()
        return Received(messages, recovered, len(samples))

    def brake(self) -> None:
        """Let publishers wait until the channels are empty, as these are limited by a number of samples of any size.

        Zenoh hands each sample to all subscribers, and waits where a channel of one sample cannot take the second one.
        """
        if not self._brakes:
            self._brakes = [subscribe(self._session, keys, 1) for keys in self._spaces]

    def end(self) -> None:
        """Receive nothing more; what has arrived can still be taken. A second call has no effect."""
        self._release_brake()
        while self._subscribers:
            self._subscribers.pop().undeclare()
        self._declarer.close()
        if self._history is not None:
            self._history.close()

    def drop_rest(self) -> int:
        """End, drop what has arrived and was not taken, and return the number of its messages."""
        self.end()
        waiting = self._history.release(inf, everything=True) if self._history is not None else ([], [])
        rest = merge_samples(list(chain(*waiting)))
        while part := self._receive(CHANNEL):
            rest += part
        return sum([self._keys[each.key_expr] >= 0 for each in rest])

    def _release_brake(self) -> None:
        """Let publishers wait only where a channel is full."""
        while self._brakes:
            self._brakes.pop().undeclare()

    def _order(self, samples: list[Any], *, stopping: bool) -> tuple[MessageBlock, bool]:
        """Return the messages of live samples, after those that waited for caches where these have answered."""
        answers: list[Any] = []
        if (history := self._history) is not None:
            now = time.monotonic()
            history.collect(now)
            samples = history.withhold(samples, self._keys.find_text)
            held, answers = history.release(now, everything=stopping)
            samples = [*(merge_samples([*held, *answers]) if answers else held), *samples]
        numbers, samples = self._number(samples)
        recovered = {id(each) for each in answers}

        def ask(sample: Any, first: int) -> bool:
            key = self._keys.find_text(sample.key_expr)
            return id(sample) not in recovered and history is not None and history.ask_again(sample, key, first, now)

        if history is not None and self._gaps.find(numbers, samples, ask):
            numbers, samples = self._number(history.withhold(samples, self._keys.find_text))
        payloads = [each.payload.to_bytes() for each in samples]
        block = MessageBlock.pack(self._keys.texts, numbers, payloads, self._clock.read_ns())
        if recovered:
            pairs = zip(block, samples, strict=True)
            block = MessageBlock.of([RecoveredMessage(*it) if id(each) in recovered else it for it, each in pairs])
        return block, bool(recovered)

    def _number(self, samples: list[Any]) -> tuple[list[int], list[Any]]:
        """Return the numbers of the keys of samples, and the samples; without forecasts."""
        numbers = [self._keys[each.key_expr] for each in samples]
        if samples and min(numbers) < 0:
            samples = [each for each, number in zip(samples, numbers, strict=True) if number >= 0]
            numbers = [number for number in numbers if number >= 0]
        return numbers, samples

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
