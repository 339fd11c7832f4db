"""The outbox never holds up who puts, loses nothing newest, and tells of a sink that broke."""

from threading import Event

import pytest

from core.wire.messages import Message
from stream.latest_only_sink import LatestOnlySink
from stream.memory import MemorySink


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


def test_all_is_handed_on_where_the_sink_keeps_pace():
    sink = MemorySink()
    outbox = LatestOnlySink(sink)
    outbox.put([])
    outbox.put([message("a", 1), message("b", 2)])
    outbox.close()
    outbox.close()
    assert sink.messages == [message("a", 1), message("b", 2)]
    assert sink.closed


def test_a_stalled_listener_holds_up_nobody_and_gets_the_newest_of_each_key():
    sink = Slow()
    outbox = LatestOnlySink(sink)
    outbox.put([message("a", 0)])
    assert sink.entered.wait(10)
    for number in range(1, 1000):
        outbox.put([message("a", number), message("b", number)])
    sink.leave.set()
    outbox.close()
    assert sink.messages == [message("a", 0), message("a", 999), message("b", 999)]


class Broken(MemorySink):
    def put(self, messages):  # noqa: ARG002
        raise ConnectionError("gone")


def test_who_closes_is_told_that_the_sink_broke_at_the_last():
    sink = Broken()
    outbox = LatestOnlySink(sink)
    outbox.put([message("a", 0)])
    with pytest.raises(ConnectionError, match="gone"):
        outbox.close()
    assert sink.closed
    outbox.close()


def test_who_puts_is_told_that_the_sink_broke():
    outbox = LatestOnlySink(Broken())
    outbox.put([message("a", 0)])
    outbox._thread.join(10)
    with pytest.raises(ConnectionError, match="gone"):
        outbox.put([message("a", 1)])
    outbox.close()
