"""Measure where the processor time of a live sample goes, by thread and by step, and what zenoh-python takes of it.

Example: python -m socast.tools.bench.live_cost --publish
"""

import multiprocessing
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from socast.core.forecast.due_forecasts import DueForecasts
from socast.core.totals.sample_totals import SampleTotals
from socast.core.wire.decoder import Decoder
from socast.core.wire.duplicate_filter import DuplicateFilter
from socast.core.wire.message_block import MessageBlock
from socast.stream.zenoh_gaps import SampleGaps
from socast.stream.zenoh_keys import SampleKeys
from socast.stream.zenoh_receiver import BLOCK, subscribe
from socast.stream.zenoh_session import Node
from socast.tools.bench import live
from socast.tools.bench.figures.published import make_parser, publish, show_table, tell_errors, write_table
from socast.tools.bench.live import (
    PATIENCE_S,
    WARM_UP,
    connect_plainly,
    make_bare_consumer,
    make_full_consumer,
    make_idle_consumer,
    publish_stream,
    time_stream,
    wait_until,
)

CARS: Final = 1000
TURNS: Final = 400
HEADS: Final = "thread", "step", "us a sample"
WAITING: Final = 40
"""Samples of each car that wait in a channel while their objects are measured."""
RECEIVING, TAKING, MAIN, PUBLISHING, OTHER = (
    "Zenoh, receiving",
    "taking samples",
    "pipeline",
    "publishing",
    "Zenoh, other",
)
THREADS: Final = {
    "rx-": RECEIVING,
    "zenoh-source": TAKING,
    "MainThread": MAIN,
    "latest-only-sink": PUBLISHING,
    "tx-": PUBLISHING,
}
"""What threads do, by the beginning of their names."""
STEPS: Final[tuple[tuple[str, str, type, str], ...]] = (
    (MAIN, "decode", Decoder, "decode"),
    (MAIN, "drop repetitions", DuplicateFilter, "select_new"),
    (MAIN, "clean", SampleTotals, "clean_up"),
    (MAIN, "signals and sums", SampleTotals, "sum_up"),
    (MAIN, "filters and outlook", DueForecasts, "update"),
    (MAIN, "forecasts in JSON", DueForecasts, "_build"),
)
"""Thread, step, and the method that takes it; none of them calls another one."""
TAKEN: Final = (
    "samples out of the channel",
    "keys and payloads as objects",
    "numbers of keys",
    "gaps in the numbers of publishers",
    "payloads in one buffer",
)
"""Steps of taking a block of samples."""


def measure_threads(cars: int, turns: int) -> dict[tuple[str, str], float]:
    """Return the processor time of each thread of the live consumer, without a step, and of its steps. [us a sample]"""
    steps: dict[tuple[str, str], float] = defaultdict(float)
    marks: list[dict[tuple[str, str], float]] = []

    def wrap(function: Callable[..., Any], thread: str, step: str) -> Callable[..., Any]:
        def timed(*arguments: Any, **options: Any) -> Any:
            began = time.thread_time()
            try:
                return function(*arguments, **options)
            finally:
                steps[thread, step] += time.thread_time() - began

        return timed

    def read_clocks() -> Any:
        marks.append(read_threads() | steps)
        return _read_clocks()

    _read_clocks = live.read_clocks
    with ExitStack() as ending:
        ending.enter_context(patch.object(live, "read_clocks", read_clocks))
        for thread, step, kind, name in STEPS:
            ending.enter_context(patch.object(kind, name, wrap(getattr(kind, name), thread, step)))
        time_stream(connect_plainly(), cars, turns, make_full_consumer(cars, turns))
    begin, end = marks[:2]
    return {key: 1e6 * (end[key] - begin.get(key, 0.0)) / (cars * turns) for key in end}


def read_threads() -> dict[tuple[str, str], float]:
    """Return the processor time of the threads of this process by what they do. [s]"""
    own = {each.native_id: each.name for each in threading.enumerate()}
    out: dict[tuple[str, str], float] = defaultdict(float)
    for task in Path("/proc/self/task").iterdir():
        name = own.get(int(task.name)) or (task / "comm").read_text().strip()
        what = next((what for begin, what in THREADS.items() if name.startswith(begin)), OTHER)
        out[what, ""] += int((task / "schedstat").read_text().split()[0]) / 1e9
    return out


