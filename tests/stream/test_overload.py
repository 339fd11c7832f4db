"""A stop is obeyed within seconds, however much is queued, and what is dropped is counted."""

import time
from threading import Event, Thread

import msgspec
import pytest

from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Message
from socast.stream import zenoh_source
from socast.stream.zenoh_receiver import BLOCK_BYTES, Received
from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.stream.zenoh_sink import ZenohSink
from socast.stream.zenoh_source import ZenohSource
from tests.support.zenoh_sessions import eventually, router

SAMPLE = {"vehicle_id": "a", "time_s": 1.7e9, "speed_kmh": 30.0, "note": "x" * 300}


NO_CACHES = {"recovery": False}
"""Settings of a node that asks no caches: what these answer late comes a second time, beside the live samples."""


def make_lists(count: int) -> list[Message]:
    """Return lists of 1 MB."""
    samples = [SAMPLE | {"seq": seq} for seq in range(2600)]
    return [Message("fleet/a/telemetry", msgspec.json.encode([{"n": n}, *samples]), 0) for n in range(count)]


def test_lists_are_yielded_up_to_a_size_and_a_stop_is_obeyed_in_time(monkeypatch, caplog):
    monkeypatch.setattr(zenoh_source, "STOP_S", 0.5)
    monkeypatch.setattr(zenoh_source, "YIELD_S", 1.0)
    sent, stop = make_lists(60), Event()
    assert 0.9e6 < len(sent[0].payload) < 1.2e6
    with router() as (node, endpoint), Node(Connection(connect=(endpoint,))) as client:
        source = ZenohSource(node, stop, queue_bytes=20e6)
        sink = ZenohSink(client)
        assert eventually(sink.has_subscriber)
        thread = Thread(target=sink.put, args=(sent,))
        thread.start()
        sizes, taken, stopped_s = [], 0, None
        for messages in source:
            sizes += [sum(len(message.payload) for message in messages)] if messages else []
            taken += len(messages)
            assert source.queue_bytes < 20e6 + BLOCK_BYTES + 1.2e6
            time.sleep(0.1)  # a consumer that takes 40 MB/s
            if taken and stopped_s is None and eventually(lambda: not thread.is_alive()):
                stop.set()
                stopped_s = time.monotonic()
        took_s = time.monotonic() - stopped_s
        thread.join()
    assert max(sizes) < zenoh_source.DRAIN_BYTES + 2 * BLOCK_BYTES
    assert took_s < 20.0
    assert taken + source.dropped["stop"] == len(sent)
    assert source.dropped["stop"] == 0 or "dropped" in caplog.text


LISTS = make_lists(3)


class EndlessReceiver:
    """Stand for a receiver whose channels never run dry; it counts what it gave."""

    def __init__(self) -> None:
        self.given = 0

    def receive(self, **_: bool) -> Received:
        self.given += 3
        return Received(MessageBlock.of(LISTS), recovered=False, samples=3)

    def drop_rest(self) -> int:
        self.given += 5
        return 5

    def brake(self) -> None:
        pass

    def end(self) -> None:
        pass


def test_every_message_after_a_stop_is_yielded_or_counted_as_dropped(monkeypatch):
    monkeypatch.setattr(zenoh_source, "STOP_S", 0.05)
    monkeypatch.setattr(zenoh_source, "YIELD_S", 0.05)
    with router() as (node, _):
        for _ in range(10):
            stop, receiver = Event(), EndlessReceiver()
            source = ZenohSource(node, stop, queue_bytes=20e6)
            monkeypatch.setattr(source, "_receiver", receiver)
            taken = 0
            for messages in source:
                taken += len(messages)
                stop.set()
            assert taken + source.dropped["stop"] == receiver.given


def test_full_queue_is_told_and_nothing_is_lost(caplog):
    sent, stop = make_lists(20), Event()
    with router(**NO_CACHES) as (node, endpoint), Node(Connection(connect=(endpoint,))) as client:
        source = ZenohSource(node, stop, queue_bytes=2e6)
        sink = ZenohSink(client)
        assert eventually(sink.has_subscriber)
        thread = Thread(target=sink.put, args=(sent,))
        thread.start()
        got: list[Message] = []
        for messages in source:
            if not got:
                assert eventually(lambda: "the consumer is behind" in caplog.text)
            got += messages
            if len(got) == len(sent):
                stop.set()
        thread.join()
    assert [message.payload for message in got] == [message.payload for message in sent]


def test_channels_hold_few_large_lists_while_the_queue_is_full(caplog):
    count, stop, sent = 400, Event(), []
    with router(**NO_CACHES) as (node, endpoint), Node(Connection(connect=(endpoint,))) as client:
        source = ZenohSource(node, stop, queue_bytes=2e6)
        sink = ZenohSink(client)
        assert eventually(sink.has_subscriber)

        def publish() -> None:
            for number in range(count):
                sink.put([LISTS[number % 3]._replace(payload=LISTS[0].payload + b" " * number)])
                sent.append(number)

        thread, got = Thread(target=publish), 0
        thread.start()
        for messages in source:
            if messages and not got:
                assert eventually(lambda: "the consumer is behind" in caplog.text)
                time.sleep(2.0)
            got += len(messages)
            assert len(sent) - got < count / 3, "publishers wait"
            time.sleep(0.03)  # slower than they are
            if got == count:
                stop.set()
        thread.join()
    assert got == count


def test_payload_beyond_the_limit_of_a_session_does_not_arrive():
    stop = Event()
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    with (
        Node(Connection(listen=(endpoint,), mode="router", largest_bytes=1000.0)) as node,
        Node(Connection(connect=(endpoint,))) as client,
    ):
        source, sink = ZenohSource(node, stop), ZenohSink(client)
        assert eventually(sink.has_subscriber)
        sizes = (10, 1000, 1001, 100_000, 20)
        sink.put([Message("fleet/a/telemetry", b"x" * size, 0) for size in sizes])
        got: list[int] = []
        for messages in source:
            got += [len(message.payload) for message in messages]
            if 20 in got:
                stop.set()
    assert got == [10, 1000, 20]


def test_error_of_the_receiving_thread_is_raised_by_the_loop(monkeypatch):
    def fail() -> None:
        raise RuntimeError("broken")

    with router() as (node, _):
        source = ZenohSource(node, Event())
        monkeypatch.setattr(source._receiver, "_watch_routers", fail)
        with pytest.raises(RuntimeError, match="broken"):
            list(source)
