"""The live consumer against a Zenoh subscriber that does nothing, on the same stream from another process."""

import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.synchronize import Event as ProcessEvent
from threading import Event
from typing import Any, TypeAlias

from core.models import EXTENDED_PHYSICAL
from core.pipeline import Pipeline
from stream.latest_only_sink import Outbox
from stream.loop import PUBLISH_S, Tally, run
from stream.zenoh_pubsub import ZenohSink, ZenohSource
from stream.zenoh_session import Connection, Node, free_port
from tools.bench.fleet import make_rounds, make_vehicles
from tools.bench.measures import Measure, alternate_timings

PATIENCE_S = 60.0
WARM_UP = 20
"""Samples of each car before the clock starts, so that every car has been heard of and every key been declared."""
SETTLE_S = 2.0
"""Time in which what they led to, such as declaring the forecasts' keys, comes to rest. [s]"""

Consumer: TypeAlias = Callable[[Node, ProcessEvent, ProcessEvent], float]


def publish_stream(endpoint: str, cars: int, turns: int, ready: ProcessEvent, go: ProcessEvent) -> None:
    """Publish a stream as fast as it is taken, from a process of its own."""
    messages = [message for turn in make_rounds(cars, WARM_UP, turns) for message in turn]
    with Node(Connection(connect=(endpoint,))) as node:
        sink = ZenohSink(node)
        sink.put(make_vehicles(cars))
        for turn in make_rounds(cars, 0, WARM_UP):  # every key is declared before the clock starts
            sink.put(turn)
        ready.set()
        go.wait(PATIENCE_S)
        for at in range(0, len(messages), 1000):
            sink.put(messages[at : at + 1000])
        sink.close()


def time_stream(cars: int, turns: int, consume: Consumer) -> float:
    """Return how long a consumer takes for the stream, from its first sample to its last. [s]"""
    context = multiprocessing.get_context("spawn")
    ready, go = context.Event(), context.Event()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Node(Connection(listen=(endpoint,), mode="router")) as node:
        process = context.Process(target=publish_stream, args=(endpoint, cars, turns, ready, go))
        process.start()

        took = consume(node, ready, go)
        process.join(PATIENCE_S)
    return took


def make_idle_consumer(cars: int, turns: int) -> Consumer:
    """Return a consumer that does nothing but notice the first sample and the last."""

    def consume(node: Node, ready: ProcessEvent, go: ProcessEvent) -> float:
        seen = 0

        def notice(_: Any) -> None:
            nonlocal seen
            seen += 1

        with node.session.declare_subscriber("fleet/*/telemetry", notice):
            wait_until(lambda: ready.is_set() and seen == cars * WARM_UP)
            time.sleep(SETTLE_S)
            began = time.perf_counter()
            go.set()
            wait_until(lambda: seen == cars * (WARM_UP + turns))
            return time.perf_counter() - began

    return consume


def make_full_consumer(cars: int, turns: int) -> Consumer:
    """Return the consumer as it is in service: decode, clean, sum, predict and publish forecasts."""

    def consume(node: Node, ready: ProcessEvent, go: ProcessEvent) -> float:
        stop = Event()
        pipeline = Pipeline(EXTENDED_PHYSICAL, keep_tables=False)
        began = ended = settled = 0.0
        patience = time.monotonic() + PATIENCE_S

        def watch(_: Tally) -> None:
            nonlocal began, ended, settled
            if time.monotonic() > patience:
                raise TimeoutError(f"the stream has not come through in {PATIENCE_S:g} s")
            received = pipeline.decoder.received["telemetry"]
            if not began and ready.is_set() and received == cars * WARM_UP:
                settled = settled or time.monotonic() + SETTLE_S
            if settled and not began and time.monotonic() > settled:
                began = time.perf_counter()
                go.set()
            elif received == cars * (WARM_UP + turns):
                ended = ended or time.perf_counter()
                stop.set()

        source = ZenohSource(node, stop)
        run(source, pipeline, [Outbox(ZenohSink(node))], publish_s=PUBLISH_S, watch=watch)
        return ended - began

    return consume


def wait_until(until: Callable[[], bool]) -> None:
    """Look every few milliseconds whether something has come true, for so long."""
    patience = time.monotonic() + PATIENCE_S
    while not until():
        if time.monotonic() > patience:
            raise TimeoutError(f"the stream has not come through in {PATIENCE_S:g} s")
        time.sleep(0.002)


def measure_live(repeats: int = 5, cars: int = 1000, turns: int = 400) -> Measure:
    """Measure the live consumer, decode to published forecast, against a subscriber that does nothing."""
    total = cars * turns
    idle_s, busy_s = alternate_timings(
        lambda: time_stream(cars, turns, make_idle_consumer(cars, turns)),
        lambda: time_stream(cars, turns, make_full_consumer(cars, turns)),
        repeats,
    )
    return Measure(
        f"live consumer, decode to forecast, {cars:,} cars",
        "a Zenoh subscriber that does nothing",
        idle_s / busy_s,
        ">= 0.5",
        idle_s / busy_s >= 0.5,
        {"live_samples_per_s": total / busy_s, "idle_samples_per_s": total / idle_s},
        "Both cores are full: of the publisher, of Zenoh's receiving threads, and of Python, which takes "
        "about 3 us a sample: 0.9 to take it out of Zenoh, 1.3 to decode it, 0.8 for all else.",
    )
