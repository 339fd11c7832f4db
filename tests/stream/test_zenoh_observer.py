"""The observer receives every kind of message that a page shows, and drops the oldest where its reader is slow."""

from contextlib import closing
from types import SimpleNamespace

import pytest

from socast.core.wire.messages import Message
from socast.stream import zenoh_observer
from socast.stream.zenoh_observer import ZenohObserver
from socast.stream.zenoh_sink import ZenohSink
from tests.support.zenoh_sessions import eventually, router


def make_sample(number, size):
    """Return what Zenoh hands to a subscriber."""
    return SimpleNamespace(key_expr=f"fleet/{number}/batch", payload=SimpleNamespace(to_bytes=lambda: bytes(size)))


@pytest.fixture(scope="module")
def node():
    with router() as (node, _):
        yield node


@pytest.mark.parametrize("key", ["fleet/a/telemetry", "fleet/depot-3/batch", "fleet/a/forecast", "findings/a/b"])
def test_observer_receives_each_kind_of_message_unchanged(node, key):
    with closing(ZenohObserver(node)) as observer, closing(ZenohSink(node)) as sink:
        sink.put([Message(key, b"\xff\xff\xff\xff verbatim", 0)])
        taken = []
        assert eventually(lambda: taken.extend(observer.take()) or taken)
    assert [message[:2] for message in taken] == [(key, b"\xff\xff\xff\xff verbatim")]


@pytest.mark.parametrize("key", ["fleet/late/forecast", "findings/late/tyre_pressure"])
def test_observer_that_joins_late_receives_the_newest_forecast_and_findings(node, key):
    with closing(ZenohSink(node)) as sink:
        sink.put([Message(key, b"older", 0), Message(key, b"newest", 0)])
        with closing(ZenohObserver(node)) as observer:
            taken = []
            assert eventually(lambda: taken.extend(observer.take()) or taken)
    assert [message[:2] for message in taken] == [(key, b"newest")]


@pytest.mark.parametrize(("limit", "most"), [("MOST_WAITING", 3), ("MOST_WAITING_BYTES", 350)])
def test_observer_with_a_slow_reader_drops_the_oldest_and_counts_them(node, monkeypatch, limit, most):
    monkeypatch.setattr(zenoh_observer, limit, most)
    with closing(ZenohObserver(node)) as observer:
        for number in range(5):
            observer._receive(make_sample(number, 100))
        assert [message.key for message in observer.take()] == [f"fleet/{number}/batch" for number in (2, 3, 4)]
        assert observer.dropped == 2
        observer._receive(make_sample(5, 300))
        assert len(observer.take()) == 1
        assert observer.dropped == 2
