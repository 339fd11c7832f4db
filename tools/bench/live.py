"""Measure the live consumer on a stream from another process: against an idle subscriber, and with certificates."""

import json
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import cycle
from multiprocessing.synchronize import Event as ProcessEvent
from pathlib import Path
from threading import Event
from typing import Any, Final, NamedTuple, TypeAlias

import msgspec
import numpy as np
import pyarrow as pa

from socast.core.batch import Floats
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.wire.arrow_batch import write_rows
from socast.core.wire.messages import Message
from socast.stream.loop import PUBLISH_S, Tally, run
from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.stream.zenoh_sink import LatestOnlySink, ZenohSink
from socast.stream.zenoh_source import ZenohSource
from socast.tools.bench.measures import Measure, alternate_timings, make_rounds, make_vehicles, name_car
from socast.tools.security.access import make_access_control
from socast.tools.security.folder import SecureFolder

PATIENCE_S = 60.0
WARM_UP = 20
"""Samples of each car before the clock starts, so that every car is known and every key is declared."""
BATCH_ROWS: Final = 1000
"""Number of samples in a batch."""
LONGEST_WARM_UP_S: Final = 300.0
SETTLE_S = 2.0
"""Time for the consequences of the warm-up, such as declaring the keys of forecasts, to finish. [s]"""
WAYS: Final = "plain", "certificates", "rules"
"""Plain TCP; mutual TLS; mutual TLS with access control."""
FLEET: Final = 1000
"""Number of cars that the rules know; only some of them publish."""


class Cost(NamedTuple):
    """Hold what taking a stream took from its first to its last sample, by the clock and in processor time. [s], [s]"""

    wall_s: float
    cpu_s: float


Consumer: TypeAlias = Callable[[Node, ProcessEvent, ProcessEvent], Cost]


def make_batches(messages: Sequence[Message]) -> list[Message]:
    """Return samples in JSON as batches of one gateway in Arrow's stream format."""
    samples = [msgspec.json.decode(message.payload) for message in messages]
    parts = [samples[at : at + BATCH_ROWS] for at in range(0, len(samples), BATCH_ROWS)]
    return [Message("fleet/gateway/batch", write_rows(pa.Table.from_pylist(part)), 0) for part in parts]


def publish_stream(
    connections: Sequence[Connection],
    cars: int,
    turns: int,
    ready: ProcessEvent,
    go: ProcessEvent,
    stop: ProcessEvent | None = None,
    *,
    batched: bool = False,
) -> None:
    """Publish a stream as fast as it is accepted, in one session or in one of each car, and stay until the stop."""
    messages = [message for turn in make_rounds(cars, WARM_UP, turns) for message in turn]
    messages = make_batches(messages) if batched else messages
    with ExitStack() as ending:
        nodes = [ending.enter_context(Node(connection)) for connection in connections]
        sinks = [ZenohSink(node) for node in nodes]
        _put(sinks, make_vehicles(cars))
        for turn in make_rounds(cars, 0, WARM_UP):  # every key is declared before the clock starts
            _put(sinks, turn)
        for node in nodes:
            node.flush()
        ready.set()
        go.wait(LONGEST_WARM_UP_S)
        block = 1000 - 1000 % len(sinks)
        for at in range(0, len(messages), block):
            _put(sinks, messages[at : at + block])
        for sink in sinks:
            sink.close()
        if stop is not None:
            stop.wait()


def _put(sinks: Sequence[ZenohSink], messages: Sequence[Message]) -> None:
    """Publish messages in one session, or each in that of its car."""
    shares = [messages] if len(sinks) == 1 else [[message] for message in messages]
    for sink, share in zip(cycle(sinks), shares, strict=False):
        sink.put(share)


def connect_plainly(sessions: int = 1) -> tuple[Connection, list[Connection]]:
    """Return the connections of a router and of its clients over plain TCP."""
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    return Connection(listen=(endpoint,), mode="router"), [Connection(connect=(endpoint,))] * sessions


