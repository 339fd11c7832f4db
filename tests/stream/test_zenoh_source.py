"""Zenoh sessions on loopback lose no message, keep the order, and count missed samples."""

import logging
import subprocess
import sys
import time
from collections.abc import Iterable
from itertools import pairwise
from threading import Event, Thread
from typing import Any

import pytest
import zenoh
from zenoh import SampleKind
from zenoh.handlers import FifoChannel

from socast.core.errors import SettingsError
from socast.core.wire.messages import Message
from socast.stream.idle_keys import IdleKeys
from socast.stream.zenoh_receiver import CHANNEL, adapt_nap
from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.stream.zenoh_sink import ZenohSink
from socast.stream.zenoh_source import ZenohSource
from tests.support.service import Clock
from tests.support.zenoh_sessions import eventually, router

KEYS = ("fleet/a/telemetry", "fleet/b/telemetry", "weather/yul")


def make_messages(count: int, keys=KEYS) -> list[Message]:
    return [Message(keys[i % len(keys)], b'{"n":%d}' % i, i) for i in range(count)]


def receive(source: Iterable[list[Message]], stop: Event, count: int, seconds: float = 10.0) -> list[Message]:
    """Return received messages; stop after `count` messages or some seconds, and drain the source to its end."""
    out: list[Message] = []
    deadline = time.monotonic() + seconds
    for block in source:
        out += block
        if len(out) >= count or time.monotonic() > deadline:
            stop.set()
    return out


def select_space(space: str, make_messages: list[Message]) -> list[tuple[str, bytes]]:
    return [(m.key, m.payload) for m in make_messages if m.key.startswith(f"{space}/")]


def test_messages_arrive_in_order_across_keys_of_space():
    sent, stop = make_messages(6000), Event()
    with router() as (node, endpoint):
        source = ZenohSource(node, stop)
        with Node(Connection(connect=(endpoint,))) as client:
            sink = ZenohSink(client)
            assert eventually(sink.has_subscriber)
            sink.put(sent)
            got = receive(source, stop, len(sent))
            sink.close()
    assert len(got) == len(sent)
    assert select_space("fleet", got) == select_space("fleet", sent)
    assert select_space("weather", got) == select_space("weather", sent)
    assert all(a.receipt_ns <= b.receipt_ns for a, b in pairwise(got))
    assert source.missed == 0


def test_messages_published_just_before_close_arrive():
    sent, stop = make_messages(30_000), Event()
    with router() as (node, endpoint):
        source = ZenohSource(node, stop)

        def publish() -> None:
            with Node(Connection(connect=(endpoint,))) as client:
                sink = ZenohSink(client)
                eventually(sink.has_subscriber)
                sink.put(sent)
                sink.close()

        thread = Thread(target=publish)
        thread.start()
        got = receive(source, stop, len(sent))
        thread.join()
    assert len(got) == len(sent)
    assert select_space("fleet", got) == select_space("fleet", sent)


@pytest.mark.parametrize("rate", [0.0, 300.0, 20_000.0, 100_000.0, 200_000.0])
def test_naps_are_long_at_low_rates_and_never_fill_the_channel_at_high_rates(rate):
    nap_s, naps_s = 0.01, []
    for _ in range(1000):
        naps_s.append(nap_s)
        nap_s = adapt_nap(nap_s, min(nap_s * rate, CHANNEL) / CHANNEL)
    settled_s = naps_s[100:]
    assert max(settled_s) * rate < 0.9 * CHANNEL
    assert min(settled_s) * rate > 0.3 * CHANNEL or min(settled_s) == 0.01


