"""Measure replays, decoding and small blocks, each in one process."""

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from mcap.reader import make_reader

from socast.core.batch import Lanes
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message
from socast.stream.loop import feed
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.tools.bench.filters import make_plans
from socast.tools.bench.live import make_batches
from socast.tools.bench.measures import (
    Measure,
    alternate_timings,
    cut_blocks,
    make_rounds,
    make_vehicles,
    time_action,
)

GOALS: Final = {(False, False): ">= 4", (True, False): ">= 2.5", (False, True): ">= 2.5", (True, True): ">= 1.8"}
"""Goal of a replay, by whether cars have plans, and whether the forecasts are recorded."""
BOUNDS: Final = {
    False: "Of the time of a replayed sample, reading takes a tenth, decoding a seventh, cleaning a sixth, the other "
    "steps over arrays a quarter, and the filters and forecasts with their JSON a third. The bare reader makes an "
    "object of every record.",
    True: "As above, and a sample in five has a forecast, which is written and compressed.",
}
"""What limits a replay without and with a recording of its forecasts."""
SMALL: Final = 64
"""Number of samples in a small block."""


def measure_replay(repeats: int = 5, cars: int = 50, turns: int = 2000) -> list[Measure]:
    """Measure reading, decoding, cleaning and forecasting a recording, against iterating it with the bare reader."""
    return [
        measure
        for with_plans in (False, True)
        for measure in _measure_recording(repeats, cars, turns, with_plans=with_plans)
    ]


def _measure_recording(repeats: int, cars: int, turns: int, *, with_plans: bool) -> list[Measure]:
    """Measure the replay of a recording without and with a recording of its forecasts."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "bench.mcap", Path(folder) / "forecasts.mcap"
        with McapSink(path) as sink:
            sink.put(make_vehicles(cars))
            sink.put(make_plans(cars) if with_plans else [])
            for messages in make_rounds(cars, 0, turns):
                sink.put(messages)

        def bare() -> None:
            with path.open("rb") as file:
                for _ in make_reader(file).iter_messages():
                    pass

        def replay(*, recorded: bool) -> None:
            pipeline = Pipeline(EXTENDED_PHYSICAL)
            with McapSink(out) as sink:
                for _ in feed(McapSource(path), pipeline):
                    forecasts = pipeline.forecasts()
                    sink.put(forecasts if recorded else [])

        replay(recorded=True)
        bare_s, *took = alternate_timings(
            lambda: time_action(bare),
            lambda: time_action(lambda: replay(recorded=False)),
            lambda: time_action(lambda: replay(recorded=True)),
            repeats=repeats,
        )
    n = cars * turns
    return [
        Measure(
            f"replay at full speed{', with plans' * with_plans}, file to forecasts{' in a file' * recorded}",
            "iterating the bare mcap reader",
            bare_s / replay_s,
            GOALS[with_plans, recorded],
            {"replay_us_per_sample": replay_s / n * 1e6, "bare_us_per_sample": bare_s / n * 1e6},
            BOUNDS[recorded],
        )
        for recorded, replay_s in zip((False, True), took, strict=True)
    ]


def measure_decoding(repeats: int = 9, cars: int = 1000, turns: int = 20) -> Measure:
    """Measure the decoder with batches of a gateway, against the same samples one by one in JSON."""
    samples = [message for turn in make_rounds(cars, 0, turns) for message in turn]

    def decode(messages: Sequence[Message], block: int) -> float:
        decoder = Decoder(Lanes())
        for known in (make_vehicles(cars), samples[:cars], samples[cars : 2 * cars]):
            decoder.decode(known)
        parts = list(cut_blocks(messages, block))
        return time_action(lambda: [decoder.decode(part) for part in parts])

    batches = make_batches(samples)
    single_s, batch_s = alternate_timings(lambda: decode(samples, 4000), lambda: decode(batches, 4), repeats=repeats)
    n = len(samples)
    return Measure(
        "decoding batches of 1,000 samples in Arrow's format",
        "the same samples one by one in JSON",
        batch_s / single_s,
        "<= 0.7",
        {"batched_us_per_sample": batch_s / n * 1e6, "single_us_per_sample": single_s / n * 1e6},
        "JSON is scanned by a compiled kernel. Most of the time of a batch is spent in some hundred calls of pyarrow "
        "and numpy, however few its rows.",
    )


def measure_small_blocks(cars: int = 1000, turns: int = 40) -> Measure:
    """Measure what a small block with plans and forecasts takes, against its share of large ones."""
    costs = []
    for block in (SMALL, 4000):
        pipeline = Pipeline(EXTENDED_PHYSICAL, keep_tables=False)
        pipeline.push([*make_vehicles(cars), *make_plans(cars)])
        for turn in make_rounds(cars, 0, 20):
            pipeline.push(turn)
        messages = [message for turn in make_rounds(cars, 20, turns) for message in turn]
        began = time.process_time()
        for part in cut_blocks(messages, block):
            pipeline.push(part)
        costs.append((time.process_time() - began) / len(messages))
    small, large = costs
    return Measure(
        f"a sample in blocks of {SMALL}, with plans, decode to forecast",
        "in blocks of 4,000",
        small / large,
        "<= 6",
        {"ms_per_small_block": small * SMALL * 1e3, "us_per_sample_of_large": large * 1e6},
        "Nearly all of a small block is fixed: some 3,000 calls of numpy.",
    )
