"""The sink never delays `put`, passes on the newest message of each key, and raises the failure of a broken sink."""

from threading import Event

import pytest

from socast.core.wire.messages import Message
from socast.stream.memory import MemorySink
from socast.stream.zenoh_sink import LatestOnlySink


class Slow(MemorySink):
    """A sink whose first message waits for leave."""

    def __init__(self) -> None:
        super().__init__()
        self.entered, self.leave = Event(), Event()

    def put(self, messages):
        self.entered.set()
        assert self.leave.wait(10)
        super().put(messages)


def message(key: str, number: int) -> Message:
    return Message(key, str(number).encode(), number)


def test_fast_sink_receives_every_message():
    sink = MemorySink()
    latest = LatestOnlySink(sink)
    latest.put([])
    latest.put([message("a", 1), message("b", 2)])
    latest.close()
    latest.close()
    assert sink.messages == [message("a", 1), message("b", 2)]
    assert sink.closed


def test_stalled_sink_never_delays_put_and_receives_newest_of_each_key():
    sink = Slow()
    latest = LatestOnlySink(sink)
    latest.put([message("a", 0)])
    assert sink.entered.wait(10)
    for number in range(1, 1000):
        latest.put([message("a", number), message("b", number)])
    sink.leave.set()
    latest.close()
    assert sink.messages == [message("a", 0), message("a", 999), message("b", 999)]


class Broken(MemorySink):
    def put(self, messages):  # noqa: ARG002
        raise ConnectionError("gone")


def test_close_raises_failure_of_sink_once():
    sink = Broken()
    latest = LatestOnlySink(sink)
    latest.put([message("a", 0)])
    with pytest.raises(ConnectionError, match="gone"):
        latest.close()
    assert sink.closed
    latest.close()


def test_put_raises_failure_of_sink():
    latest = LatestOnlySink(Broken())
    latest.put([message("a", 0)])
    latest._thread.join(10)
    with pytest.raises(ConnectionError, match="gone"):
        latest.put([message("a", 1)])
    latest.close()
