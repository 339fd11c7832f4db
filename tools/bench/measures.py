"""Measure replay, the steps over arrays, the scale of the fleet and the start of commands; time actions in turn."""

import gc
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import numpy as np
from mcap.reader import make_reader

from socast.core.batch import Batch, Lanes
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.settings import Limits
from socast.core.totals.sample_totals import BLOCK
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message
from socast.stream.loop import feed
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.tools.bench.fleet import make_rounds, make_vehicles

BARE = ("-c", "pass")
"""What the interpreter is started with for comparison."""
REPEATS = 7


@dataclass(frozen=True)
class Measure:
    """Hold one line of the report.

    Parameters
    ----------
    name, over : str
        What was measured, and what it is compared with.
    ratio : float
        Ratio of speeds, or of costs if `goal` is an upper bound.
    goal : str
        Goal for the ratio, such as `>= 0.5`.
    figures : dict of str to float
        Medians behind the ratio; the names contain the units.
    bound : str
        What limits the ratio, as a profile showed.
    """

    name: str
    over: str
    ratio: float
    goal: str
    met: bool
    figures: dict[str, float] = field(default_factory=dict)
    bound: str = ""


def time_action(action: Callable[[], object]) -> float:
    """Return the time of an action without garbage collection. [s]"""
    gc.collect()
    gc.disable()
    try:
        began = time.perf_counter()
        action()
        return time.perf_counter() - began
    finally:
        gc.enable()


def alternate_timings(first: Callable[[], float], second: Callable[[], float], repeats: int) -> tuple[float, float]:
    """Return the medians of two timings taken in turn, so that noise of the machine affects both equally."""
    pairs = [(first(), second()) for _ in range(repeats)]
    return median(a for a, _ in pairs), median(b for _, b in pairs)


def cut_blocks(messages: Sequence[Message], size: int = BLOCK) -> Iterable[Sequence[Message]]:
    """Return messages in blocks."""
    return (messages[at : at + size] for at in range(0, len(messages), size))


