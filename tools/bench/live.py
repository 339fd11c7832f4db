"""Measure the live consumer on a stream from another process: against an idle subscriber, and with certificates."""

import json
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from multiprocessing.synchronize import Event as ProcessEvent
from pathlib import Path
from statistics import median
from threading import Event
from typing import Any, Final, NamedTuple, TypeAlias

import msgspec
import pyarrow as pa

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
SETTLE_S = 2.0
"""Time for the consequences of the warm-up, such as declaring the keys of forecasts, to finish. [s]"""

Consumer: TypeAlias = Callable[[Node, ProcessEvent, ProcessEvent], float]


def make_batches(messages: Sequence[Message], size: int = BATCH_ROWS) -> list[Message]:
    """Return samples in JSON as batches of one gateway in Arrow's stream format."""
    samples = [msgspec.json.decode(message.payload) for message in messages]
    parts = [samples[at : at + size] for at in range(0, len(samples), size)]
    return [Message("fleet/gateway/batch", write_rows(pa.Table.from_pylist(part)), 0) for part in parts]


def publish_stream(
    endpoint: str, cars: int, turns: int, ready: ProcessEvent, go: ProcessEvent, *, batched: bool = False
) -> None:
    """Publish a stream as fast as it is accepted, in a separate process."""
    messages = [message for turn in make_rounds(cars, WARM_UP, turns) for message in turn]
    messages = make_batches(messages) if batched else messages
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


def time_stream(cars: int, turns: int, consume: Consumer, *, batched: bool = False) -> float:
    """Return the time in which a consumer takes a stream, from its first to its last sample. [s]"""
    context = multiprocessing.get_context("spawn")
    ready, go = context.Event(), context.Event()
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    with Node(Connection(listen=(endpoint,), mode="router")) as node:
        process = context.Process(
            target=publish_stream, args=(endpoint, cars, turns, ready, go), kwargs={"batched": batched}
        )
        process.start()

        took = consume(node, ready, go)
        process.join(PATIENCE_S)
    return took


def make_idle_consumer(cars: int, turns: int) -> Consumer:
    """Return a consumer that only counts samples."""

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
    """Return the consumer as in service: it decodes, cleans, accumulates, predicts and publishes forecasts."""

    def consume(node: Node, ready: ProcessEvent, go: ProcessEvent) -> float:
        stop = Event()
        pipeline = Pipeline(EXTENDED_PHYSICAL, keep_tables=False)
        began = ended = settled = 0.0
        patience = time.monotonic() + PATIENCE_S

        def watch(_: Tally) -> None:
            nonlocal began, ended, settled
            if time.monotonic() > patience:
                raise TimeoutError(f"the stream has not arrived within {PATIENCE_S:g} s; stop other work")
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
        run(source, pipeline, [LatestOnlySink(ZenohSink(node))], publish_s=PUBLISH_S, watch=watch)
        return ended - began

    return consume


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
        lambda: time_stream(cars, turns, make_idle_consumer(cars, turns)),
        lambda: time_stream(cars, turns, make_full_consumer(cars, turns)),
        repeats,
    )
    return Measure(
        f"live consumer, decode to forecast, {cars:,} cars",
        "an idle Zenoh subscriber",
        idle_s / busy_s,
        ">= 0.8",
        idle_s / busy_s >= 0.8,
        {"live_samples_per_s": total / busy_s, "idle_samples_per_s": total / idle_s},
        "Both cores are busy. Per sample, the pipeline takes 2.5 us of processor time, taking samples out of Zenoh and "
        "into columns 1.3 us (five objects of zenoh-python each), Zenoh's receiving thread 1.4 us, and the publisher 2 "
        "us, or 4 us while a full channel blocks it.",
    )


