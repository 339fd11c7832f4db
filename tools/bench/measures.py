"""The four measures: each returns a ratio, what it is a ratio of, and the figures behind it."""

import gc
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import numpy as np
from mcap.reader import make_reader

from core.batch import Batch, Lanes
from core.models import EXTENDED_PHYSICAL
from core.pipeline import BLOCK, Pipeline
from core.wire.decoder import Decoder
from core.wire.messages import Message
from stream.mcap_writer import McapSink, McapSource
from tools.bench.fleet import make_rounds, make_vehicles


@dataclass(frozen=True)
class Measure:
    """One line of the report.

    Parameters
    ----------
    name, over : str
        What was measured, and against what.
    ratio : float
        Of speeds, more is better; or as `meaning` says.
    goal : str
        As it is to be read: `>= 0.5`.
    met : bool
    figures : dict
        Medians behind the ratio, with their units in their names.
    bound : str
        What keeps it from being better, as a profile showed it.
    """

    name: str
    over: str
    ratio: float
    goal: str
    met: bool
    figures: dict[str, float] = field(default_factory=dict)
    bound: str = ""


def time_action(action: Callable[[], object]) -> float:
    """Return how long an action takes, without the garbage collector's moods. [s]"""
    gc.collect()
    gc.disable()
    try:
        began = time.perf_counter()
        action()
        return time.perf_counter() - began
    finally:
        gc.enable()


def alternate_timings(first: Callable[[], float], second: Callable[[], float], repeats: int) -> tuple[float, float]:
    """Return the medians of two timings taken in turn, so that a noisy machine is noisy to both."""
    pairs = [(first(), second()) for _ in range(repeats)]
    return median(a for a, _ in pairs), median(b for _, b in pairs)


def cut_blocks(messages: Sequence[Message], size: int = BLOCK) -> Iterable[Sequence[Message]]:
    """Cut messages into blocks."""
    return (messages[at : at + size] for at in range(0, len(messages), size))


def measure_replay(repeats: int = 3, cars: int = 50, turns: int = 2000) -> Measure:
    """Measure reading, decoding, cleaning and forecasting a recording against iterating it with the bare reader."""
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
            for messages in McapSource(path):
                pipeline.push(messages)
            pipeline.finish()

        whole()
        bare_s, whole_s = alternate_timings(lambda: time_action(bare), lambda: time_action(whole), repeats)
    return Measure(
        "replay at full speed, file to forecasts",
        "iterating the bare mcap reader",
        bare_s / whole_s,
        ">= 0.7",
        bare_s / whole_s >= 0.7,
        {"replay_us_per_sample": whole_s / n * 1e6, "bare_us_per_sample": bare_s / n * 1e6},
        "Of a replayed sample, a third is reading (chunks are split by hand), two fifths decoding JSON to columns, a "
        "fifth the steps after it, the rest encoding forecasts. The bare reader makes an object of every record.",
    )


def measure_arrays(repeats: int = 5, cars: int = 1000, turns: int = 200) -> Measure:
    """Measure clean, signals and sums over arrays in memory, in samples a second on one core."""
    pipeline, batch = _prepared(cars, turns)
    n = batch.size

    def run() -> float:
        fresh = _prepared_pipeline(cars)
        kind = fresh.cars.kinds(batch.lane, [], cars)
        return time_action(
            lambda: [fresh.sum_up(batch.rows(at, at + BLOCK), kind[at : at + BLOCK]) for at in range(0, n, BLOCK)]
        )

    del pipeline
    run()
    speed = n / median(run() for _ in range(repeats))
    return Measure(
        "arrays through clean, signals and sums, one core",
        "a million samples a second",
        speed / 1e6,
        ">= 1",
        speed >= 1e6,
        {"ns_per_sample": 1e9 / speed},
        "A third is the cleaning kernel, a third entering sums into the books, both bound by memory: each sample "
        "touches the half kilobyte of its car's state and the sums of its ride. The rest is numpy over blocks of "
        "4,000 rows. Blocks of a power of two take a third as long again: their columns push each other out of the "
        "cache.",
    )


def _prepared_pipeline(cars: int) -> Pipeline:
    """Return a pipeline that knows its cars."""
    pipeline = Pipeline(EXTENDED_PHYSICAL, keep_tables=False)
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
    """Measure the cost of a sample, payload to forecast, in a fleet of a million against one of a thousand."""
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
        "<= 2",
        ratio <= 2.0,
        {"us_among_many": median(many_s) * 1e6, "us_among_few": median(few_s) * 1e6},
        "Cache misses: of a thousand cars the state fits into the processor's cache, of a million (2 GB) it does not, "
        "and every sample waits for its car's. That is one stretch of memory, so it waits but a few times.",
    )
