"""A stop is obeyed within seconds, however much is queued, and what is dropped is counted."""

import time
from threading import Event, Thread

import msgspec

from core.wire.messages import Message
from stream import zenoh_pubsub
from stream.zenoh_pubsub import ZenohSink, ZenohSource
from stream.zenoh_session import Connection, Node
from tests.support.zenoh_sessions import eventually, router

SAMPLE = {"vehicle_id": "a", "time_s": 1.7e9, "speed_kmh": 30.0, "note": "x" * 300}


def make_lists(count: int) -> list[Message]:
    """Return lists of 1 MB."""
    samples = [SAMPLE | {"seq": seq} for seq in range(2600)]
    return [Message("fleet/a/telemetry", msgspec.json.encode([{"n": n}, *samples]), 0) for n in range(count)]


def test_lists_are_yielded_up_to_a_size_and_a_stop_is_obeyed_in_time(monkeypatch, caplog):
    monkeypatch.setattr(zenoh_pubsub, "STOP_S", 0.5)
    sent, stop = make_lists(60), Event()
    assert 0.9e6 < len(sent[0].payload) < 1.2e6
    with router() as (node, endpoint), Node(Connection(connect=(endpoint,))) as client:
        source = ZenohSource(node, stop)
        sink = ZenohSink(client)
        assert eventually(sink.has_subscriber)
        thread = Thread(target=sink.put, args=(sent,))
        thread.start()
        sizes, taken, stopped_s = [], 0, None
        for messages in source:
            sizes += [sum(len(message.payload) for message in messages)] if messages else []
            taken += len(messages)
            time.sleep(0.1)  # a consumer that takes 40 MB/s
            if taken and stopped_s is None and eventually(lambda: not thread.is_alive()):
                stop.set()
                stopped_s = time.monotonic()
        took_s = time.monotonic() - stopped_s
        thread.join()
    assert max(sizes) < zenoh_pubsub.DRAIN_BYTES + zenoh_pubsub.BLOCK * 1.2e6
    assert took_s < 20.0
    assert taken + source.dropped["stop"] == len(sent)
    assert source.dropped["stop"] == 0 or "dropped" in caplog.text
