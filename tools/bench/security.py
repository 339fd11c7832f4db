"""Measure what certificates and access control cost the live consumer, against plain TCP on the same stream."""

import json
import multiprocessing
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from multiprocessing.synchronize import Event as ProcessEvent
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple

from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.stream.zenoh_sink import ZenohSink
from socast.tools.bench.fleet import make_rounds, make_vehicles, name_car
from socast.tools.bench.live import PATIENCE_S, WARM_UP, make_full_consumer
from socast.tools.bench.measures import Measure
from socast.tools.security.access import make_access_control
from socast.tools.security.folder import SecureFolder

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
