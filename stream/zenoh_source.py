"""The Zenoh source: messages of a fleet that wait for the loop, in a queue that is limited by size.

Zenoh's channels are limited by a number of samples alone. A thread therefore moves the samples from
`socast.stream.zenoh_receiver` into a queue that is limited by size, and lets publishers wait while it is full. The
iteration over the source takes them from there.
"""

import logging
import time
from collections import Counter
from collections.abc import Iterator
from math import inf
from threading import Event, Thread
from typing import Final

from socast.core.settings import Limits
from socast.core.wire.message_block import MessageBlock
from socast.stream.message_queue import MOST_MESSAGES, MessageQueue
from socast.stream.source import LOOK_UP_S
from socast.stream.zenoh_receiver import ZenohReceiver
from socast.stream.zenoh_session import Node

DRAIN: Final = 4000
"""Number of messages from which no more are yielded at once; the processor's cache can hold them."""
DRAIN_BYTES: Final = 1 << 22
"""Size of messages from which no more are yielded at once. [B]"""
STOP_S: Final = 2.0
"""Time after a stop for which waiting samples are still moved into the queue; later they are dropped. [s]"""
YIELD_S: Final = 3.0
"""Time after a stop for which queued messages are still yielded; later they are dropped. [s]"""
GATHER_S: Final = 0.01
"""Time for which a short queue waits for more samples; a few large lists cost less than many small ones. [s]"""
GATHER_BYTES: Final = 1 << 19
"""Size of messages from which the queue does not wait for more. [B]"""
BRAKE_S: Final = 0.02
"""Time for which the queue is full before publishers wait, though Zenoh's channels may not be full. [s]"""
FULL_LOG_S: Final = 60.0
"""Least time between two warnings of a full queue. [s]"""
_log = logging.getLogger("socast.zenoh")


class ZenohSource:
    """Subscribe to a fleet and its weather under one prefix, as a source that can be iterated once.

    The messages of `{prefix}fleet/**` and those of `{prefix}weather/**` each come in order of arrival. Queued weather
    comes before queued telemetry. A source without a prefix does not receive fleets that have one. While the queue is
    full, publishers are blocked.

    Parameters
    ----------
    stop : Event
        Event that ends the subscription. The iteration then yields the queued messages and ends.
    queue_bytes : float
        Size of the messages that may be queued. [B]

    Attributes
    ----------
    dropped : Counter of str
        Number of received messages that were dropped, by cause; known at the end of the iteration.
    has_recovered : bool
        Whether the last list holds messages of the type `RecoveredMessage`, which came from caches.
    """

    def __init__(self, node: Node, stop: Event, queue_bytes: float = Limits().queue_bytes) -> None:
        self.dropped: Counter[str] = Counter()
        self.has_recovered = False
        self._stop = stop
        self._stop_by_s = inf
        self._most_bytes = queue_bytes
        self._queue = MessageQueue(queue_bytes)
        self._receiver = ZenohReceiver(node)
        self._unqueued = 0
        self._warned_full_s = -inf

    @property
    def missed(self) -> int | None:
        """Return the number of samples that publishers sent but the source could not get; None if it asks for none."""
        return self._receiver.missed

    @property
    def is_catching_up(self) -> bool:
        """Return whether live samples wait for the answers of caches."""
        return self._receiver.is_catching_up

    @property
    def queue_messages(self) -> int:
        """Return the number of queued messages."""
        return self._queue.messages

    @property
    def queue_bytes(self) -> int:
        """Return the size of the queued messages. [B]"""
        return self._queue.size

    def __iter__(self) -> Iterator[MessageBlock]:
        """Yield the queued messages, a few thousand at a time, or an empty block every `LOOK_UP_S` of silence."""
        errors: list[Exception] = []
        thread = Thread(target=self._receive_all, args=(errors,), name="zenoh-source", daemon=True)
        thread.start()
        unyielded = 0
        try:
            while self._queue.wait(LOOK_UP_S) or not self._queue.has_ended:
                if time.monotonic() > self._stop_by_s + YIELD_S - STOP_S:
                    unyielded = self._queue.drop()
                    break
                if self._is_short() and not self._queue.has_ended:
                    time.sleep(GATHER_S)
                messages, self.has_recovered = self._queue.take(DRAIN, DRAIN_BYTES)
                yield messages
        finally:
            self._queue.end()
            thread.join()
        if number := unyielded + self._unqueued:
            self.dropped["stop"] += number
            _log.warning("%d messages dropped: they still waited %g s after the stop", number, YIELD_S)
        if errors:
            raise errors[0]

    def _is_short(self) -> bool:
        """Return whether so little is queued that it pays to wait for more; few messages may hold many samples."""
        return 0 < self._queue.messages < DRAIN and self._queue.size < GATHER_BYTES

    def _receive_all(self, errors: list[Exception]) -> None:
        """Move samples from Zenoh's channels into the queue, until nothing is left after a stop."""
        try:
            self._fill_queue()
        except Exception as error:  # noqa: BLE001 -- the loop raises it
            errors.append(error)
        finally:
            self._queue.end()

    def _fill_queue(self) -> None:
        """Move samples into the queue until nothing is left after a stop; drop what is left when the time is over."""
        while not self._queue.has_ended and time.monotonic() <= self._stop_by_s:
            stopping = self._stop.is_set()
            self._obey_stop()
            received = self._receiver.receive(stopping=stopping)
            if received.messages:
                self._enqueue(received.messages, recovered=received.recovered)
            elif stopping and not received.samples:
                return
        self._unqueued += self._receiver.drop_rest()

    def _enqueue(self, messages: MessageBlock, *, recovered: bool) -> None:
        """Append messages to the queue; while it is full, wait until it is not, or until the stop has lasted."""
        size = messages.size
        if size > DRAIN_BYTES and (half := len(messages) // 2):  # many were held
            self._enqueue(messages[:half], recovered=recovered)
            self._enqueue(messages[half:], recovered=recovered)
            return
        if self._queue.put(messages, size, recovered=recovered, patience_s=BRAKE_S):
            return
        self._receiver.brake()
        while not self._queue.put(messages, size, recovered=recovered, patience_s=LOOK_UP_S):
            if self._queue.has_ended or time.monotonic() > self._stop_by_s:
                self._unqueued += len(messages)
                return
            self._obey_stop()
            self._warn_of_full_queue()

    def _obey_stop(self) -> None:
        """After a stop receive nothing more; what has arrived can still be taken for `STOP_S`."""
        if self._stop.is_set() and self._stop_by_s == inf:
            self._stop_by_s = time.monotonic() + STOP_S
            self._receiver.end()

    def _warn_of_full_queue(self) -> None:
        """Warn that publishers must wait, every `FULL_LOG_S`."""
        if (now := time.monotonic()) - self._warned_full_s > FULL_LOG_S:
            self._warned_full_s = now
            _log.warning(
                "the consumer is behind: %s messages of %s bytes are queued, limits %s messages and %s bytes "
                "(--max-queue-bytes), and publishers must wait; send lists of fewer samples, or give the consumer a "
                "faster processor",
                f"{self.queue_messages:,}",
                f"{self.queue_bytes:,}",
                f"{MOST_MESSAGES:,}",
                f"{self._most_bytes:,.0f}",
            )