def measure_batches(repeats: int = 3, cars: int = 1000, turns: int = 400) -> Measure:
    """Measure the live consumer with batches of a gateway, against the same samples one by one in JSON."""
    total = cars * turns
    single_s, batch_s = alternate_timings(
        lambda: time_stream(cars, turns, make_full_consumer(cars, turns)),
        lambda: time_stream(cars, turns, make_full_consumer(cars, turns), batched=True),
        repeats,
    )
    return Measure(
        f"live consumer, batches of {BATCH_ROWS:,} samples in Arrow's format",
        "the same samples one by one in JSON",
        single_s / batch_s,
        ">= 5",
        single_s >= 5 * batch_s,
        {"batched_samples_per_s": total / batch_s, "single_samples_per_s": total / single_s},
        "The steps over arrays, the filters and the forecasts take three quarters of the time of a batch in the "
        "pipeline, and they are the same for both.",
    )


WAYS: Final = "plain", "certificates", "rules"
"""Plain TCP; mutual TLS; mutual TLS with access control."""
FLEET: Final = 1000
"""Number of cars that the rules know; only some of them publish."""


def publish_streams(connections: Sequence[Connection], turns: int, ready: ProcessEvent, go: ProcessEvent) -> None:
    """Publish the stream of each car in a session of its own, as fast as it is accepted, in a separate process."""
    cars = len(connections)
    rounds = list(make_rounds(cars, WARM_UP, turns))
    with ExitStack() as ending:
        sinks = [ZenohSink(ending.enter_context(Node(connection))) for connection in connections]
        for turn in (make_vehicles(cars), *make_rounds(cars, 0, WARM_UP)):
            for sink, message in zip(sinks, turn, strict=True):
                sink.put([message])
        ready.set()
        go.wait(PATIENCE_S)
        for turn in rounds:
            for sink, message in zip(sinks, turn, strict=True):
                sink.put([message])
        for sink in sinks:
            sink.close()


class Way(NamedTuple):
    """Hold the cost of taking the streams of cars.

    Parameters
    ----------
    wall_s : float
        Time from the first to the last sample. [s]
    cpu_s : float
        CPU time of the process with consumer and router. [s]
    """

    wall_s: float
    cpu_s: float


class _CpuTimer:
    """Take the CPU time at which a stream begins, when the consumer asks for it."""

    def __init__(self, go: ProcessEvent) -> None:
        self._go = go
        self.began_s = 0.0

    def set(self) -> None:
        """Note the CPU time, and let the stream begin."""
        self.began_s = time.process_time()
        self._go.set()


def time_way(way: str, folder: SecureFolder, cars: int, turns: int) -> Way:
    """Return the cost at which the live consumer takes the streams of cars."""
    if way == "plain":
        endpoint = f"tcp/127.0.0.1:{find_free_port()}"
        router = Connection(listen=(endpoint,), mode="router")
        connections = [Connection(connect=(endpoint,))] * cars
    else:
        config = folder.path / ("router.json5" if way == "rules" else "open.json5")
        router = Connection(listen=(f"tls/127.0.0.1:{folder.port}",), config=config)
        connections = [Connection(config=folder.locate(name_car(car))) for car in range(cars)]
    context = multiprocessing.get_context("spawn")
    ready, go = context.Event(), context.Event()
    with Node(router) as node:
        process = context.Process(target=publish_streams, args=(connections, turns, ready, go))
        process.start()
        timer: Any = _CpuTimer(go)
        wall_s = make_full_consumer(cars, turns)(node, ready, timer)
        cpu_s = time.process_time() - timer.began_s
        process.join(PATIENCE_S)
    return Way(wall_s, cpu_s)


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
        timings = [[time_way(way, folder, cars, turns) for way in WAYS] for _ in range(repeats)]
    plain, certificates, rules = (
        Way(*(median(costs) for costs in zip(*of_way, strict=True))) for of_way in zip(*timings, strict=True)
    )
    ratio = plain.wall_s / rules.wall_s
    return Measure(
        f"live consumer with certificates and access control, {FLEET:,} cars",
        "the same with plain TCP",
        ratio,
        ">= 0.8",
        ratio >= 0.8,
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
