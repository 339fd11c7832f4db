"""Measure the live consumer on a stream from another process: against others, in batches, and with all it can keep."""

import json
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import cycle, islice
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
from socast.stream.checkpoints import Checkpoints
from socast.stream.loop import PUBLISH_S, Tally, combine_watches, run
from socast.stream.recorder import Recorder
from socast.stream.state_file import StateFile
from socast.stream.zenoh_receiver import BLOCK, CHANNEL, subscribe
from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.stream.zenoh_sink import LatestOnlySink, ZenohSink
from socast.stream.zenoh_source import ZenohSource
from socast.tools.bench.measures import Measure, make_rounds, make_vehicles, name_car
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


def run_router(connection: Connection, ready: ProcessEvent, stop: ProcessEvent) -> None:
    """Run a router until it is stopped."""
    with Node(connection):
        ready.set()
        stop.wait()


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
            began = read_clocks()
            go.set()
            wait_until(lambda: seen == cars * (WARM_UP + turns))
            return Cost(*(read_clocks() - began).tolist())

    return consume


def make_bare_consumer(cars: int, turns: int) -> Consumer:
    """Return a consumer that takes the key and the bytes of each sample out of a channel, and no more."""

    def consume(node: Node, ready: ProcessEvent, go: ProcessEvent) -> Cost:
        seen = 0

        def take(receive: Callable[[], Any]) -> None:
            nonlocal seen
            taken = [(each.key_expr, each.payload.to_bytes()) for each in islice(iter(receive, None), BLOCK)]
            seen += len(taken)

        with subscribe(node.session, "fleet/*/telemetry", CHANNEL) as subscriber:
            receive = subscriber.handler.try_recv

            def has_seen(samples: int) -> bool:
                take(receive)
                return seen == samples

            wait_until(lambda: has_seen(cars * WARM_UP) and ready.is_set())
            time.sleep(SETTLE_S)
            began = read_clocks()
            go.set()
            wait_until(lambda: has_seen(cars * (WARM_UP + turns)))
            return Cost(*(read_clocks() - began).tolist())

    return consume


def make_full_consumer(cars: int, turns: int, *, keeps: bool = False) -> Consumer:
    """Return the consumer as in service: it decodes, cleans, accumulates, predicts and publishes forecasts.

    With `keeps` it also records every message and saves its state.
    """

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
                began = read_clocks()
                go.set()
            elif began is not None and received == cars * (WARM_UP + turns):
                wall_s = wall_s or float((read_clocks() - began)[0])
                stop.set()

        sink = LatestOnlySink(ZenohSink(node))
        with ExitStack() as ending:
            recorder = checkpoints = None
            if keeps:
                folder = Path(ending.enter_context(tempfile.TemporaryDirectory()))
                recorder = ending.enter_context(Recorder(folder / "kept"))
                state = ending.enter_context(StateFile(folder / "fleet.state"))
                checkpoints = Checkpoints(pipeline, state, recorder)
            run(
                ZenohSource(node, stop),
                pipeline,
                [sink, checkpoints] if checkpoints else [sink],
                recorder=recorder,
                publish_s=PUBLISH_S,
                watch=combine_watches(watch, checkpoints) if checkpoints else watch,
            )
        assert began is not None
        return Cost(wall_s, float((read_clocks() - began)[1]))

    return consume


def read_clocks() -> Floats:
    """Return a time and the processor time of this process, (2,). [s]"""
    return np.array([time.perf_counter(), time.process_time()])


def wait_until(until: Callable[[], bool]) -> None:
    """Wait until a condition is true, checked every 2 ms."""
    patience = time.monotonic() + PATIENCE_S
    while not until():
        if time.monotonic() > patience:
            raise TimeoutError(f"the stream has not arrived within {PATIENCE_S:g} s; stop other work")
        time.sleep(0.002)


def compare_consumers(streams: Sequence[Callable[[], Cost]], repeats: int) -> list[Cost]:
    """Return the median costs of taking streams in turn."""
    rounds = [[stream() for stream in streams] for _ in range(repeats)]
    return [Cost(*costs) for costs in np.median(rounds, axis=0).tolist()]


def _time_plainly(cars: int, turns: int, consume: Consumer, *, batched: bool = False, routed: bool = False) -> Cost:
    """Return what a consumer takes for a stream of one session over plain TCP, through its own or another router."""
    router, connections = connect_plainly()
    if not routed:
        return time_stream((router, connections), cars, turns, consume, batched=batched)
    context = multiprocessing.get_context("spawn")
    ready, stop = context.Event(), context.Event()
    process = context.Process(target=run_router, args=(router, ready, stop))
    process.start()
    try:
        ready.wait(PATIENCE_S)
        return time_stream((connections[0], connections), cars, turns, consume)
    finally:
        stop.set()
        process.join(PATIENCE_S)


