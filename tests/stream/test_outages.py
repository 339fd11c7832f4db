"""A consumer that is killed, and whose router is lost, ends as an uninterrupted one, over real Zenoh."""

import signal
from pathlib import Path

import pytest
from zenoh.handlers import FifoChannel

from socast.core.errors import RecordingError
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.stream.zenoh_sink import CACHE, ZenohSink
from tests.support.live_consumers import consumers
from tests.support.outages import Outcome, compare_outcome, read_kept
from tests.support.recorded_shift import shift
from tests.support.router_process import RouterProcess
from tests.support.zenoh_sessions import eventually

pytestmark = pytest.mark.long


def read_so_far(folder: Path) -> set[tuple[str, bytes]]:
    """Return what a consumer has recorded, nothing while its newest file is still empty."""
    try:
        return set(read_kept(folder))
    except RecordingError:
        return set()


def wait_until_recorded(messages: list[Message], folder: Path) -> None:
    wanted = {(message.key, message.payload) for message in messages}
    assert eventually(lambda: wanted <= read_so_far(folder), 120.0)


def test_nothing_is_lost_or_counted_twice_over_a_kill_and_an_outage_of_the_router(tmp_path):
    cars, most = 10, CACHE - 14  # a car repeats some samples, which take places in its cache
    sent = shift(3 * most, cars=cars)
    first, second, third = (sent[n * most * cars : (n + 1) * most * cars] for n in range(3))
    third += sent[3 * most * cars :]
    outcome, forecasts = Outcome(), set[tuple[str, bytes]]()
    newest = {message.key: message.payload for message in Pipeline(EXTENDED_PHYSICAL).push(sent)}
    options = "--record", tmp_path / "kept", "--state", tmp_path / "cars.state", "--flush", 0.2
    with RouterProcess() as router, router.join() as node, consumers(tmp_path) as start:
        sink = ZenohSink(node)
        listener = node.session.declare_subscriber("fleet/*/forecast", FifoChannel(1 << 12))
        consumer, _ = start("--connect", router.endpoint, *options)
        sink.put(first[: len(first) // 2])
        assert eventually(lambda: read_so_far(tmp_path))
        consumer.kill()
        consumer.wait()
        sink.put(first[len(first) // 2 :])
        consumer, _ = start("--connect", router.endpoint, *options)
        wait_until_recorded(first, tmp_path)
        router.kill()
        sink.put(second)
        router.start()
        wait_until_recorded(second, tmp_path)
        sink.put(third)
        wait_until_recorded(third, tmp_path)

        def hears_newest() -> bool:
            while (sample := listener.handler.try_recv()) is not None:
                forecasts.add((str(sample.key_expr), sample.payload.to_bytes()))
            return newest.items() <= forecasts

        assert eventually(hears_newest)
        consumer.send_signal(signal.SIGTERM)
        assert consumer.wait(60) == 0
    compare_outcome(outcome, sent, tmp_path, forecasts)
    assert (outcome.lost, outcome.counted_twice) == (0, 0)
    assert outcome.other_forecasts == 0
    assert outcome.state_differs_in == []