def time_stream(
    ends: tuple[Connection, Sequence[Connection]], cars: int, turns: int, consume: Consumer, *, batched: bool = False
) -> Cost:
    """Return what a consumer takes for a stream from the clients of a router."""
    context, (router, connections) = multiprocessing.get_context("spawn"), ends
    ready, go = context.Event(), context.Event()
    with Node(router) as node:
        arguments = connections, cars, turns, ready, go
        process = context.Process(target=publish_stream, args=arguments, kwargs={"batched": batched})
        process.start()
        cost = consume(node, ready, go)
        process.join(PATIENCE_S)
    return cost


def make_idle_consumer(cars: int, turns: int) -> Consumer:
    """Return a consumer that only counts samples."""

    def consume(node: Node, ready: ProcessEvent, go: ProcessEvent) -> Cost:
        seen = 0

        def notice(_: Any) -> None:
            nonlocal seen
            seen += 1

        with node.session.declare_subscriber("fleet/*/telemetry", notice):
            wait_until(lambda: ready.is_set() and seen == cars * WARM_UP)
            time.sleep(SETTLE_S)
            began = _read_clocks()
            go.set()
            wait_until(lambda: seen == cars * (WARM_UP + turns))
            return Cost(*(_read_clocks() - began).tolist())

    return consume


def make_full_consumer(cars: int, turns: int) -> Consumer:
    """Return the consumer as in service: it decodes, cleans, accumulates, predicts and publishes forecasts."""

    def consume(node: Node, ready: ProcessEvent, go: ProcessEvent) -> Cost:
        stop = Event()
        pipeline = Pipeline(EXTENDED_PHYSICAL, keep_tables=False)
        began: Floats | None = None
        wall_s = settled = 0.0
        patience = time.monotonic() + PATIENCE_S

        def watch(_: Tally) -> None:
            nonlocal began, wall_s, settled
            if time.monotonic() > patience:
                raise TimeoutError(f"the stream has not arrived within {PATIENCE_S:g} s; stop other work")
            received = pipeline.decoder.received["telemetry"]
            if began is None and ready.is_set() and received == cars * WARM_UP:
                settled = settled or time.monotonic() + SETTLE_S
            if began is None and settled and time.monotonic() > settled:
                began = _read_clocks()
                go.set()
            elif began is not None and received == cars * (WARM_UP + turns):
                wall_s = wall_s or float((_read_clocks() - began)[0])
                stop.set()

        source = ZenohSource(node, stop)
        run(source, pipeline, [LatestOnlySink(ZenohSink(node))], publish_s=PUBLISH_S, watch=watch)
        assert began is not None
        return Cost(wall_s, float((_read_clocks() - began)[1]))

    return consume


def _read_clocks() -> Floats:
    """Return a time and the processor time of this process, (2,). [s]"""
    return np.array([time.perf_counter(), time.process_time()])


def wait_until(until: Callable[[], bool]) -> None:
    """Wait until a condition is true, checked every 2 ms."""
    patience = time.monotonic() + PATIENCE_S
    while not until():
        if time.monotonic() > patience:
            raise TimeoutError(f"the stream has not arrived within {PATIENCE_S:g} s; stop other work")
        time.sleep(0.002)


def measure_live(repeats: int = 5, cars: int = 1000, turns: int = 400) -> Measure:
    """Measure the live consumer, from decoding to published forecast, against an idle subscriber."""
    total = cars * turns
    idle_s, busy_s = alternate_timings(
        lambda: time_stream(connect_plainly(), cars, turns, make_idle_consumer(cars, turns)).wall_s,
        lambda: time_stream(connect_plainly(), cars, turns, make_full_consumer(cars, turns)).wall_s,
        repeats,
    )
    return Measure(
        f"live consumer, decode to forecast, {cars:,} cars",
        "an idle Zenoh subscriber",
        idle_s / busy_s,
        ">= 0.8",
        {"live_samples_per_s": total / busy_s, "idle_samples_per_s": total / idle_s},
        "Both cores are busy. Per sample, the pipeline takes 2.5 us of processor time, taking samples out of Zenoh and "
        "into columns 1.3 us (five objects of zenoh-python each), Zenoh's receiving thread 1.4 us, and the publisher 2 "
        "us, or 4 us while a full channel blocks it.",
    )


