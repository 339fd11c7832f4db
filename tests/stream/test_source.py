"""Merged, paced and stopped sources keep the order of messages and lose none."""

from itertools import pairwise
from math import inf
from threading import Event

import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.errors import SettingsError
from socast.core.wire.messages import Message
from socast.stream.memory import MemorySink, MemorySource
from socast.stream.source import merge_sources, pace_source, stop_source

SECOND = 1_000_000_000


def at(*seconds: float, key: str = "k") -> list[Message]:
    return [Message(key, b"%d" % i, round(s * SECOND)) for i, s in enumerate(seconds)]


class Clock:
    """A clock that advances only during sleep, and by `cost` at each reading."""

    def __init__(self, cost: float = 0.0) -> None:
        self.now, self.cost = 100.0, cost

    def __call__(self) -> float:
        self.now += self.cost
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


times = st.lists(st.integers(0, 50), max_size=30).map(sorted)


@given(recordings=st.lists(times, min_size=1, max_size=4), chunk=st.integers(1, 7))
def test_merged_sources_are_sorted_without_loss(recordings, chunk):
    lists = [[Message(str(n), b"%d" % i, t) for i, t in enumerate(ts)] for n, ts in enumerate(recordings)]
    got = [m for block in merge_sources([MemorySource(part, chunk) for part in lists]) for m in block]
    assert [m.receipt_ns for m in got] == sorted(t for ts in recordings for t in ts)
    for n, part in enumerate(lists):
        assert [m for m in got if m.key == str(n)] == part


def test_equal_times_come_in_the_order_of_sources_wherever_lists_end():
    lists = [[Message(name, b"%d" % i, 7) for i in range(3)] for name in "abc"]
    for chunk in (1, 2, 3):
        got = [m for block in merge_sources([MemorySource(part, chunk) for part in lists]) for m in block]
        assert got == [message for part in lists for message in part]


def test_merging_reads_sources_lazily():
    taken = []

    def source(name: str, *seconds: float):
        for s in seconds:
            taken.append((name, s))
            yield at(s, key=name)

    stream = merge_sources([source("a", 1, 5, 9), source("b", 2, 3, 4)])
    assert [m.receipt_ns for m in next(stream)] == [SECOND]
    assert taken == [("a", 1), ("b", 2)]


@given(seconds=st.lists(st.floats(0, 300), max_size=40).map(sorted), speed=st.floats(1, 1e4), chunk=st.integers(1, 9))
def test_paced_messages_keep_order_without_loss_and_are_never_early(seconds, speed, chunk):
    clock = Clock()
    sent = at(*seconds)
    got = []
    for block in pace_source(MemorySource(sent, chunk), speed, clock=clock, sleep=clock.sleep):
        for message in block:
            due = 100.0 + (message.receipt_ns - sent[0].receipt_ns) / SECOND / speed
            assert clock.now >= due - 1e-6
            assert clock.now <= due + 0.03  # 20 ms of grouping, and rounding
        got += block
    assert got == sent


def test_slow_consumer_catches_up_with_pace():
    clock = Clock()
    blocks = []
    for block in pace_source(MemorySource(at(*range(100))), 10.0, clock=clock, sleep=clock.sleep):
        blocks.append(len(block))
        clock.now += 2.0  # the consumer takes as long as twenty messages last
    assert sum(blocks) == 100
    assert max(blocks) >= 20
    assert clock.now - 100.0 < 99 / 10 + 3


def test_paced_source_yields_empty_lists_during_silence():
    clock, waits = Clock(), []

    def sleep(seconds: float) -> None:
        waits.append(seconds)
        clock.sleep(seconds)

    blocks = list(pace_source(MemorySource(at(0, 10)), 1.0, clock=clock, sleep=sleep))
    assert blocks.count([]) >= 45
    assert max(waits) <= 0.2


@pytest.mark.parametrize(("longest", "lasts"), [(inf, 3605.0), (60.0, 65.0)])
def test_gaps_are_shortened_only_with_limit(longest, lasts):
    clock = Clock()
    sent = at(0, 5, 3605)
    got = [
        m
        for block in pace_source(MemorySource(sent), 1, longest_gap_s=longest, clock=clock, sleep=clock.sleep)
        for m in block
    ]
    assert got == sent
    assert clock.now - 100.0 == pytest.approx(lasts, abs=0.1)


def test_infinite_speed_never_reads_clock():
    def never(*_: float) -> float:
        raise AssertionError

    assert list(pace_source(MemorySource(at(1, 2, 3)), inf, clock=never, sleep=never)) == [at(1, 2, 3)]


@pytest.mark.parametrize("speed", [0, -1, float("nan")])
def test_speed_not_above_zero_raises_settings_error(speed):
    with pytest.raises(SettingsError, match="speed"):
        pace_source([], speed)


def test_gap_of_zero_raises_settings_error():
    with pytest.raises(SettingsError, match="gap"):
        pace_source([], 1, longest_gap_s=0)


def test_stopped_source_ends_after_stop_event():
    stop = Event()
    seen = []
    for block in stop_source(MemorySource(at(*range(10)), 2), stop):
        seen += block
        if len(seen) == 4:
            stop.set()
    assert len(seen) == 4


def test_memory_sink_keeps_messages_in_order():
    with MemorySink() as sink:
        for block in MemorySource(at(1, 2, 3), 2):
            sink.put(block)
    assert sink.messages == at(1, 2, 3)
    assert sink.closed
    assert all(a <= b for a, b in pairwise(m.receipt_ns for m in sink.messages))
