"""Recovery of one publisher holds up nobody else, and publishers at full speed lose nothing, over real sessions."""

import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager
from random import Random
from threading import Event, Thread
from typing import Any

from zenoh import CongestionControl

from socast.core.wire.messages import Message
from socast.stream.zenoh_history import CacheHistory, merge_samples
from socast.stream.zenoh_sink import ZenohSink
from socast.stream.zenoh_source import ZenohSource
from tests.support.router_process import RouterProcess
from tests.support.zenoh_sessions import eventually

BLOCK = CongestionControl.BLOCK

LATEST_S = 2.0
"""Longest time from a sample to the loop while strangers do what they like. [s]"""
FIRST_AND_LAST = b"0", b"49"
"""Payloads of the samples between which the numbers of a publisher show a gap."""
KEYS, EACH = 600, 100
PUBLISHER = f"""
import sys
from socast.core.wire.messages import Message
from socast.stream.zenoh_sink import ZenohSink
from socast.stream.zenoh_session import Connection, Node
with Node(Connection(connect=(sys.argv[1],))) as node:
    sink = ZenohSink(node)
    for number in range({EACH} + {KEYS}):
        cars = range(max(0, number - {EACH} + 1), min(number + 1, {KEYS}))
        sink.put([Message(f"fleet/{{car}}/telemetry", b"%d" % (number - car), 0) for car in cars])
    node.flush()
    print("sent", flush=True)
    sys.stdin.readline()
"""
"""Publish `EACH` samples of each of `KEYS` cars at full speed; a car begins with every list."""


@contextmanager
def consuming(node, take):
    """Pass the messages of a source to a function, in a thread."""
    stop = Event()
    source = ZenohSource(node, stop)

    def run():
        for messages in source:
            take(messages)

    thread = Thread(target=run)
    thread.start()
    try:
        assert eventually(lambda: not source.is_catching_up)
        yield source
    finally:
        stop.set()
        thread.join(20)
    assert not thread.is_alive()


def test_tokens_of_a_stranger_whose_caches_never_answer_delay_nobody_else():
    late: list[float] = []

    def take(messages):
        late.extend(time.monotonic() - float(each.payload) for each in messages if "/taxi/" in each.key)

    with RouterProcess() as router, router.join() as node, router.join() as taxi, router.join() as stranger:
        held = []
        stranger.session.declare_queryable("fleet/evil/telemetry/@adv/pub/**", held.append)
        sink, tokens = ZenohSink(taxi), []
        with consuming(node, take):
            for number in range(60):
                key = f"fleet/evil/telemetry/@adv/pub/{number + 1:032x}/1/_"
                tokens.append(stranger.session.liveliness().declare_token(key))
                sink.put([Message("fleet/taxi/telemetry", b"%r" % time.monotonic(), 0)])
                time.sleep(0.1)
            assert eventually(lambda: len(late) == 60)
        sink.close()
    assert held, "the caches of the stranger were asked"
    assert max(late[20:]) < LATEST_S  # the first wait for the answers of their own session


def test_samples_lost_on_the_way_are_asked_for_and_come_in_their_order():
    got: dict[str, list[int]] = {}
    random, lost = Random(1), list[str]()
    heard = Event()

    def take(messages):
        for each in messages:
            if each.key == first.key:
                heard.set()
            else:
                got.setdefault(each.key, []).append(int(each.payload))

    with RouterProcess() as router, router.join() as node, router.join() as taxi:
        sink, first = ZenohSink(taxi), Message("fleet/first/telemetry", b"0", 0)
        with consuming(node, take) as source:
            while not heard.wait(0.1):  # until the publisher knows that somebody listens
                sink.put([first])
            receive = source._receiver._receive

            def lose(most):
                arrived = receive(most)
                kept = [each for each in arrived if each.payload.to_bytes() in FIRST_AND_LAST or random.random() < 0.7]
                lost.extend(str(each.key_expr) for each in arrived if each not in kept)
                return kept

            source._receiver._receive = lose
            for number in range(50):
                sink.put([Message(f"fleet/{car}/telemetry", b"%d" % number, 0) for car in range(20)])
                time.sleep(0.01)
            whole = eventually(lambda: sum(len(set(numbers)) for numbers in got.values()) == 20 * 50)
            assert whole, {key: sorted(set(range(50)) - set(numbers)) for key, numbers in got.items()}
            assert source.missed == 0
        sink.close()
    assert len(lost) > 100
    assert all(list(dict.fromkeys(numbers)) == list(range(50)) for numbers in got.values())


def test_publisher_of_many_new_keys_at_full_speed_loses_nothing_to_a_slow_consumer():
    got: dict[str, list[int]] = {}
    pauses: list[float] = []

    def take(messages):
        pauses.append(time.monotonic())
        for each in messages:
            got.setdefault(each.key, []).append(int(each.payload))
        time.sleep(len(messages) / 20_000)

    with RouterProcess() as router, router.join() as node, consuming(node, take) as source:
        command = [sys.executable, "-c", PUBLISHER, router.endpoint]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as publisher:
            assert publisher.stdout.readline() == "sent\n"
            assert eventually(lambda: sum(map(len, got.values())) >= KEYS * EACH)
            publisher.communicate("\n")
        asked = source._receiver._history.asked
    assert source.missed == 0
    assert Counter(map(len, got.values())) == {EACH: KEYS}
    assert all(numbers == list(range(EACH)) for numbers in got.values())
    assert asked <= 12, "beside caches and storages of all, only the session is asked, not every key"


@contextmanager
def storing(session):
    """Stand for a storage of a fleet: it keeps samples, and returns them, newest first, with their keys and stamps."""
    kept: list[Any] = []

    def answer(query):
        with query:
            assert "_time" in query.parameters
            for each in reversed(kept):
                if query.key_expr.intersects(each.key_expr):
                    query.reply(each.key_expr, each.payload, timestamp=each.timestamp)

    parts = session.declare_subscriber("fleet/**", kept.append), session.declare_queryable("fleet/**", answer)
    yield kept
    for part in parts:
        part.undeclare()


def test_storage_returns_in_order_what_came_and_went_before_the_start():
    sent = [b'{"n":%d}' % n for n in range(400)]
    got: list[Any] = []
    with RouterProcess() as router, router.join() as node, router.join() as other, storing(other.session) as kept:
        with router.join() as taxi:  # without a cache, and gone before the consumer comes
            for payload in sent:
                taxi.session.put("fleet/a/telemetry", payload, congestion_control=BLOCK)  # else it drops some
            taxi.flush()
        assert eventually(lambda: len(kept) == len(sent))
        history = CacheHistory(node, ("weather/**", "fleet/**"))

        def has_all() -> bool:
            history.collect(now := time.monotonic())
            got.extend(history.release(now)[1])
            return [each.payload.to_bytes() for each in merge_samples(got)] == sent

        assert eventually(has_all)
        history.close()