def test_stopped_source_yields_queued_messages():
    sent, stop = make_messages(200), Event()  # they fit into the channels
    with router() as (node, endpoint):
        source = ZenohSource(node, stop)
        arrived: list[zenoh.Sample] = []
        node.session.declare_subscriber("**", arrived.append)
        with Node(Connection(connect=(endpoint,))) as client:
            sink = ZenohSink(client)
            assert eventually(sink.has_subscriber)
            sink.put(sent)
            assert eventually(lambda: len(arrived) == len(sent))
        stop.set()
        got = [m for block in source for m in block]
    assert select_space("fleet", got) == select_space("fleet", sent)
    assert [(m.key, m.payload) for m in got] == select_space("weather", sent) + select_space(
        "fleet", sent
    )  # what is queued: weather first


def test_late_subscriber_receives_newest_message_of_each_key():
    stop = Event()
    with router() as (node, endpoint), Node(Connection(connect=(endpoint,))) as client:
        sink = ZenohSink(client)
        sink.put([Message("fleet/a/vehicle", b'{"model":"x"}', 0)])
        source = ZenohSource(node, stop)
        got = receive(source, stop, 1)
    assert [(m.key, m.payload) for m in got] == [("fleet/a/vehicle", b'{"model":"x"}')]


def test_publisher_of_a_key_that_is_not_used_any_more_is_undeclared():
    clock = Clock()
    with router() as (node, endpoint), Node(Connection(connect=(endpoint,))) as client:
        tokens: Any = node.session.liveliness().declare_subscriber(
            "fleet/**/@adv/pub/**", FifoChannel(16), history=True
        )
        sink = ZenohSink(client, keys=IdleKeys(10.0, clock))
        sink.put([Message("fleet/a/forecast", b"1", 0), Message("fleet/b/forecast", b"1", 0)])
        clock.now += 10.1
        sink.put([Message("fleet/b/forecast", b"2", 0)])
        told = [tokens.handler.recv() for _ in range(3)]
        assert [str(each.key_expr).split("/")[1] for each in told if each.kind == SampleKind.DELETE] == ["a"]
        sink.put([Message("fleet/a/forecast", b"3", 0)])
        assert tokens.handler.recv().kind == SampleKind.PUT
        sink.close()


def test_samples_that_no_publisher_can_resend_are_counted_as_missed():
    stop = Event()
    with router() as (node, endpoint), Node(Connection(connect=(endpoint,))) as client:
        source = ZenohSource(node, stop)
        for key in KEYS[1:]:
            publisher = client.session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
            assert eventually(lambda publisher=publisher: publisher.matching_status.matching)
            for number in (0, 1, 5, 6, 9):
                publisher.put(b"%d" % number, source_info=zenoh.SourceInfo(publisher.id, number))
        got = receive(source, stop, 10)
    for space in ("fleet", "weather"):
        assert [payload for _, payload in select_space(space, got)] == [b"0", b"1", b"5", b"6", b"9"]
    assert source.missed == 2 * 5


def test_burst_of_plain_publishers_passes_embedded_router_without_loss():
    count, stop = 20_000, Event()
    code = (
        "import sys, time, zenoh\n"
        "c = zenoh.Config(); c.insert_json5('mode', '\"client\"')\n"
        "c.insert_json5('connect/endpoints', f'[\"{sys.argv[1]}\"]')\n"
        "c.insert_json5('scouting/multicast/enabled', 'false')\n"
        "s = zenoh.open(c)\n"
        "p = s.declare_publisher(sys.argv[2], congestion_control=zenoh.CongestionControl.BLOCK)\n"
        "while not p.matching_status.matching: time.sleep(0.01)\n"
        "for _ in range(int(sys.argv[3])): p.put(b'{}')\n"
        "s.close()\n"
    )
    with router() as (node, endpoint):
        source = ZenohSource(node, stop)
        children = [subprocess.Popen([sys.executable, "-c", code, endpoint, key, str(count)]) for key in KEYS]
        got = receive(source, stop, count * len(KEYS), 60.0)
        assert [child.wait(30) for child in children] == [0, 0, 0]
    assert len(got) == count * len(KEYS)