def measure_batches(repeats: int = 3, cars: int = 1000, turns: int = 400) -> Measure:
    """Measure the live consumer with batches of a gateway, against the same samples one by one in JSON."""
    total = cars * turns
    single_s, batch_s = alternate_timings(
        lambda: time_stream(connect_plainly(), cars, turns, make_full_consumer(cars, turns)).wall_s,
        lambda: time_stream(connect_plainly(), cars, turns, make_full_consumer(cars, turns), batched=True).wall_s,
        repeats,
    )
    return Measure(
        f"live consumer, batches of {BATCH_ROWS:,} samples in Arrow's format",
        "the same samples one by one in JSON",
        single_s / batch_s,
        ">= 5",
        {"batched_samples_per_s": total / batch_s, "single_samples_per_s": total / single_s},
        "The steps over arrays, the filters and the forecasts take three quarters of the time of a batch in the "
        "pipeline, and they are the same for both.",
    )


def connect(way: str, folder: SecureFolder, cars: int) -> tuple[Connection, list[Connection]]:
    """Return the connections of a router and of the sessions of cars."""
    if way == "plain":
        return connect_plainly(cars)
    config = folder.path / ("router.json5" if way == "rules" else "open.json5")
    router = Connection(listen=(f"tls/127.0.0.1:{folder.port}",), config=config)
    return router, [Connection(config=folder.locate(name_car(car))) for car in range(cars)]


def make_folder(path: Path, cars: int) -> SecureFolder:
    """Make a secured fleet, and a configuration of its router with certificates and without rules."""
    names = [name_car(car) for car in range(cars)]
    folder = SecureFolder.create(path, ["127.0.0.1"], names, port=find_free_port(), days=1.0)
    settings = json.loads((path / "router.json5").read_text())
    known = [(name, [f"{name}/1"]) for name in map(name_car, range(FLEET))]
    for name, changed in (("open", {"enabled": False}), ("router", make_access_control(known))):
        (path / f"{name}.json5").write_text(json.dumps(settings | {"access_control": changed}))
    return folder


def measure_security(repeats: int = 7, cars: int = 20, turns: int = 8000) -> Measure:
    """Measure the live consumer with certificates and access control against the same with plain TCP."""
    total = cars * turns
    with tempfile.TemporaryDirectory() as temporary:
        folder = make_folder(Path(temporary) / "keys", cars)
        consume = make_full_consumer(cars, turns)
        timings = [
            [time_stream(connect(way, folder, cars), cars, turns, consume) for way in WAYS] for _ in range(repeats)
        ]
    plain, certificates, rules = (Cost(*costs) for costs in np.median(timings, axis=0))
    ratio = plain.wall_s / rules.wall_s
    return Measure(
        f"live consumer with certificates and access control, {FLEET:,} cars",
        "the same with plain TCP",
        ratio,
        ">= 0.8",
        {
            "plain_samples_per_s": total / plain.wall_s,
            "secured_samples_per_s": total / rules.wall_s,
            "ratio_of_certificates_alone": plain.wall_s / certificates.wall_s,
            "plain_cpu_us": plain.cpu_s / total * 1e6,
            "certificates_cpu_us": certificates.cpu_s / total * 1e6,
            "secured_cpu_us": rules.cpu_s / total * 1e6,
        },
        "Each car has a session of its own. Publisher and consumer keep both cores busy. Zenoh decrypts in its own "
        "threads and keeps the permission of each declared key, so that Python takes most of the time in either case. "
        "The CPU times are those of the process with consumer and router, per sample.",
    )