def measure_live(repeats: int = 5, cars: int = 1000, turns: int = 400) -> list[Measure]:
    """Measure the live consumer against an idle subscriber and a bare reader of a channel, and with batches."""
    total = cars * turns
    consumers = [make(cars, turns) for make in (make_idle_consumer, make_bare_consumer, make_full_consumer)]
    streams = [partial(_time_plainly, cars, turns, consumer) for consumer in consumers]
    streams.append(partial(_time_plainly, cars, turns, consumers[-1], batched=True))
    streams.append(partial(_time_plainly, cars, turns, consumers[-1], routed=True))
    idle, bare, full, batched, routed = compare_consumers(streams, repeats)
    cpu = {
        f"{name}_cpu_us": cost.cpu_s / total * 1e6 for name, cost in (("idle", idle), ("bare", bare), ("live", full))
    }
    name = f"live consumer, decode to forecast, {cars:,} cars"
    return [
        Measure(
            name,
            "an idle Zenoh subscriber",
            idle.wall_s / full.wall_s,
            ">= 0.8",
            {"live_samples_per_s": total / full.wall_s, "idle_samples_per_s": total / idle.wall_s},
            "Both cores are busy: the publisher takes one of them, and the consumer's threads the other.",
        ),
        Measure(
            f"processor time of a sample in the {name}",
            "in an idle subscriber",
            full.cpu_s / idle.cpu_s,
            "<= 1.4",
            cpu,
            "Zenoh's receiving threads take as much as in the idle subscriber. Taking a sample as objects of "
            "zenoh-python and into columns costs as much again, and the pipeline twice as much.",
        ),
        Measure(
            f"processor time of a sample in the {name}",
            "in a reader that takes keys and bytes out of a channel",
            full.cpu_s / bare.cpu_s,
            "<= 1.8",
            {},
            "As above. The reader is what Python takes at least for a sample that is used.",
        ),
        Measure(
            f"processor time of a sample in the {name}, through another router",
            "through its own",
            routed.cpu_s / full.cpu_s,
            "<= 1.5",
            {"routed_cpu_us": routed.cpu_s / total * 1e6, "routed_samples_per_s": total / routed.wall_s},
            "The consumer declares the keys that it receives. A client of a router would otherwise compare each sample "
            "with the tokens of all publishers.",
        ),
        Measure(
            f"live consumer, batches of {BATCH_ROWS:,} samples in Arrow's format",
            "an idle subscriber of the same samples one by one",
            idle.wall_s / batched.wall_s,
            ">= 1.8",
            {"batched_samples_per_s": total / batched.wall_s, "batched_cpu_us": batched.cpu_s / total * 1e6},
            "The pipeline limits it, in one thread. The steps over arrays, the filters and the forecasts take three "
            "quarters of its time, and they are the same for samples one by one.",
        ),
    ]


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


def measure_security(repeats: int = 7, cars: int = 20, turns: int = 8000) -> list[Measure]:
    """Measure the live consumer with certificates and access control, and with a recording and a state besides."""
    total = cars * turns
    with tempfile.TemporaryDirectory() as temporary:
        folder = make_folder(Path(temporary) / "keys", cars)
        consume = make_full_consumer(cars, turns)
        ways = [("plain", make_idle_consumer(cars, turns)), *((way, consume) for way in WAYS)]
        ways.append(("rules", make_full_consumer(cars, turns, keeps=True)))
        streams = [partial(_time_way, way, folder, cars, turns, consumer) for way, consumer in ways]
        idle, plain, certificates, rules, kept = compare_consumers(streams, repeats)
    return [
        Measure(
            f"live consumer with certificates and access control, {FLEET:,} cars",
            "the same with plain TCP",
            plain.wall_s / rules.wall_s,
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
            "threads and keeps the permission of each declared key, so that Python takes most of the time in either "
            "case. The CPU times are those of the process with consumer and router, per sample.",
        ),
        Measure(
            "the same with a recording and a state",
            "an idle subscriber with plain TCP",
            idle.wall_s / kept.wall_s,
            ">= 0.7",
            {"kept_samples_per_s": total / kept.wall_s, "kept_cpu_us": kept.cpu_s / total * 1e6},
            "As above, and the recording is written by the thread of the pipeline.",
        ),
    ]


def _time_way(way: str, folder: SecureFolder, cars: int, turns: int, consume: Consumer) -> Cost:
    """Return what a consumer takes for a stream from the sessions of cars."""
    return time_stream(connect(way, folder, cars), cars, turns, consume)