def test_all_messages_arrive_without_recovery():
    sent, stop = make_messages(1000), Event()
    with router(recovery=False) as (node, endpoint):
        source = ZenohSource(node, stop)
        with Node(Connection(connect=(endpoint,))) as client:
            sink = ZenohSink(client)
            assert eventually(sink.has_subscriber)
            sink.put(sent)
            got = receive(source, stop, len(sent))
        assert source.missed is None
    assert sorted(m.payload for m in got) == sorted(m.payload for m in sent)


@pytest.mark.parametrize("recovery", [True, False])
@pytest.mark.parametrize("prefix", ["", "montreal/"])
def test_keys_of_other_prefixes_or_spaces_never_arrive(prefix, recovery):
    others = [
        f"{prefix}quebec/fleet/a/telemetry",
        "toronto/fleet/a/telemetry",
        f"{prefix}lights/a",
        f"{prefix}fleets/a",
    ]
    others += ["toronto/weather/yul", *(KEYS if prefix else ())]
    stop = Event()
    with router(prefix=prefix, recovery=recovery) as (node, endpoint):
        source = ZenohSource(node, stop)
        with Node(Connection(connect=(endpoint,))) as client:
            ours, theirs = ZenohSink(client, prefix), ZenohSink(client)
            assert eventually(ours.has_subscriber)
            theirs.put(make_messages(len(others), others))
            ours.put(make_messages(3))
            got = receive(source, stop, 3)
    assert sorted(m.key for m in got) == [f"{prefix}{key}" for key in KEYS]


def test_source_with_prefix_excludes_other_fleets():
    stop = Event()
    with router(prefix="montreal") as (node, endpoint):
        source = ZenohSource(node, stop)
        with Node(Connection(connect=(endpoint,))) as client:
            ours, theirs = ZenohSink(client, "montreal/"), ZenohSink(client, "quebec/")
            assert eventually(ours.has_subscriber)
            assert not theirs.has_subscriber()
            theirs.put(make_messages(3))
            ours.put(make_messages(3))
            got = receive(source, stop, 3)
    assert sorted(m.key for m in got) == [f"montreal/{key}" for key in KEYS]


def test_node_never_receives_its_own_messages():
    stop = Event()
    with router() as (node, endpoint):
        source = ZenohSource(node, stop)
        ZenohSink(node).put([Message("fleet/a/forecast", b"{}", 0)])
        with Node(Connection(connect=(endpoint,))) as client:
            sink = ZenohSink(client)
            assert eventually(sink.has_subscriber)
            sink.put(make_messages(1))
            got = receive(source, stop, 1)
    assert [m.key for m in got] == [KEYS[0]]


def test_source_without_messages_yields_empty_list():
    stop = Event()
    with router() as (node, _):
        assert next(iter(ZenohSource(node, stop))) == []


def test_consumer_continues_after_restart_of_router(caplog: pytest.LogCaptureFixture):
    port, stop = find_free_port(), Event()
    endpoint = f"tcp/127.0.0.1:{port}"
    connection = Connection(listen=(endpoint,), mode="router")
    with Node(connection) as before, Node(Connection(connect=(endpoint,))) as consumer:
        source = ZenohSource(consumer, stop)
        caplog.set_level(logging.INFO)
        messages, deadline = iter(source), time.monotonic() + 30
        assert next(messages) == []
        before.close()
        while "router lost" not in caplog.text and time.monotonic() < deadline:
            assert next(messages) == []
        with Node(connection) as after:
            sink = ZenohSink(after)
            assert eventually(sink.has_subscriber)
            sink.put(make_messages(3))
            got = receive(messages, stop, 3)
    assert "router lost" in caplog.text
    assert sorted(m.key for m in got) == list(KEYS)


def test_publishing_on_closed_node_raises_settings_error():
    with router() as (node, _):
        sink = ZenohSink(node)
    with pytest.raises(SettingsError, match="cannot publish"):
        sink.put(make_messages(1))
