"""Make streams of many cars, and measure arrays, the scale of the fleet, fits and the start of commands."""

import gc
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from operator import ge, le, lt
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from sklearn.linear_model import LinearRegression

from socast.core import effects
from socast.core.batch import Batch, Lanes
from socast.core.fit.block_sums import build_design
from socast.core.fit.recipes import RECIPES, LinearRecipe
from socast.core.models import ANY, EXTENDED_PHYSICAL, LinearModel
from socast.core.models.features import Columns
from socast.core.pipeline import Pipeline
from socast.core.settings import Limits
from socast.core.totals.sample_totals import BLOCK
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message, Telemetry, Vehicle, encode
from socast.stream.loop import feed
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import Simulation
from socast.tools.terminal.ride_source import ROW_GROUP

START_S = 1_767_600_000.0
PERIOD_S = 3.0
BARE = ("-c", "pass")
"""What the interpreter is started with for comparison."""
REPEATS = 7
MANY, FEW = 200_000, 20_000
RECIPE: Final = "hybrid_interactions"
NOISE: Final = 0.02
FIT: Final = """
import sys
from socast.core.fit.recipes import RECIPES
for path in sys.argv[1:]:
    RECIPES[{recipe!r}].fit_parquet(path)
    status = open("/proc/self/status").read()
    print(status.partition("VmHWM:")[2].split()[0])
"""


def name_car(car: int) -> str:
    """Return the identifier of a car."""
    return f"taxi-{car:07d}"


def make_vehicles(cars: int) -> list[Message]:
    """Return a vehicle message of each car."""
    return [
        Message(
            f"fleet/{name_car(car)}/vehicle", encode(Vehicle(name_car(car), START_S, "kia-soul-ev-2015")), int(START_S)
        )
        for car in range(cars)
    ]


def make_rounds(cars: int, first: int, count: int, seed: int = 0) -> Iterator[list[Message]]:
    """Yield rounds of telemetry; a round has one sample of every car."""
    rng = np.random.default_rng(seed + first)
    phase = np.linspace(0.0, 300.0, cars, endpoint=False)
    for turn in range(first, first + count):
        now = START_S + PERIOD_S * turn
        stamps = now + rng.normal(0.0, 0.3, cars)
        speed = np.maximum(0.0, 40.0 + 45.0 * np.sin((now + phase) / 23.0))
        angle = (now - START_S + phase) / 90.0
        columns = (
            stamps,
            45.5 + 0.01 * np.sin(angle),
            -73.6 + 0.014 * np.cos(angle),
            40.0 + 15.0 * np.sin(angle) + rng.normal(0.0, 1.0, cars),
            speed,
            np.clip(90.0 - 0.01 * turn - phase / 10.0, 5.0, 100.0).round(1),
            360.0 - 0.05 * speed,
            (3.0 + speed).round(1),
        )
        messages = []
        for car, (stamp, latitude, longitude, elevation, kmh, soc, volt, ampere) in enumerate(
            zip(*(column.tolist() for column in columns), strict=True)
        ):
            name = name_car(car)
            sample = Telemetry(
                name,
                round(stamp, 3),
                ride_id=f"{car}-{turn // 400}",
                seq=turn,
                latitude_deg=round(latitude, 6),
                longitude_deg=round(longitude, 6),
                elevation_m=round(elevation, 1),
                speed_kmh=round(kmh, 1),
                soc_pct=soc,
                battery_voltage_v=round(volt, 1),
                battery_current_a=ampere,
                ambient_c=-8.0,
            )
            messages.append(Message(f"fleet/{name}/telemetry", encode(sample), int(now * 1e9)))
        yield messages


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
    figures: dict[str, float]
    bound: str

    @property
    def met(self) -> bool:
        """Whether the ratio reaches the goal."""
        sign, _, limit = self.goal.partition(" ")
        return bool({"<": lt, "<=": le, ">=": ge}[sign](self.ratio, float(limit)))


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


def alternate_timings(*timings: Callable[[], float], repeats: int) -> list[float]:
    """Return the medians of timings taken in turn, so that noise of the machine affects all equally."""
    rounds = [[timing() for timing in timings] for _ in range(repeats)]
    return [median(each) for each in zip(*rounds, strict=True)]


def cut_blocks(messages: Sequence[Message], size: int = BLOCK) -> Iterable[Sequence[Message]]:
    """Return messages in blocks."""
    return (messages[at : at + size] for at in range(0, len(messages), size))


