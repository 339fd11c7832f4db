"""Sources and sinks of messages, and functions that merge, stop and pace sources.

A source is any iterable of lists of messages. Each list holds the messages that are ready, in order of receipt. A
source yields an empty list when nothing arrives for a while, so that the loop over it can do other work. A source that
receives a stop request yields the messages that it already holds and ends. The loop never breaks out of a source.
"""

import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from math import inf
from operator import attrgetter
from threading import Event
from typing import Final, Protocol, TypeAlias

from socast.core.errors import SettingsError
from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Message

Source: TypeAlias = Iterable[Sequence[Message]]
"""An iterable that yields messages, in sequences of those that are ready."""

LOOK_UP_S: Final = 0.2
"""Longest time without a list from a live or paced source: it yields an empty list if no message is ready. [s]"""
BREATH_S: Final = 0.02
"""Time within which messages that fall due are yielded together. [s]"""

_receipt = attrgetter("receipt_ns")


class RecoveredMessage(Message):
    """Mark a message that came from the cache of its publisher."""


class Sink(Protocol):
    """Receive messages."""

    def put(self, messages: Sequence[Message]) -> None:
        """Receive messages; an empty sequence is allowed."""

    def close(self) -> None:
        """Pass on everything that is buffered; a second call has no effect."""


def merge_sources(sources: Sequence[Source]) -> Iterator[Sequence[Message]]:
    """Yield the messages of several sources in order of receipt.

    Each source must itself be in that order. The function reads each source lazily, one list at a time. It sorts and
    yields all messages up to the earliest end of the lists that it holds, because no later list can hold an earlier
    message. Messages at that end wait if an earlier source may have another one there, so that the order does not
    depend on where lists end.
    """
    if len(sources) == 1:
        yield from sources[0]
        return
    heads: list[Sequence[Message]] = [[] for _ in sources]
    tails = [iter(source) for source in sources]
    live = list(range(len(sources)))
    while True:
        for i in list(live):
            while not heads[i]:
                block = next(tails[i], None)
                if block is None:
                    live.remove(i)
                    break
                heads[i] = block
        if not live:
            return
        horizon = min(heads[i][-1].receipt_ns for i in live)
        ready: list[Sequence[Message]] = []
        waits = False
        for i in live:
            find, ends = bisect_left if waits else bisect_right, heads[i][-1].receipt_ns == horizon
            cut, waits = find(heads[i], horizon, key=_receipt), waits or ends
            ready.append(heads[i][:cut])
            heads[i] = heads[i][cut:]
        yield MessageBlock.join(ready).sort()


def stop_source(source: Source, stop: Event) -> Iterator[Sequence[Message]]:
    """Yield the lists of a source until `stop` is set.

    The function suits only sources, such as recordings, that hold no messages which a stop would lose.
    """
    for messages in source:
        if stop.is_set():
            return
        yield messages


def pace_source(
    source: Source,
    speed: float,
    *,
    longest_gap_s: float = inf,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Sequence[Message]]:
    """Yield the messages of a recording when they fall due, `speed` times as fast as they were received.

    Parameters
    ----------
    speed : float
        Ratio of recorded time to real time: 1 for real time, `math.inf` for as fast as possible. [1]
    """
    if not speed > 0:
        raise SettingsError(f"speed is {speed:g}, must be above 0; give a number such as 60, or `max`")
    if not longest_gap_s > 0:
        raise SettingsError(f"the longest gap is {longest_gap_s:g} s, must be above 0 s")
    return iter(source) if speed == inf else _pace(source, speed, longest_gap_s, clock, sleep)


def _pace(
    source: Source, speed: float, longest_gap_s: float, clock: Callable[[], float], sleep: Callable[[float], None]
) -> Iterator[Sequence[Message]]:
    """Pace a source at a finite speed; `zero_s` is the time of receipt that corresponds to the clock's start."""
    began: float | None = None
    zero_s = newest_s = 0.0
    for block in source:
        at = 0
        while at < len(block):
            first_s = block[at].receipt_ns * 1e-9
            if began is None:
                began, zero_s, newest_s = clock(), first_s, first_s
            zero_s += max(0.0, first_s - newest_s - longest_gap_s)
            newest_s = first_s
            wait_s = (first_s - zero_s) / speed - (clock() - began)
            if wait_s > 0:
                sleep(min(max(wait_s, BREATH_S), LOOK_UP_S))
                if wait_s > LOOK_UP_S:
                    yield []
                    continue
            due_s = zero_s + (clock() - began) * speed
            cut = max(at + 1, _find_due(block, at, due_s, longest_gap_s))
            yield block[at:cut]
            newest_s = block[cut - 1].receipt_ns * 1e-9
            at = cut


def _find_due(block: Sequence[Message], at: int, due_s: float, longest_gap_s: float) -> int:
    """Return the end of the messages from `at` that have fallen due, at most up to the next gap to be shortened."""
    cut = bisect_right(block, round(due_s * 1e9), lo=at, key=_receipt)
    if longest_gap_s < inf:
        gap_ns = longest_gap_s * 1e9
        for i in range(at + 1, cut):
            if block[i].receipt_ns - block[i - 1].receipt_ns > gap_ns:
                return i
    return cut