def measure_replay(repeats: int = 3, cars: int = 50, turns: int = 2000) -> Measure:
    """Measure reading, decoding, cleaning and forecasting a recording, against iterating it with the bare reader."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        with McapSink(path) as sink:
            sink.put(make_vehicles(cars))
            for messages in make_rounds(cars, 0, turns):
                sink.put(messages)
        n = cars * turns

        def bare() -> None:
            with path.open("rb") as file:
                for _ in make_reader(file).iter_messages():
                    pass

        def whole() -> None:
            pipeline = Pipeline(EXTENDED_PHYSICAL)
            for _ in feed(McapSource(path), pipeline):
                pipeline.forecasts()

        whole()
        bare_s, whole_s = alternate_timings(lambda: time_action(bare), lambda: time_action(whole), repeats)
    return Measure(
        "replay at full speed, file to forecasts",
        "iterating the bare mcap reader",
        bare_s / whole_s,
        ">= 3",
        bare_s / whole_s >= 3.0,
        {"replay_us_per_sample": whole_s / n * 1e6, "bare_us_per_sample": bare_s / n * 1e6},
        "Reading takes a twelfth of the time of a replayed sample, decoding a seventh, the filter of repetitions a "
        "thirtieth, the steps over arrays a quarter, and the filters and forecasts with their JSON two fifths. The "
        "bare reader makes an object of every record.",
    )


def measure_arrays(repeats: int = 5, cars: int = 1000, turns: int = 200) -> Measure:
    """Measure cleaning, signals and totals over arrays in memory, in samples per second on one core."""
    pipeline, batch = _prepared(cars, turns)
    n = batch.size

    def run() -> float:
        fresh = _prepared_pipeline(cars)
        kind, totals = fresh.cars.kinds(batch.lane, [], cars), fresh.totals
        return time_action(
            lambda: [
                totals.sum_up(totals.clean_up(batch.rows(at, at + BLOCK), kind[at : at + BLOCK]))
                for at in range(0, n, BLOCK)
            ]
        )

    del pipeline
    run()
    speed = n / median(run() for _ in range(repeats))
    return Measure(
        "arrays through cleaning, signals and totals, one core",
        "a million samples per second",
        speed / 1e6,
        ">= 1",
        speed >= 1e6,
        {"ns_per_sample": 1e9 / speed},
        "The cleaning kernel takes a third of the time and the totals another third. Both are bound by "
        "memory: each sample touches half a kilobyte of state of its car and the totals of its ride. The rest "
        "is numpy over blocks of 4,000 rows. Blocks with a power of two rows take a third longer, because "
        "their columns evict each other from the cache.",
    )


def _prepared_pipeline(cars: int) -> Pipeline:
    """Return a pipeline that knows its cars."""
    pipeline = Pipeline(EXTENDED_PHYSICAL, keep_tables=False, limits=Limits(vehicles=cars))
    pipeline.push(make_vehicles(cars))
    return pipeline


def _prepared(cars: int, turns: int) -> tuple[Pipeline, Batch]:
    """Return a pipeline that knows its cars, and their samples as one batch."""
    lanes = Lanes()
    decoder = Decoder(lanes)
    decoder.decode(make_vehicles(cars))
    tables = [np.stack(decoder.decode(messages)[0]) for messages in make_rounds(cars, 0, turns)]
    table = np.concatenate(tables, axis=1)
    batch = Batch(table[0].astype(np.int64), table[1].astype(np.int64), *table[2:])
    return _prepared_pipeline(cars), batch


def measure_scale(repeats: int = 3, few: int = 1000, many: int = 1_000_000) -> Measure:
    """Measure the cost of a sample, from payload to forecast, in a fleet of a million cars against a thousand."""
    fleets = []
    for cars in (few, many):
        pipeline = _prepared_pipeline(cars)
        for messages in make_rounds(cars, 0, 2):
            for block in cut_blocks(messages):
                pipeline.push(block)
        fleets.append((cars, pipeline))

    def cost(cars: int, pipeline: Pipeline, turn: int) -> float:
        """Take a quarter of a million samples, spread over the fleet."""
        turns, apart = max(1, samples // cars), max(1, cars // samples)
        messages = [m for messages in make_rounds(cars, turn, turns) for m in messages[::apart]]
        return time_action(lambda: [pipeline.push(block) for block in cut_blocks(messages)]) / len(messages)

    samples = 250_000
    few_s, many_s = [], []
    for repeat in range(repeats):
        few_s.append(cost(*fleets[0], 2 + repeat * (samples // few)))
        many_s.append(cost(*fleets[1], 2 + repeat))
    ratio = median(many_s) / median(few_s)
    return Measure(
        f"cost of a sample among {many:,} cars",
        f"among {few:,}",
        ratio,
        "<= 1.5",
        ratio <= 1.5,
        {"us_among_many": median(many_s) * 1e6, "us_among_few": median(few_s) * 1e6},
        "Cache misses limit it. The state of a thousand cars fits into the processor's cache. The state of a "
        "million cars (2 GB) does not, so every sample waits for the state of its car. That state is "
        "contiguous in memory, so a sample waits only a few times.",
    )


def measure_help_start() -> Measure:
    """Measure `socast --help`."""
    return _start("--help", 15.0, "Half of it is typer and the rest the standard library; no command is imported.")


def measure_version_start() -> Measure:
    """Measure `socast --version`."""
    return _start("--version", 15.0, "As for --help; reading the version takes 20 ms of `importlib.metadata`.")


def measure_effects_start() -> Measure:
    """Measure `socast effects list`."""
    return _start("effects list", 50.0, "A third is importing numpy, a fifth typer with its validation, a tenth rich.")


def _start(words: str, goal: float, bound: str) -> Measure:
    """Measure a command that prints and ends, against `python -c pass`."""
    command = ("-m", "socast.tools.cli", *words.split())
    for arguments in (BARE, command):
        _run(*arguments)  # the first run compiles modules to byte code
    bare_s, command_s = alternate_timings(
        lambda: time_action(lambda: _run(*BARE)), lambda: time_action(lambda: _run(*command)), REPEATS
    )
    ratio = command_s / bare_s
    return Measure(
        f"start of socast {words}",
        "python -c pass",
        ratio,
        f"<= {goal:g}",
        ratio <= goal,
        {"command_s": command_s, "python_s": bare_s},
        bound,
    )


def _run(*arguments: str) -> None:
    """Run the interpreter to its end, without its output."""
    subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)  # noqa: S603 - our own command