def measure_objects(cars: int) -> dict[tuple[str, str], float]:
    """Return what the steps of taking a sample need, on samples that wait in a channel. [us a sample]"""
    context, (router, connections) = multiprocessing.get_context("spawn"), connect_plainly()
    ready, go = context.Event(), context.Event()
    capacity = cars * (WAITING + WARM_UP)
    with Node(router) as node, subscribe(node.session, "fleet/*/telemetry", capacity) as subscriber:
        process = context.Process(target=publish_stream, args=(connections, cars, WAITING, ready, go))
        process.start()
        receive = subscriber.handler.try_recv
        wait_until(ready.is_set)
        go.set()
        process.join(PATIENCE_S)
        keys, gaps = SampleKeys(), SampleGaps()
        rounds = [_time_objects(receive, keys, gaps) for _ in range(cars * WAITING // BLOCK)]
    return {(TAKING, step): float(np.median([each[step] for each in rounds])) for step in rounds[0]}


def _time_objects(receive: Callable[[], Any], keys: SampleKeys, gaps: SampleGaps) -> dict[str, float]:
    """Return what each step of taking a block of samples needs, by sample. [us]"""
    marks = [time.thread_time()]
    samples = list(islice(iter(receive, None), BLOCK))
    marks.append(time.thread_time())
    expressions = [each.key_expr for each in samples]
    payloads = [each.payload.to_bytes() for each in samples]
    marks.append(time.thread_time())
    numbers = [keys[each] for each in expressions]
    marks.append(time.thread_time())
    gaps.find(numbers, samples, lambda *_: False)
    marks.append(time.thread_time())
    MessageBlock.pack(keys.texts, numbers, payloads, 0)
    marks.append(time.thread_time())
    return dict(zip(TAKEN, (1e6 * np.diff(marks) / len(samples)).tolist(), strict=True))


def make_rows(cars: int, turns: int, repeats: int) -> tuple[list[list[str]], dict[str, float]]:
    """Return the cells of the table, and the processor time of three consumers and of objects. [us a sample]"""
    threads: list[dict[tuple[str, str], float]] = []
    others: list[list[float]] = []
    for _ in range(repeats):
        threads.append(measure_threads(cars, turns))
        consumers = make_idle_consumer(cars, turns), make_bare_consumer(cars, turns)
        others.append([time_stream(connect_plainly(), cars, turns, each).cpu_s for each in consumers])
    objects = measure_objects(cars)
    costs = {key: float(np.median([each.get(key, 0.0) for each in threads])) for key in threads[0]} | objects
    rows, whole = [], 0.0
    for thread in (RECEIVING, TAKING, MAIN, PUBLISHING, OTHER):
        parts = {step: cost for (of, step), cost in costs.items() if of == thread and step}
        whole += (total := costs.get((thread, ""), 0.0))
        rows += [[thread, step, f"{cost:.2f}"] for step, cost in parts.items()]
        rows.append([thread, "the rest" if parts else "", f"{total - sum(parts.values()):.2f}"])
    idle, bare = 1e6 * np.median(others, axis=0) / (cars * turns)
    rows.append(["all", "", f"{whole:.2f}"])
    saved = sum(objects[TAKING, step] for step in TAKEN[:3])
    return rows, {"live": whole, "idle": float(idle), "bare": float(bare), "objects": saved}


@tell_errors
def main(arguments: list[str] | None = None) -> None:
    """Measure, print the table, and publish it if that is asked for."""
    parser = make_parser("live_cost", __doc__, publish=False)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    rows, sums = make_rows(CARS, TURNS, options.repeats)
    show_table("Processor time of a live sample", HEADS, rows, "--n")
    print(summary := summarise(sums))
    if options.publish:
        publish(
            "live-cost", "python -m socast.tools.bench.live_cost --publish", [*write_table(HEADS, rows), "", summary]
        )


def summarise(sums: dict[str, float]) -> str:
    """Return what the sums tell, in words."""
    live_us, idle, bare, objects = (sums[name] for name in ("live", "idle", "bare", "objects"))
    less = live_us - objects
    return (
        f"An idle subscriber takes {idle:.2f} us a sample, and a reader that takes keys and bytes out of a channel "
        f"{bare:.2f} us. The live consumer takes {live_us / idle:.1f} and {live_us / bare:.1f} times as much. Samples, "
        f"keys and payloads as objects, and the numbers of keys, take {objects:.2f} us of it. Without these it would "
        f"take {less / idle:.1f} times as much as an idle subscriber."
    )


if __name__ == "__main__":
    sys.exit(main())