def tabulate(messages: Sequence[Message], size: int = BLOCK, **options: Any) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the ride table and the window table that a pipeline with some options makes of messages."""
    pipeline = Pipeline(keep_forecasts=False, **options)
    for _ in feed(cut_blocks(messages, size), pipeline):
        pass
    return pipeline.take_rides(), pipeline.take_windows()


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
        {"us_among_many": median(many_s) * 1e6, "us_among_few": median(few_s) * 1e6},
        "Cache misses limit it. The state of a thousand cars fits into the processor's cache. The state of a "
        "million cars (2 GB) does not, so every sample waits for the state of its car. That state is "
        "contiguous in memory, so a sample waits only a few times.",
    )


def measure_start(words: str, goal: float, bound: str) -> Measure:
    """Measure a command that prints and ends, against `python -c pass`."""
    command = ("-m", "socast", *words.split())
    for arguments in (BARE, command):
        _run(*arguments)  # the first run compiles modules to byte code
    bare_s, command_s = alternate_timings(
        lambda: time_action(lambda: _run(*BARE)), lambda: time_action(lambda: _run(*command)), repeats=REPEATS
    )
    ratio = command_s / bare_s
    return Measure(
        f"start of socast {words}",
        "python -c pass",
        ratio,
        f"<= {goal:g}",
        {"command_s": command_s, "python_s": bare_s},
        bound,
    )


def _run(*arguments: str) -> None:
    """Run the interpreter to its end, without its output."""
    subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)  # noqa: S603 - our own command


def measure_fit(repeats: int = 3) -> Measure:
    """Measure a fit from a Parquet file of many rides, against scikit-learn's of the same columns in memory."""
    recipe = RECIPES[RECIPE]
    if not isinstance(recipe, LinearRecipe):
        raise TypeError(recipe)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rides.parquet"
        write_rides(path, _simulated(), MANY)
        model = recipe.fit_parquet(path)
        ours, plain = alternate_timings(
            lambda: time_action(lambda: recipe.fit_parquet(path)), lambda: _plain(model, path), repeats=repeats
        )
    return Measure(
        f"fitting {RECIPE} to {MANY:,} rides, file to model",
        "scikit-learn's LinearRegression of the same columns in memory",
        plain / ours,
        ">= 0.6",
        {"fit_s": ours, "plain_s": plain, "terms": len(model.terms), "fits": len(model.fits)},
        "A fit reads the file once. Reading takes a fifth of the time; converting the columns and keeping them in a "
        "temporary file, a sixth; fills and accessory curve, a tenth. The passes for normal equations and residuals "
        "read the temporary file: they spend a sixth of the time on making the columns of the model, and a third on "
        "sums of products, leverages and sums by vehicle-day. The interval, from a tenth of the rides, takes the rest. "
        "Scikit-learn's figure covers the same five fits, "
        "one for each car model and one for all, without reading the file and making the columns; it "
        "decomposes the columns themselves.",
    )


def measure_fit_memory() -> Measure:
    """Measure how peak memory grows with the number of rides: first a tenth of them, then all, in one process."""
    with tempfile.TemporaryDirectory() as folder:
        base = _simulated()
        paths = [Path(folder) / f"{n}.parquet" for n in (FEW, MANY)]
        for path, n in zip(paths, (FEW, MANY), strict=True):
            write_rides(path, base, n)
        code = FIT.format(recipe=RECIPE)
        done = subprocess.run(  # noqa: S603 - this interpreter, on files made here
            [sys.executable, "-c", code, *map(str, paths)], capture_output=True, text=True, check=True
        )
    few, many = (int(line) / 1024.0 for line in done.stdout.split())
    return Measure(
        f"peak memory of a fit to {MANY:,} rides",
        f"to {FEW:,}",
        many / few,
        "<= 1.1",
        {"many_mb": many, "few_mb": few, "table_mb": MANY * 8 * len(base.columns) / 2**20},
        "The imports take 250 MB of both. The rest is a block of 8,192 rides, its products, and what the "
        "allocator keeps. The whole table would take `table_mb`, and its products as much again.",
    )


def _simulated() -> pd.DataFrame:
    """Return the ride table of one day of a small fleet."""
    start = datetime(2018, 1, 16, 12, tzinfo=UTC)
    messages = list(simulate(Simulation(vehicles=12, start=start, shift_hours=4.0, seed=5)))
    rides, _ = tabulate(messages, also=list(effects.get_library()))
    return rides[rides["fit_for_training"]].reset_index(drop=True)


def write_rides(path: Path, base: pd.DataFrame, rides: int, seed: int = 1) -> None:
    """Write a ride table of any size."""
    rng = np.random.default_rng(seed)
    fixed = {"winter", "summer", "fit_for_training"}
    noisy = [name for name in base.columns if name not in fixed and pd.api.types.is_float_dtype(base[name])]
    writer = None
    for start in range(0, rides, ROW_GROUP):
        n = min(ROW_GROUP, rides - start)
        part = base.iloc[rng.integers(0, len(base), n)].reset_index(drop=True)
        part[noisy] = part[noisy].to_numpy() * (1.0 + NOISE * rng.standard_normal((n, len(noisy))))
        part["ambient_c"] = rng.uniform(-30.0, 30.0, n)
        day = 365 * (start + np.arange(n)) // rides
        part["date"] = (np.datetime64("2018-01-01") + day).astype(str)
        part["winter"] = ((day < 74) | (day > 348)).astype(np.int64)
        part["summer"] = 1 - part["winter"]
        table = pa.Table.from_pandas(part, preserve_index=False)
        writer = writer or pq.ParquetWriter(path, table.schema, compression="zstd")
        writer.write_table(table.cast(writer.schema))
    if writer is not None:
        writer.close()


def _plain(model: LinearModel, path: Path) -> float:
    """Return the time of scikit-learn's fits with the columns already made. [s]"""
    rides = pd.read_parquet(path)
    took = 0.0
    for key, fit in model.fits.items():
        group = rides if key == ANY else rides[rides["vehicle_model"] == key]
        table = build_design(model.terms, Columns(group, fit.fills, fit.curve), len(group))
        energy = group["energy_kwh"].to_numpy()
        took += time_action(lambda table=table, energy=energy: LinearRegression().fit(table, energy))  # type: ignore[misc]
    return took
